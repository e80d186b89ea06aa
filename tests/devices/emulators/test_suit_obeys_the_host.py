"""Suits in real time that are talked with through the gateway's own links, one medium after the other."""

from __future__ import annotations

import asyncio
import contextlib
import itertools

import pytest

from devices.emulators.delivery import Encoding
from devices.emulators.emulated_suit import EmulatedSuit
from devices.emulators.motion.motions import robot_arm_motion
from devices.emulators.suit_settings import SuitSettings
from devices.emulators.suit_traffic import SuitTraffic
from devices.emulators.transports import (
    CanBusTransport,
    LoopbackTransport,
    MemoryTransport,
    PtyTransport,
    SlcanTransport,
    TcpTransport,
)
from devices.emulators.transports.memory import loopback_pair
from devices.endpoints import link_from_url
from devices.link import Framing, gateway_time_ns
from firmware_protocol import (
    BROADCAST,
    Acknowledgement,
    CanFrameDecoder,
    Command,
    FrameDecoder,
    InertialSample,
    PacketDecoder,
    wire_frame,
)
from firmware_protocol.commands import Verb, encode_arguments
from firmware_protocol.device_settings import encode_value
from tests.patience import PATIENCE_S
from tests.running_suit import running
from tests.simulated_time import in_simulated_time

HELLO = encode_arguments(Verb.HELLO, 1, 1)
BYTES, CAN = Encoding(), Encoding(Framing.CAN)
channels = itertools.count()


def traffic_of(arm4, encoding=BYTES, has_relay=False):
    return SuitTraffic(robot_arm_motion(arm4, 1), SuitSettings(encoding=encoding, has_relay=has_relay))


def bytes_of(packet, module, encoding=BYTES):
    return encoding.encode(wire_frame(packet, module, 0, 0))


class Conversation:
    """A link, what came by it, and how long answers took."""

    def __init__(self, link, encoding):
        self.link, self._encoding = link, encoding
        self.decoder = PacketDecoder(CanFrameDecoder() if encoding.framing is Framing.CAN else FrameDecoder())
        self.packets = []
        self._news = asyncio.Event()

    async def listen(self):
        async for chunk in self.link:
            self.packets += self.decoder.feed(chunk.data)
            self._news.set()

    async def ask(self, command, module):
        """The acknowledgement and the time it took, s."""
        asked_ns = gateway_time_ns()
        await self.link.write(bytes_of(command, module, self._encoding))
        while True:
            for received in self.packets:
                packet = received.packet
                if isinstance(packet, Acknowledgement) and packet.transaction == command.transaction:
                    return packet, (gateway_time_ns() - asked_ns) * 1e-9
            self._news.clear()
            await asyncio.wait_for(self._news.wait(), PATIENCE_S)


@contextlib.asynccontextmanager
async def conversation(link, encoding):
    await link.open()
    talk = Conversation(link, encoding)
    listening = asyncio.create_task(talk.listen())
    try:
        yield talk
    finally:
        listening.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await listening
        await link.close()


def make(medium):
    """Transport, the link that reads it (None: by its url), encoding."""
    if medium == "loopback":
        near, far = loopback_pair()
        return LoopbackTransport(far), near, BYTES
    if medium == "can":
        return CanBusTransport(f"obeys-{next(channels)}"), None, CAN
    transport = {"pty": PtyTransport, "tcp": TcpTransport, "slcan": SlcanTransport}[medium]()
    return transport, None, CAN if medium == "slcan" else BYTES


@pytest.mark.parametrize("medium", ["pty", "tcp", "can", "slcan", "loopback"])
async def test_a_host_changes_a_module(arm4, medium, until):
    transport, link, encoding = make(medium)
    traffic = traffic_of(arm4, encoding)
    suit = EmulatedSuit(traffic, transport)
    async with running(suit):
        while medium != "loopback" and not transport.url:
            await asyncio.sleep(0.005)
        async with conversation(link or link_from_url(transport.url), encoding) as talk:
            await until(lambda: len(talk.packets) > 40)
            for transaction in range(8):
                answer, _ = await talk.ask(Command(transaction, Verb.HELLO, arguments=HELLO), 2)
                assert (answer.result, answer.unique_id) == (0, traffic.device(2).unique_id)
            rename = encode_arguments(Verb.WRITE_SETTING, 1, encode_value(1, 33))
            assert (await talk.ask(Command(100, Verb.WRITE_SETTING, arguments=rename), 2))[0].result == 0
            assert (await talk.ask(Command(101, Verb.COMMIT), 2))[0].result == 0
            n_before = len(talk.packets)
            await until(lambda: len(talk.packets) > n_before + 40)
            after = {p.module for p in talk.packets[n_before:] if isinstance(p.packet, InertialSample)}
            assert after == {0, 1, 3, 33}
    assert not talk.decoder.dropped
    assert suit.counts.received_bytes > 200


def test_an_answer_comes_within_two_steps_of_the_computation(arm4):
    async def took_s():
        near, far = loopback_pair()
        suit = EmulatedSuit(traffic_of(arm4), LoopbackTransport(far))
        async with running(suit), conversation(near, BYTES) as talk:
            while not talk.packets:  # what is asked before the suit is there is lost
                await asyncio.sleep(0.01)
            asked = [Command(transaction, Verb.HELLO, arguments=HELLO) for transaction in range(8)]
            return [(await talk.ask(each, 2))[1] for each in asked]

    assert max(in_simulated_time(took_s())) < 0.02


async def test_a_loopback_reader_comes_and_goes(arm4):
    near, far = loopback_pair()
    async with running(EmulatedSuit(traffic_of(arm4), LoopbackTransport(far))):
        for transaction in range(3):
            async with conversation(near, BYTES) as talk:
                await asyncio.sleep(0.02)
                answer, _ = await talk.ask(Command(transaction, Verb.DISCARD), 1)
                assert answer.result == 0
            await asyncio.sleep(0.02)


def test_the_motion_is_in_real_time_and_on_time(arm4):
    memory = MemoryTransport()
    suit = EmulatedSuit(traffic_of(arm4, has_relay=True), memory, duration_s=1.0, linger_s=0.0)
    in_simulated_time(suit.run())
    decoder, late_s = PacketDecoder(FrameDecoder()), []
    for at_ns, data in memory.chunks:
        late_s += [(at_ns - suit.instant_ns(p.module_time_us * 1e-6)) * 1e-9 for p in decoder.feed(data)]
    assert len(late_s) == 4 * 100 + 4 * 2
    assert min(late_s) >= 0.0
    assert max(late_s) < 0.01  # a relay sends what it has gathered


async def test_at_full_speed_commands_come_between_the_steps(arm4):
    memory = MemoryTransport()
    suit = EmulatedSuit(traffic_of(arm4), memory, speed=None, duration_s=20.0, linger_s=0.0)
    async with running(suit) as task:
        while len(memory.chunks) < 20:
            await asyncio.sleep(0)
        memory.receive(bytes_of(Command(1, Verb.STOP), BROADCAST))
        await asyncio.wait_for(task, PATIENCE_S)
    packets = PacketDecoder(FrameDecoder()).feed(b"".join(data for _, data in memory.chunks))
    assert sum(isinstance(p.packet, Acknowledgement) for p in packets) == 4
    last_s = max(p.module_time_us for p in packets if isinstance(p.packet, InertialSample)) * 1e-6
    assert last_s < 19.0


async def test_a_suit_that_only_speaks_hears_nothing(arm4):
    memory = MemoryTransport()
    suit = EmulatedSuit(traffic_of(arm4).transmissions(0.3), memory, linger_s=0.0)
    async with running(suit) as task:
        while not memory.chunks:
            await asyncio.sleep(0)
        memory.receive(bytes_of(Command(1, Verb.STOP), BROADCAST))
        await task
    packets = PacketDecoder(FrameDecoder()).feed(b"".join(data for _, data in memory.chunks))
    assert not [p for p in packets if isinstance(p.packet, Acknowledgement)]
    assert suit.counts.received_bytes > 0
