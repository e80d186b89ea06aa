"""SocketCAN links on the kernel's own virtual buses.

`make test-socketcan` runs these here if this kernel has ``vcan0`` and ``vcan1`` (set up as ``machine.sh``
does, MTU 72), and otherwise in a small virtual machine.
"""

from __future__ import annotations

import asyncio
import socket
import struct
from collections import Counter

import pytest

from devices.back_off import BackOff
from devices.emulators import EmulatedSuit, Encoding, SuitSettings, bench_suit
from devices.emulators.transports import CanBusTransport
from devices.link import Framing, LinkError
from devices.links import socketcan_link
from devices.links.link_counts import LostBefore
from devices.links.reconnect import LinkState, ReconnectingLink
from devices.links.socketcan_link import SocketCanLink, can_interfaces, open_can_socket
from firmware_protocol import CanFrameDecoder, InertialSample, PacketDecoder
from firmware_protocol.can_framing import CanFrame, pack_can_records, unpack_can_records

pytestmark = [
    pytest.mark.system,
    pytest.mark.timeout(110),
    pytest.mark.skipif(
        not {"vcan0", "vcan1"} <= set(can_interfaces()),
        reason="this kernel has no vcan0 and vcan1: `make test-socketcan` brings its own",
    ),
]

N_MODULES, SECONDS, RATE_HZ = 5, 2.0, 100.0
BUS_OFF, CONTROLLER_PASSIVE = (0x040, bytes(8)), (0x004, bytes([0, 0x10]) + bytes(6))


async def read(link: SocketCanLink, count: int, timeout_s: float = 60.0) -> list[CanFrame]:
    received: list[CanFrame] = []
    async with asyncio.timeout(timeout_s):
        while len(received) < count:
            received += unpack_can_records((await anext(aiter(link))).data)
    return received


@pytest.fixture
async def pair(request):
    """Two links on one bus; parametrised by whether it is FD."""
    links = SocketCanLink("vcan0", fd=request.param), SocketCanLink("vcan0", fd=request.param)
    for link in links:
        await link.open()
    yield links
    for link in links:
        await link.close()


@pytest.mark.parametrize("pair", [False, True], ids=["classic", "FD"], indirect=True)
async def test_burst_without_pause_is_not_lost(pair):
    link, peer = pair
    is_fd = peer._fd
    data = bytes(range(64 if is_fd else 8))
    frames = [CanFrame(index, data, is_fd=is_fd, bitrate_switch=is_fd) for index in range(8000)]
    await peer.write(pack_can_records(frames))
    assert await read(link, len(frames)) == frames
    assert link.counts.before[LostBefore.KERNEL_OVERFLOW] == 0


@pytest.mark.parametrize("is_fd", [False, True], ids=["classic", "FD"])
async def test_every_sample_of_an_emulated_suit_comes(is_fd):
    """The suit's own count of what it sent against what was decoded."""
    settings = SuitSettings(sampling_rate_hz=RATE_HZ, encoding=Encoding(Framing.CAN, is_fd))
    traffic = bench_suit(N_MODULES, 1, is_fresh=False, settings=settings)
    sent = list(traffic.transmissions(SECONDS))
    lost = traffic.counts["lost"]
    suit = EmulatedSuit(sent, CanBusTransport("vcan1", "socketcan", fd=is_fd), linger_s=1.0)
    link, decoder = SocketCanLink("vcan1", fd=is_fd), PacketDecoder(CanFrameDecoder())
    await link.open()
    running = asyncio.create_task(suit.run())
    packets = []
    async with asyncio.timeout(90):
        while len(packets) < len(sent):
            packets += decoder.feed((await anext(aiter(link))).data)
    await running
    await link.close()
    samples = Counter(packet.module for packet in packets if isinstance(packet.packet, InertialSample))
    per_module = round(SECONDS * RATE_HZ)
    assert len(packets) == len(sent) == traffic.counts["sent"] - lost
    assert all(abs(count - per_module) <= 0.05 * per_module for count in samples.values())
    assert len(samples) == N_MODULES
    assert not decoder.dropped


async def test_what_the_kernel_had_to_drop_is_counted(monkeypatch):
    monkeypatch.setattr(socketcan_link, "_RECEIVE_BUFFER_BYTES", 64 * 1024)
    small = SocketCanLink("vcan0")
    await small.open()
    data = socketcan_link.kernel_bytes(CanFrame(1, b"12345678"))
    bus = open_can_socket("vcan0", fd=False)  # sends at once: nobody gets to read meanwhile
    sent = sum(bus.send(data) > 0 for _ in range(4000))
    received = 0
    async with asyncio.timeout(30):
        while received + small.counts.before[LostBefore.KERNEL_OVERFLOW] < sent:
            received += len(unpack_can_records((await anext(aiter(small))).data))
            if not small.counts.before[LostBefore.KERNEL_OVERFLOW]:
                sent += bus.send(data) > 0  # drops are told with what fits
    assert small.counts.before[LostBefore.KERNEL_OVERFLOW] > 0
    assert received + small.counts.before[LostBefore.KERNEL_OVERFLOW] == sent
    bus.close()
    await small.close()


def send_error(identifier: int, data: bytes) -> None:
    """An error frame as a controller's driver makes it."""
    with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as bus:
        bus.bind(("vcan0",))
        bus.send(struct.pack("=IB3x8s", identifier | 1 << 29, 8, data))


async def test_bus_off_takes_the_link_down_and_it_comes_back():
    link = SocketCanLink("vcan0")
    kept = ReconnectingLink(link, back_off=BackOff(0.05, 0.2))
    await kept.open()
    seen: list[CanFrame] = []

    async def collect() -> None:
        async for chunk in kept:
            seen.extend(unpack_can_records(chunk.data))

    collecting = asyncio.create_task(collect())
    await asyncio.sleep(0.1)
    send_error(*CONTROLLER_PASSIVE)
    await asyncio.sleep(0.1)
    assert kept.state is LinkState.UP
    send_error(*BUS_OFF)
    async with asyncio.timeout(10):
        while not kept.reconnections:
            await asyncio.sleep(0.01)
    assert {error.name: count for error, count in link.bus_errors.items()} == {"PASSIVE": 1, "BUS_OFF": 1}
    peer = SocketCanLink("vcan0")
    await peer.open()
    await peer.write(pack_can_records([CanFrame(7, b"again")]))
    async with asyncio.timeout(10):
        while not any(frame.data == b"again" for frame in seen):
            await asyncio.sleep(0.01)
    await kept.close()
    await collecting
    await peer.close()


async def set_interface(state: str) -> None:
    process = await asyncio.create_subprocess_exec("ip", "link", "set", "vcan0", state)
    assert await process.wait() == 0


async def test_interface_that_is_set_down_and_up_again_is_found_again():
    link = SocketCanLink("vcan0")
    await link.open()
    await set_interface("down")
    try:
        with pytest.raises(LinkError, match="vcan0 is down: run 'sudo ip link set vcan0 up"):
            await asyncio.wait_for(anext(aiter(link)), 10)
    finally:
        await set_interface("up")
    await link.open()
    peer = SocketCanLink("vcan0")
    await peer.open()
    await peer.write(pack_can_records([CanFrame(1, b"x")]))
    assert await read(link, 1) == [CanFrame(1, b"x")]
    await link.close()
    await peer.close()
