"""UDP links with real sockets."""

from __future__ import annotations

import socket

import pytest

from devices.link import Framing, LinkError
from devices.udp_link import UdpLink


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


async def test_answers_go_to_the_latest_sender(link, module, next_chunk):
    with pytest.raises(LinkError, match="nobody to write to"):
        await link.write(b"early")
    module.sendto(b"hello", link.address)
    await next_chunk(aiter(link))
    await link.write(b"answer")
    assert module.recv(100) == b"answer"


async def test_port_in_use_is_told(link):
    port = link.address[1]
    with pytest.raises(LinkError, match=rf"UDP port {port} is in use"):
        await UdpLink(port=port).open()


async def test_foreign_address_is_told():
    with pytest.raises(LinkError, match=r"192\.0\.2\.1 is not an address of this computer"):
        await UdpLink("192.0.2.1", 9000).open()


async def test_closing_ends_iteration(link):
    await link.close()
    assert [chunk async for chunk in link] == []
    with pytest.raises(LinkError, match="modules is not open"):
        await link.write(b"x")
