"""SocketCAN links: on sockets that stand in for the kernel's, and on ``vcan0`` where it exists."""

from __future__ import annotations

import asyncio
import errno
import os
import socket
import struct

import pytest

from devices.link import Framing, LinkError
from devices.links import socketcan_link
from devices.links.link_counts import LostBefore
from devices.links.socketcan_link import SocketCanLink, can_interfaces, frame_from_kernel, kernel_bytes
from firmware_protocol.can_framing import CanFrame, pack_can_records, unpack_can_records
from tests.patience import PATIENCE_S

# struct can_frame and canfd_frame of linux/can.h, written out byte by byte (little-endian machine).
GOLDEN = [
    (
        struct.pack("=I", 0x8C40_0141) + b"\x03\x00\x00\x00" + b"abc\0\0\0\0\0",
        CanFrame(0x0C40_0141, b"abc"),
    ),
    (struct.pack("=I", 0x321) + b"\x08\x00\x00\x00" + b"12345678", CanFrame(0x321, b"12345678", False)),
    (struct.pack("=I", 0x4000_0011) + bytes(12), CanFrame(0x11, b"", False, is_remote=True)),
    (
        struct.pack("=I", 0x8000_0005) + b"\x40\x05\x00\x00" + bytes(range(64)),
        CanFrame(5, bytes(range(64)), is_fd=True, bitrate_switch=True),
    ),
    (
        struct.pack("=I", 0x8000_0005) + b"\x0c\x04\x00\x00" + b"x" * 12 + bytes(52),
        CanFrame(5, b"x" * 12, is_fd=True),
    ),
]
FRAMES = [frame for _, frame in GOLDEN]


@pytest.mark.parametrize(("data", "frame"), GOLDEN)
def test_kernel_layout(data, frame):
    assert frame_from_kernel(data) == frame
    assert frame_from_kernel(kernel_bytes(frame)) == frame
    assert len(kernel_bytes(frame)) == len(data)


@pytest.fixture
async def joined(monkeypatch):
    """A link on one end of a pair of datagram sockets, the bus on the other."""
    ours, bus = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    ours.setblocking(False)
    monkeypatch.setattr(socketcan_link, "open_can_socket", lambda _channel, _fd: ours)
    link = SocketCanLink("can0", fd=True, name="bus")
    await link.open()
    yield link, bus
    await link.close()
    bus.close()


async def test_frames_pass_both_ways_and_what_waits_is_one_chunk(joined, next_chunk):
    link, bus = joined
    assert link.framing is Framing.CAN
    for frame in FRAMES:
        bus.send(kernel_bytes(frame))
    assert unpack_can_records((await next_chunk(aiter(link))).data) == FRAMES
    await link.write(pack_can_records(FRAMES))
    assert [frame_from_kernel(bus.recv(72)) for _ in FRAMES] == FRAMES


async def test_full_transmit_queue_is_waited_for_and_then_given_up(joined, monkeypatch):
    link, bus = joined
    monkeypatch.setattr(socketcan_link, "_SEND_RETRIES", 20)
    writing = asyncio.ensure_future(link.write(pack_can_records(FRAMES[:1]) * 100))
    received = 0
    bus.setblocking(False)
    while received < 100:
        await asyncio.sleep(0.002)
        while True:
            try:
                bus.recv(72)
            except BlockingIOError:
                break
            received += 1
    await writing
    with pytest.raises(LinkError, match="transmit queue stays full; is another node on the bus"):
        await link.write(pack_can_records(FRAMES[:1]) * 10_000)


async def test_frames_that_the_kernel_dropped_are_counted(monkeypatch):
    """UDP stands in: its sockets count overflows the same way (SO_RXQ_OVFL)."""
    ours = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    ours.bind(("127.0.0.1", 0))
    ours.setblocking(False)
    monkeypatch.setattr(socketcan_link, "open_can_socket", lambda _channel, _fd: ours)
    monkeypatch.setattr(socketcan_link, "_RECEIVE_BUFFER_BYTES", 1024 * 1024)
    link = SocketCanLink("can0")
    await link.open()
    data = kernel_bytes(FRAMES[0])
    sent, received = 6000, 0
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as bus:
        for _ in range(sent):
            bus.sendto(data, ours.getsockname())
        async with asyncio.timeout(PATIENCE_S):
            while received + link.counts.before[LostBefore.KERNEL_OVERFLOW] < sent:
                received += len(unpack_can_records((await anext(aiter(link))).data))
                if link.counts.before[LostBefore.KERNEL_OVERFLOW] == 0:  # told with the next frame that fits
                    bus.sendto(data, ours.getsockname())
                    sent += 1
    assert received + link.counts.before[LostBefore.KERNEL_OVERFLOW] == sent
    assert link.counts.before[LostBefore.KERNEL_OVERFLOW] > 0
    await link.close()


async def test_interface_that_goes_down_is_a_loss(joined):
    link, _ = joined

    class Down:
        def recvmsg(self, *_args):
            raise OSError(errno.ENETDOWN, os.strerror(errno.ENETDOWN))

    link._receive(Down())
    with pytest.raises(
        LinkError, match="can0 is down: run 'sudo ip link set can0 up type can bitrate 1000000'"
    ):
        await anext(aiter(link))


@pytest.mark.parametrize(
    ("number", "message"),
    [
        (errno.ENODEV, r"no CAN interface 'can7'; .*'sudo ip link set can7 up type can bitrate 500000'"),
        (errno.EAFNOSUPPORT, "no CAN sockets; run 'sudo modprobe can_raw'"),
        (errno.EPERM, "Operation not permitted; try 'sudo ip link"),
    ],
)
async def test_interface_that_cannot_be_opened_says_what_would_do(monkeypatch, number, message):
    def fail(_channel: str, _fd: bool) -> socket.socket:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(socketcan_link, "open_can_socket", fail)
    with pytest.raises(LinkError, match=message):
        await SocketCanLink("can7", bitrate=500_000).open()


async def test_absent_interface_on_this_kernel():
    with pytest.raises(LinkError, match=r"no CAN interface 'nocan0'|no CAN sockets"):
        await SocketCanLink("nocan0").open()


async def test_burst_on_a_real_interface_is_lossless():
    if "vcan0" not in can_interfaces():
        pytest.skip("no vcan0: this kernel has no CAN interface")
    link, peer = SocketCanLink("vcan0", fd=True), SocketCanLink("vcan0", fd=True)
    await link.open()
    await peer.open()
    frames = [CanFrame(index, bytes(64), is_fd=True, bitrate_switch=True) for index in range(4000)]
    await peer.write(pack_can_records(frames))
    received: list[CanFrame] = []
    async with asyncio.timeout(60):
        while len(received) < len(frames):
            received += unpack_can_records((await anext(aiter(link))).data)
    assert received == frames
    assert link.counts.before[LostBefore.KERNEL_OVERFLOW] == 0
    await link.close()
    await peer.close()
