"""Signed links: real sockets, key files, reports of what was dropped."""

from __future__ import annotations

import asyncio
import socket

import pytest

from devices.emulators.transports import SignedTcpTransport, SignedUdpTransport, TcpTransport
from devices.endpoints import EndpointError, link_from_url
from devices.links.reconnect import ReconnectingLink
from devices.links.signed_link import SignedLink, read_key, time_count, write_key
from devices.links.udp_link import UdpLink
from firmware_protocol import encode_frame
from firmware_protocol.golden import GOOD
from firmware_protocol.signing import SignedFrames

SENT = encode_frame(GOOD)


@pytest.fixture
def key_file(tmp_path):
    path = tmp_path / "key"
    write_key(path)
    return path


@pytest.fixture
async def udp(key_file):
    link = SignedLink(UdpLink(name="wifi"), read_key(key_file))
    await link.open()
    yield link
    await link.close()


@pytest.fixture
def module():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as opened:
        opened.settimeout(5)
        yield opened


async def reading(link, chunks):
    async for chunk in link:
        chunks.append(chunk)


async def test_a_module_without_a_count_is_told_it_and_then_heard(udp, module, key_file, next_chunk):
    chunks = aiter(udp)
    end = SignedFrames(read_key(key_file), signer=5)
    heard = asyncio.create_task(next_chunk(chunks))
    module.sendto(end.sign(SENT), udp.link.address)
    assert end.open(await asyncio.to_thread(module.recv, 100)) == b""
    module.sendto(end.sign(SENT), udp.link.address)
    chunk = await heard
    assert chunk.data == SENT
    assert chunk.sender == f"127.0.0.1:{module.getsockname()[1]}"
    await udp.write(SENT, [chunk.sender])
    assert end.open(await asyncio.to_thread(module.recv, 100)) == SENT
    assert udp.counts.summary()["outdated"] == 1


async def test_what_is_not_rightly_signed_is_dropped_counted_and_named(udp, module, key_file, until, caplog):
    chunks = []
    listening = asyncio.create_task(reading(udp, chunks))
    signed = SignedFrames(read_key(key_file), 5, time_count() + 1000).sign(SENT)
    forged = SignedFrames(bytes(32), 6, time_count() + 1000).sign(SENT)
    for data in (SENT, forged, signed, signed, b"\x07"):
        module.sendto(data, udp.link.address)
    wanted = {"unsigned": 2, "bad_signature": 1, "replayed": 1}
    await until(lambda: wanted.items() <= udp.counts.summary().items())
    listening.cancel()
    assert [chunk.data for chunk in chunks] == [SENT]
    assert "outdated" not in udp.counts.summary()
    told = [record.getMessage() for record in caplog.records]
    assert len(told) == 3
    assert all("wifi: dropped, from 127.0.0.1:" in line for line in told)


async def test_over_tcp_counts_outlive_a_connection(key_file, until):
    suit = SignedTcpTransport(key_file)
    heard, chunks = [], []
    suit.listen(lambda data, device=None: heard.append(data))
    await suit.open()
    link = ReconnectingLink(link_from_url(suit.url, name="suit"))
    await link.open()
    listening = asyncio.create_task(reading(link, chunks))

    async def heard_at_last():
        while not chunks:
            suit.offer(SENT[:5])
            suit.offer(SENT[5:])
            await asyncio.sleep(0.01)

    await asyncio.wait_for(heard_at_last(), 20)
    assert set(chunks[0].data.split(b"\0")) == {SENT[:-1], b""}
    await link.write(SENT)
    await until(lambda: SENT in heard)
    await suit.close()
    await until(lambda: link.counts.unverified.total() >= 1)
    outdated = link.counts.unverified.total()
    await suit.open()
    chunks.clear()
    await asyncio.wait_for(heard_at_last(), 20)
    assert link.counts.unverified.total() == outdated
    listening.cancel()
    await link.close()
    await suit.close()


async def test_a_module_with_a_key_hears_nothing_that_is_unsigned(key_file, next_chunk):
    link = UdpLink()
    await link.open()
    suit = SignedUdpTransport(key_file, link.address[1])
    heard = []
    suit.listen(lambda data, device=None: heard.append(data))
    await suit.open()
    suit.offer_from(3, SENT)
    sender = (await next_chunk(aiter(link))).sender
    host = SignedFrames(read_key(key_file))
    await link.write(SENT, [sender])
    await link.write(host.sign(SENT), [sender])
    async with asyncio.timeout(20):
        while len(heard) < 2:
            await asyncio.sleep(0.005)
    assert heard == [b"", SENT]
    await suit.close()
    await link.close()


async def test_an_unsigned_link_carries_the_bytes_as_ever(next_chunk):
    suit = TcpTransport()
    await suit.open()
    link = link_from_url(suit.url)
    await link.open()
    while not suit.offer(SENT):
        await asyncio.sleep(0.005)
    assert (await next_chunk(aiter(link))).data == SENT
    await link.close()
    await suit.close()


def test_a_key_file_is_new_private_and_read_again(tmp_path):
    path = tmp_path / "key"
    write_key(path)
    assert path.stat().st_mode & 0o777 == 0o600
    assert len(read_key(path)) == 32
    with pytest.raises(FileExistsError):
        write_key(path)


@pytest.mark.parametrize("mode", [0o644, 0o604, 0o620, 0o602])
def test_a_key_that_others_may_read_or_change_is_refused(key_file, mode):
    key_file.chmod(mode)
    with pytest.raises(EndpointError, match=f"open to others: chmod 600 {key_file}"):
        link_from_url(f"udp://:7000?key_file={key_file}")


@pytest.mark.parametrize("content", ["", "abc", "zz" * 32, "0123" * 15, "é" * 64, "01" * 33])
def test_what_is_no_key_is_refused_and_not_repeated(key_file, content):
    key_file.write_text(content)
    with pytest.raises(EndpointError, match="does not begin with a key of 64") as caught:
        link_from_url(f"tcp://host:7000?key_file={key_file}")
    assert not content or content not in str(caught.value)


def test_a_key_that_is_not_there_is_named():
    with pytest.raises(EndpointError, match="/nowhere/key cannot be read: No such file"):
        link_from_url("udp://:7000?key_file=/nowhere/key")


def test_a_serial_line_takes_no_key(key_file):
    with pytest.raises(EndpointError, match="unknown parameter 'key_file'"):
        link_from_url(f"/dev/ttyUSB0?key_file={key_file}")
