"""Chunks of any link to readings in gateway time: framing → packets → clocks.

One ``Stream`` serves the whole suit, since modules may come over several links, or all through a
relay over one. Readings are routed by module id.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from enum import StrEnum

import numpy as np

from devices.link import Chunk, Framing, SentChunk
from devices.link_decoder import LinkDecoder, packet_decoder
from firmware_protocol import (
    Defect,
    DeviceInfo,
    FusedSample,
    Health,
    InertialSample,
    InertialSampleFine,
    LightSample,
    LocalMeasurement,
    Packet,
    PacketDecoder,
    PressureSample,
    ReceivedPacket,
    SamplingTrigger,
    SyncRequest,
    SyncResponse,
)
from firmware_protocol.kinds import FROM_HOST
from gateway.clocks import (
    ClockTable,
    EstimatedClock,
    LinkBatching,
    ModuleClock,
    RelayBatching,
    SharedClock,
    SharedOffset,
    TableClocks,
    TriggerAnswers,
    warm_up,
)
from gateway.frames import Clipped, FusedReading, InertialReading, LightReading, LocalReading, Quantity
from gateway.sources.air_velocity import air_velocity
from gateway.sources.exchanges import TimeExchanges
from gateway.sources.losses import Cause, LinkLosses
from gateway.sources.statistics import ModuleRecord

Reading = InertialReading | FusedReading | LocalReading | LightReading

Listener = Callable[[ReceivedPacket, Chunk], None]
"""Told of a packet and of the chunk that completed it, at once. Must neither wait nor raise."""


class ClockMode(StrEnum):
    """Where gateway time comes from."""

    ESTIMATED = "estimated"
    """Every module has its own crystal: rate and offset are estimated from arrival times."""
    SHARED = "shared"
    """All modules count one clock already (wired suit, one controller): one offset for all."""
    TABLE = "table"
    """Rates come from a table measured beforehand (`calibrate clocks`), offsets from arrival times."""
    TRIGGER = "trigger"
    """The gateway says when to sample: a sample's instant is that at which its trigger left. What modules
    send on their own timers has an estimated clock."""


SAMPLE_KINDS = frozenset(
    packet.KIND
    for packet in (
        InertialSample,
        InertialSampleFine,
        FusedSample,
        LocalMeasurement,
        LightSample,
        PressureSample,
    )
)
"""Of packets that readings are made from."""

_TRIGGERED = 1 << 8
"""Added to the kind: triggered samples are counted by themselves, by the triggers' numbers."""


class Stream:
    """Decodes, counts and timestamps. Bytes are untrusted: nothing here raises for what they hold."""

    def __init__(
        self,
        clock_mode: ClockMode = ClockMode.ESTIMATED,
        clock_table: ClockTable | None = None,
        triggers: TriggerAnswers | None = None,
    ) -> None:
        """triggers: what answers are awaited in mode TRIGGER; None in any other."""
        self.triggers = triggers
        self.modules: dict[int, ModuleRecord] = {}
        self.readings = 0
        """Readings given out."""
        self.echoed = 0
        """Packets of a host, ours or another one's, that came back over a bus."""
        self._decoders: dict[str, LinkDecoder] = {}
        self._sent_decoders: dict[str, PacketDecoder] = {}
        self._losses: dict[str, LinkLosses] = {}
        self._batching: dict[str, LinkBatching] = {}
        self._relays: dict[str, RelayBatching] = {}
        self._listeners: dict[type[Packet], list[Listener]] = {}
        self._new_clock = _clock_factory(clock_mode, clock_table)
        self._exchanges = TimeExchanges(self.modules)
        self.listen(SyncResponse, self._exchanges.answered)

    def add_link(self, name: str, framing: Framing) -> None:
        """Announce a link, before its first chunk."""
        self._decoders[name] = LinkDecoder(framing)
        self._sent_decoders[name] = packet_decoder(framing)
        self._batching[name], self._relays[name] = LinkBatching(), RelayBatching()
        self._losses[name] = LinkLosses()

    def hears(self, link: str) -> bool:
        """Whether the link was announced here: one that brings markers or heat maps is not."""
        return link in self._decoders

    def notice(self, link: str, cause: Cause) -> None:
        """Something was lost on a link since its last chunk: tells what missing packets fell victim to."""
        if link in self._losses:
            self._losses[link].notice(cause)

    def listen(self, packet_class: type[Packet], listener: Listener) -> None:
        """Have every packet of a class told to ``listener`` too, also one that came before."""
        self._listeners.setdefault(packet_class, []).append(listener)

    def stop_listening(self, packet_class: type[Packet], listener: Listener) -> None:
        """Undo ``listen``."""
        self._listeners[packet_class].remove(listener)

    def receive(self, chunk: Chunk) -> list[Reading]:
        """The readings that a chunk completes, in order of arrival."""
        readings = []
        decoder = self._decoders[chunk.link]
        packets = decoder.feed(chunk)
        if decoder.is_trusted:  # when a stranger sends says nothing about the modules
            self._batching[chunk.link].observe(chunk.arrived_ns)
        self._losses[chunk.link].chunk += 1
        if decoder.is_damaged:
            self._losses[chunk.link].notice(Cause.DAMAGED)
        for packet in packets:
            for listener in self._listeners.get(type(packet.packet), ()):
                listener(packet, chunk)
            if packet.kind in FROM_HOST:
                self.echoed += 1
                continue  # our own, echoed by a bus; its time is that of no module
            reading = self._read(packet, chunk)
            if reading is not None:
                readings.append(reading)
        self.readings += len(readings)
        return readings

    def senders(self, link: str) -> tuple[str, ...]:
        """Who is to be written to on a link: those who sent something valid lately, by address; nobody where
        there is but one other end."""
        decoder = self._decoders.get(link)
        return () if decoder is None else decoder.senders

    def sender_statistics(self) -> dict[str, dict[str, object]]:
        """By link with several senders: who they are, and who else sends there."""
        found = {name: decoder.statistics() for name, decoder in self._decoders.items()}
        return {name: statistics for name, statistics in found.items() if statistics}

    def restarts(self) -> dict[int, int]:
        """How often each module was found to count from anew."""
        return {module: record.clock.restarts for module, record in self.modules.items()}

    def sent(self, chunk: SentChunk) -> None:
        """Take note of what the gateway put on a link, once it has left and before what answers it.

        An input like ``receive``: what answers are worth depends on when their question left. Over a link
        that is not announced nothing is expected back.
        """
        decoder = self._sent_decoders.get(chunk.link)
        for sent in [] if decoder is None else decoder.feed(chunk.data):
            if isinstance(sent.packet, SyncRequest):
                self._exchanges.asked(sent.packet.token, chunk)
            elif isinstance(sent.packet, SamplingTrigger) and self.triggers is not None:
                self.triggers.sent(sent.packet.number, chunk.link, chunk.sent_ns)

    @property
    def dropped(self) -> dict[str, Counter[Defect]]:
        """What was dropped by link and reason."""
        return {name: decoder.dropped for name, decoder in self._decoders.items()}

    @property
    def decoded(self) -> int:
        """Packets out of the decoders of all links."""
        return sum(decoder.accepted for decoder in self._decoders.values())

    def _read(self, received: ReceivedPacket, chunk: Chunk) -> Reading | None:
        record, time_ns = self._timed(received, chunk)
        if self.triggers is not None:
            packet = received.packet
            self.triggers.heard(received.module, chunk.link)
            if isinstance(packet, InertialSample | InertialSampleFine) and packet.triggered:
                return self._read_triggered(self.triggers, record, received, chunk)
            if isinstance(packet, InertialSample | InertialSampleFine | FusedSample):
                self.triggers.sampled_alone(received.module)
        sequence = record.counter(received.kind).count(received.sequence, self._losses[chunk.link])
        return None if sequence is None else _reading(record, received.packet, sequence, time_ns)

    def _timed(self, received: ReceivedPacket, chunk: Chunk) -> tuple[ModuleRecord, int]:
        """The module's record, and the packet's instant by the module's clock."""
        if received.relayed_us is not None:
            self._relays[chunk.link].observe_tick(received.relayed_us)
        record = self.modules.get(received.module)
        if record is None:
            record = self._new_record(received, chunk)
        restarts = record.clock.restarts
        time_ns = record.clock.gateway_time(received.module_time_us, chunk.arrived_ns)
        if record.clock.restarts != restarts:
            record.restarted_ns.append(chunk.arrived_ns)
            for restarted in record.sequences.values():
                restarted.restart()
        record.last_arrival_ns = chunk.arrived_ns
        return record, time_ns

    def _new_record(self, received: ReceivedPacket, chunk: Chunk) -> ModuleRecord:
        """Of a module that is heard for the first time."""
        waits = self._batching if received.relayed_us is None else self._relays
        clock = self._new_clock(received.module, waits[chunk.link])
        record = ModuleRecord(received.module, clock, first_arrival_ns=chunk.arrived_ns)
        self.modules[received.module] = record
        return record

    def _read_triggered(
        self, triggers: TriggerAnswers, record: ModuleRecord, received: ReceivedPacket, chunk: Chunk
    ) -> Reading | None:
        """A sample that answers a trigger: its instant is the trigger's, whatever the module's clock says."""
        answer = triggers.answered(received.module, received.sequence, chunk.link, chunk.arrived_ns)
        if answer is None:
            return None
        sequence = record.counter(received.kind | _TRIGGERED).count_unwrapped(
            answer.full, self._losses[chunk.link]
        )
        return None if sequence is None else _reading(record, received.packet, sequence, answer.sent_ns)


def _clock_factory(mode: ClockMode, table: ClockTable | None) -> Callable[[int, LinkBatching], ModuleClock]:
    if mode is ClockMode.SHARED:
        shared = SharedOffset()
        return lambda _module, _batching: SharedClock(shared)
    warm_up()
    if mode is ClockMode.TABLE and table is not None:
        clocks = TableClocks(table)
        return clocks.clock
    return lambda _module, batching: EstimatedClock(batching)


def _inertial(
    record: ModuleRecord, packet: InertialSample | InertialSampleFine, sequence: int, time_ns: int
) -> Reading:
    clipped = Clipped.SPECIFIC_FORCE if packet.specific_force_clipped else Clipped(0)
    clipped |= Clipped.ANGULAR_RATE if packet.angular_rate_clipped else Clipped(0)
    field = None if packet.magnetic_field_clipped else packet.magnetic_field  # it points elsewhere
    return InertialReading(
        record.module, sequence, time_ns, packet.specific_force, packet.angular_rate, field, int(clipped)
    )


def _fused(record: ModuleRecord, packet: FusedSample, sequence: int, time_ns: int) -> Reading:
    return FusedReading(record.module, sequence, time_ns, packet.orientation)


def _local(record: ModuleRecord, packet: LocalMeasurement, _sequence: int, time_ns: int) -> Reading:
    return LocalReading(
        record.module,
        time_ns,
        Quantity(packet.quantity),
        np.array(packet.value),
        np.array(packet.sigma),
    )


def _light(record: ModuleRecord, packet: LightSample, _sequence: int, time_ns: int) -> Reading:
    return LightReading(record.module, time_ns, np.array(packet.intensity))


def _pressure(record: ModuleRecord, packet: PressureSample, _sequence: int, time_ns: int) -> Reading:
    found = air_velocity(packet.differential_pressure, packet.static_pressure, packet.temperature_celsius)
    return LocalReading(record.module, time_ns, Quantity.AIR_VELOCITY, *found)


def _info(record: ModuleRecord, packet: DeviceInfo, _sequence: int, _time_ns: int) -> None:
    record.info = packet


def _health(record: ModuleRecord, packet: Health, _sequence: int, _time_ns: int) -> None:
    record.health = packet


def _reading(record: ModuleRecord, packet: Packet, sequence: int, time_ns: int) -> Reading | None:
    handler = _HANDLERS.get(type(packet))
    # What has no handler is for the listeners alone; it is counted like the rest.
    return None if handler is None else handler(record, packet, sequence, time_ns)


_HANDLERS: dict[type, Callable[..., Reading | None]] = {
    InertialSample: _inertial,
    InertialSampleFine: _inertial,
    FusedSample: _fused,
    LocalMeasurement: _local,
    LightSample: _light,
    PressureSample: _pressure,
    DeviceInfo: _info,
    Health: _health,
}
