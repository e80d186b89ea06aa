"""Several transports as one."""

from devices.emulators.transports import LinkPerDevice, UdpTransport


async def test_links_have_addresses_once_all_are_open():
    """A busy machine printed the first of three as if there was no more."""
    first, second = UdpTransport(50001), UdpTransport(50002)
    links = LinkPerDevice({1: first, 2: second})
    await first.open()
    assert links.url == ""
    await second.open()
    assert links.url == "udp://127.0.0.1:50001 udp://127.0.0.1:50002"
    await links.close()
