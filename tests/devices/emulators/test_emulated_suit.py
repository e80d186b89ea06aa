"""Suits at work on real pseudo-terminals, sockets and buses, read by others than the gateway's own links."""

from __future__ import annotations

import asyncio
import contextlib
import os
import time
import tty

import can
import pytest

from devices.emulators.delivery import Encoding, Transmission
from devices.emulators.emulated_suit import EmulatedSuit
from devices.emulators.motion.motions import robot_arm_motion
from devices.emulators.suit_traffic import SuitSettings, SuitTraffic
from devices.emulators.transports import (
    CanBusTransport,
    MemoryTransport,
    PtyTransport,
    SlcanTransport,
    TcpTransport,
)
from devices.link import Framing
from firmware_protocol import (
    CanFrame,
    CanFrameDecoder,
    Event,
    FrameDecoder,
    InertialSample,
    PacketDecoder,
    pack_can_records,
)
from tests.patience import PATIENCE_S
from tests.running_suit import running
from tests.simulated_time import in_simulated_time

CAN = SuitSettings(encoding=Encoding(Framing.CAN))


def arm_source(arm4, duration_s, settings=None):
    return SuitTraffic(robot_arm_motion(arm4, 1), settings).transmissions(duration_s)


async def read_pty(descriptor, until, limit_s=PATIENCE_S):
    """Bytes from a raw descriptor until the predicate holds or time is up."""
    data, end = b"", time.monotonic() + limit_s
    while not until(data) and time.monotonic() < end:
        with contextlib.suppress(BlockingIOError):
            data += os.read(descriptor, 65536)
        await asyncio.sleep(0.001)
    return data


async def wait_until(condition, limit_s=PATIENCE_S):
    end = time.monotonic() + limit_s
    while not condition():  # nothing announces a pseudo-terminal
        assert time.monotonic() < end
        await asyncio.sleep(0.001)


def open_raw(path):
    descriptor = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    tty.setraw(descriptor)
    return descriptor


async def test_pty_end_to_end_at_full_speed_without_loss(arm4, tmp_path):
    link = tmp_path / "suit"
    suit = EmulatedSuit(arm_source(arm4, 5.0), PtyTransport(link), speed=None, linger_s=PATIENCE_S)
    async with running(suit):
        await wait_until(link.exists)
        reader = open_raw(link)
        decoder = PacketDecoder(FrameDecoder())
        expected = sum(1 for _ in arm_source(arm4, 5.0))
        packets = []
        while len(packets) < expected and (data := await read_pty(reader, until=bool)):
            packets += decoder.feed(data)
        os.close(reader)
    assert len(packets) == expected
    assert not decoder.dropped
    assert suit.counts.dropped_bytes == 0
    assert not link.exists()


class Overheard(PtyTransport):
    """Keeps what it was offered."""

    def __init__(self):
        super().__init__()
        self.offered = b""

    def offer(self, data):
        self.offered += data
        return super().offer(data)


def packets_of(data):
    return {(p.module, p.sequence, p.module_time_us) for p in PacketDecoder(FrameDecoder()).feed(data)}


async def test_pty_in_real_time_drops_for_an_absent_reader_and_survives_reopening(arm4):
    transport = Overheard()
    suit = EmulatedSuit(arm_source(arm4, None), transport)
    async with running(suit):
        await wait_until(lambda: suit.counts.dropped_bytes > 2000)
        assert suit.counts.sent_bytes == 0
        for _ in range(2):
            reader, before = open_raw(transport.path), packets_of(transport.offered)
            data = await read_pty(reader, until=lambda data: data.count(0) > 60)
            os.close(reader)
            decoder = PacketDecoder(FrameDecoder())
            assert len(decoder.feed(data)) > 55
            assert not decoder.dropped
            assert not packets_of(data) & before  # nothing stale: what was due while it was closed is gone
            dropped = suit.counts.dropped_bytes
            await wait_until(lambda dropped=dropped: suit.counts.dropped_bytes > dropped + 1000)


async def test_a_reader_that_does_not_read_never_blocks_the_suit(arm4):
    transport = PtyTransport()
    suit = EmulatedSuit(arm_source(arm4, 60.0), transport, speed=100.0)
    async with running(suit) as task:
        await wait_until(lambda: transport.path)
        reader = open_raw(transport.path)
        await asyncio.wait_for(task, PATIENCE_S)
        os.close(reader)
    assert suit.counts.dropped_chunks > 10
    assert suit.counts.sent_bytes < 100_000


async def test_byte_by_byte(arm4):
    memory = MemoryTransport()
    await EmulatedSuit(arm_source(arm4, 0.5), memory, speed=None, is_byte_by_byte=True, linger_s=0.0).run()
    assert {len(data) for _, data in memory.chunks} == {1}
    assert b"".join(data for _, data in memory.chunks) == b"".join(t.data for t in arm_source(arm4, 0.5))


def test_transmissions_are_sent_when_due_and_not_before():
    source = [Transmission(0.02 * k, bytes([k])) for k in range(15)]
    memory = MemoryTransport()
    suit = EmulatedSuit(source, memory, speed=2.0, linger_s=0.0)
    in_simulated_time(suit.run())
    late_s = [(at - suit.instant_ns(0.02 * k)) * 1e-9 for at, data in memory.chunks for k in data]
    assert b"".join(data for _, data in memory.chunks) == bytes(range(15))
    assert min(late_s) >= 0
    assert max(late_s) < 1e-6
    assert suit.motion_time_s(suit.start_ns + 500_000_000) == pytest.approx(1.0)


async def test_a_full_sink_counts_drops():
    source = [Transmission(0.05 * k, b"abc") for k in range(20)]
    suit = EmulatedSuit(source, MemoryTransport(capacity=1), speed=1.0, linger_s=0.0)
    await suit.run()
    assert suit.counts.sent_bytes + suit.counts.dropped_bytes == 60
    assert suit.counts.dropped_chunks >= 1


async def test_tcp_serves_one_client_after_the_other(arm4):
    transport = TcpTransport()
    suit = EmulatedSuit(arm_source(arm4, None), transport)
    async with running(suit):
        await wait_until(lambda: transport.port)
        for _ in range(3):
            reader, writer = await asyncio.open_connection("127.0.0.1", transport.port)
            decoder, packets = PacketDecoder(FrameDecoder()), []
            while len(packets) < 40:
                packets += decoder.feed(await asyncio.wait_for(reader.read(4096), PATIENCE_S))
            assert not decoder.dropped
            writer.close()
            await writer.wait_closed()
    assert transport.connections_made == 3


async def test_tcp_at_full_speed_waits_for_a_client_and_loses_nothing(arm4):
    transport = TcpTransport()
    suit = EmulatedSuit(arm_source(arm4, 20.0), transport, speed=None)
    task = asyncio.create_task(suit.run())
    await wait_until(lambda: transport.port)
    reader, writer = await asyncio.open_connection("127.0.0.1", transport.port)
    received = await asyncio.wait_for(reader.read(), PATIENCE_S)
    writer.close()
    await task
    assert received == b"".join(t.data for t in arm_source(arm4, 20.0))


@pytest.mark.parametrize("is_fd", [False, True], ids=["classic", "fd"])
async def test_virtual_can_bus(arm4, is_fd):
    settings = SuitSettings(encoding=Encoding(Framing.CAN, is_fd))
    options = {"protocol": can.CanProtocol.CAN_FD} if is_fd else {}
    with can.Bus(interface="virtual", channel=f"suit-{is_fd}", **options) as bus:
        await EmulatedSuit(
            arm_source(arm4, 1.0, settings),
            CanBusTransport(f"suit-{is_fd}", **options),
            speed=None,
            linger_s=0.0,
        ).run()
        decoder, packets = PacketDecoder(CanFrameDecoder()), []
        while (message := bus.recv(timeout=0)) is not None:
            packets += decoder.feed(records_of(message))
    assert not decoder.dropped
    assert sum(isinstance(p.packet, InertialSample) for p in packets) == 400


def records_of(message):
    frame = CanFrame(message.arbitration_id, bytes(message.data), message.is_extended_id, message.is_fd)
    return pack_can_records([frame])


async def test_slcan_over_a_pty_read_by_python_can(arm4):
    transport = SlcanTransport()
    suit = EmulatedSuit(arm_source(arm4, None, CAN), transport)

    def read_with_python_can():
        with can.Bus(interface="slcan", channel=transport.path, bitrate=500_000, sleep_after_open=0.1) as bus:
            end = time.monotonic() + PATIENCE_S
            while len(packets) < 60 and time.monotonic() < end:
                if (message := bus.recv(timeout=0.2)) is not None:
                    packets.extend(decoder.feed(records_of(message)))

    decoder, packets = PacketDecoder(CanFrameDecoder()), []
    async with running(suit):
        await wait_until(lambda: transport.path)
        await asyncio.to_thread(read_with_python_can)
        await wait_until(lambda: not transport.is_channel_open)
    assert transport.commands[-1] == b"C"
    assert {b"S6", b"O"} <= set(transport.commands)
    assert len(packets) >= 60
    assert sum(decoder.dropped.values()) <= 1  # a wire frame under way when the channel opened


async def test_slcan_answers_commands():
    transport = SlcanTransport()
    await transport.open()
    reader = open_raw(transport.path)
    try:
        for command, answer in (
            (b"C\r", b"\r"),
            (b"S8\rY2\r", b"\r\r"),
            (b"V\r", b"V1013\r"),
            (b"t1230\r", b"\x07"),
            (b"O\r", b"\r"),
            (b"T000001230\r", b"Z\r"),
            (b"!\r", b"\x07"),
        ):
            os.write(reader, command)
            size = len(answer)
            assert await read_pty(reader, lambda data, size=size: len(data) >= size) == answer
        assert transport.offer(pack_can_records([CanFrame(0x123, b"\x01\x02")]))
        assert await read_pty(reader, until=lambda data: b"\r" in data) == b"T0000012320102\r"
        assert transport.frames_received == 2
    finally:
        os.close(reader)
        await transport.close()


async def test_a_pty_replaces_a_stale_link_but_no_file(tmp_path):
    link = tmp_path / "suit"
    link.symlink_to("/nowhere")
    transport = PtyTransport(link)
    await transport.open()
    assert link.resolve().exists()
    await transport.close()
    link.write_text("mine")
    with pytest.raises(FileExistsError):
        await transport.open()
    await transport.close()
    assert link.read_text() == "mine"


@pytest.mark.parametrize(
    ("options", "message"), [({"speed": 0.0}, "positive factor"), ({"is_byte_by_byte": True}, "byte stream")]
)
def test_what_cannot_be_run_is_refused(options, message):
    with pytest.raises(ValueError, match=message):
        EmulatedSuit([], MemoryTransport(Framing.CAN), **options)
    with pytest.raises(RuntimeError, match="not started"):
        EmulatedSuit([], MemoryTransport()).instant_ns(0.0)


class Laborious:
    """A conversation that takes long to compute once, as on a machine that is busy for a while."""

    def __init__(self, first_takes_s):
        self.steps_s, self._now_s, self._first_takes_s = [], 0.0, first_takes_s

    def receive(self, data, at_s, _device=None):
        raise AssertionError("nobody speaks to it")

    def advance(self, to_s):
        if not self.steps_s:
            time.sleep(self._first_takes_s)
        self.steps_s.append(to_s - self._now_s)
        self._now_s = to_s
        return [Transmission(to_s, b"x")]

    def rest(self):
        return []


async def test_a_suit_that_was_kept_from_computing_catches_up_in_short_steps():
    """In one piece, steps would follow on each other ever longer while computing is slower than time."""
    slow = Laborious(first_takes_s=1.0)
    await EmulatedSuit(slow, MemoryTransport(), duration_s=1.2, linger_s=0.0).run()
    assert sum(slow.steps_s) == pytest.approx(1.2)
    assert max(slow.steps_s) <= 0.25 + 1e-9
    assert max(slow.steps_s[1:]) > 0.1  # and not in steps so short that it never catches up


async def test_a_pty_passes_on_all_of_a_chunk_that_it_took_in_part():
    transport, chunk = PtyTransport(), bytes(range(1, 256)) * 1000
    await transport.open()
    reader = open_raw(transport.path)
    try:
        assert transport.offer(chunk)
        assert await read_pty(reader, lambda data: len(data) >= len(chunk)) == chunk
    finally:
        os.close(reader)
        await transport.close()


async def test_a_pty_leaves_the_link_of_the_one_after_it(tmp_path):
    link = tmp_path / "suit"
    first, second = PtyTransport(link), PtyTransport(link)
    await first.open()
    await second.open()
    await first.close()
    assert link.resolve().exists()
    await second.close()
    assert not link.is_symlink()


async def test_something_is_done_to_a_suit_while_it_runs(arm4):
    traffic = SuitTraffic(robot_arm_motion(arm4, 1))
    suit = EmulatedSuit(traffic, MemoryTransport())
    async with running(suit):
        await wait_until(lambda: suit.start_ns is not None)
        suit.do(lambda: traffic.press_button(2, 0.0))
        await wait_until(lambda: _pressed(suit.transport) == [2])


def _pressed(transport):
    """Modules whose buttons were pressed."""
    received = PacketDecoder(FrameDecoder()).feed(b"".join(data for _, data in transport.chunks))
    return [packet.module for packet in received if isinstance(packet.packet, Event)]
