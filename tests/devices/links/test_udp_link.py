"""UDP links with real sockets."""

from __future__ import annotations

import asyncio
import socket

import pytest

from devices.endpoints import link_from_url
from devices.link import Framing, LinkBusyError, LinkError, gateway_time_ns
from devices.links.udp_link import UdpLink


@pytest.fixture
async def link():
    opened = UdpLink(name="modules")
    await opened.open()
    yield opened
    await opened.close()


@pytest.fixture
def module():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as opened:
        opened.settimeout(1)
        yield opened


async def test_each_datagram_is_one_chunk(link, module, next_chunk):
    assert link.framing is Framing.BYTE_STREAM
    for data in (b"one", bytes(1400), b"three"):
        module.sendto(data, link.address)
    chunks = aiter(link)
    assert [(await next_chunk(chunks)).data for _ in range(3)] == [b"one", bytes(1400), b"three"]


async def test_bound_to_this_computer_alone_by_default(link):
    assert link.address[0] == "127.0.0.1"


async def test_each_chunk_names_its_sender_and_what_is_written_goes_to_those_named(link, module, next_chunk):
    with pytest.raises(LinkError, match="nobody to write to"):
        await link.write(b"to nobody")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.settimeout(1)
        chunks = aiter(link)
        senders = []
        for each in (module, other):
            each.sendto(b"hello", link.address)
            senders.append((await next_chunk(chunks)).sender)
            assert senders[-1] == f"127.0.0.1:{each.getsockname()[1]}"
        await link.write(b"one", senders[:1])
        await link.write(b"all", senders)
        assert [module.recv(100), module.recv(100), other.recv(100)] == [b"one", b"all", b"all"]


async def test_a_sender_that_cannot_be_written_to_does_not_keep_it_from_the_others(link, module, next_chunk):
    module.sendto(b"hello", link.address)
    sender = (await next_chunk(aiter(link))).sender
    await link.write(b"x", ["0.0.0.1:0", sender])
    assert module.recv(100) == b"x"
    with pytest.raises(LinkError, match="did not send"):
        await link.write(b"x", ["0.0.0.1:0"])


async def test_senders_of_ipv6_can_be_answered(next_chunk):
    link = UdpLink("::1", name="modules")
    try:
        await link.open()
    except LinkError:
        pytest.skip("this machine has no IPv6")
    with socket.socket(socket.AF_INET6, socket.SOCK_DGRAM) as other:
        other.settimeout(1)
        other.sendto(b"hello", link.address)
        sender = (await next_chunk(aiter(link))).sender
        assert sender == f"[::1]:{other.getsockname()[1]}"
        await link.write(b"answer", [sender])
        assert other.recv(100) == b"answer"
    await link.close()


async def test_datagrams_of_others_than_the_peers_are_dropped_counted_and_told(module, next_chunk, caplog):
    link = link_from_url("udp://127.0.0.1:0?peers=192.0.2.0/24,127.0.0.2", name="modules")
    await link.open()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer:
        peer.bind(("127.0.0.2", 0))
        for _ in range(3):
            module.sendto(b"strange", link.address)
        peer.sendto(b"known", link.address)
        assert (await next_chunk(aiter(link))).data == b"known"
    assert link.counts.refused == 3
    assert link.counts.summary()["refused"] == 3
    assert [record.message for record in caplog.records] == [
        "modules: 127.0.0.1 sends here and is not among the peers: its datagrams are dropped"
    ]
    await link.close()


async def test_port_in_use_is_told(link):
    port = link.address[1]
    with pytest.raises(LinkBusyError, match=rf"UDP port {port} is in use"):
        await UdpLink(port=port).open()


async def test_foreign_address_is_told():
    with pytest.raises(LinkError, match=r"192\.0\.2\.1 is not an address of this computer"):
        await UdpLink("192.0.2.1", 9000).open()


async def test_closing_ends_iteration(link):
    await link.close()
    assert [chunk async for chunk in link] == []
    with pytest.raises(LinkError, match="modules is not open"):
        await link.write(b"x")


async def test_what_a_turn_leaves_in_the_socket_counts_as_backlog(link, module, until):
    assert link.counts.backlog_since_ns is None
    sent_ns = gateway_time_ns()
    for _ in range(100):
        module.sendto(b"many", link.address)
    await asyncio.sleep(0)  # one turn of the loop
    await asyncio.sleep(0)
    assert link.counts.taken < 400
    assert sent_ns <= link.counts.backlog_since_ns <= gateway_time_ns()
    await until(lambda: link.counts.taken == 400)
    assert link.counts.backlog_since_ns is None


async def test_a_turn_that_takes_just_all_there_was_leaves_no_backlog(link, module, until):
    for _ in range(64):
        module.sendto(b"many", link.address)
    await until(lambda: link.counts.taken == 256)
    assert link.counts.backlog_since_ns is None
