"""Chunks of any link to readings in gateway time: framing → packets → clocks.

One ``SuitSource`` serves the whole suit, since modules may come over several links, or all through a
relay over one. Readings are routed by module id.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator

import numpy as np

from devices.link import Chunk, Framing, SentChunk
from devices.link_decoder import LinkDecoder, SenderDecoders, packet_decoder
from firmware_protocol import (
    PACKETS,
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
from gateway.clocks import TriggerAnswers
from gateway.contract.balances import Balance
from gateway.frames import (
    NOT_READ,
    Clipped,
    FusedReading,
    InertialBatch,
    LightReading,
    LocalReading,
    Quantity,
    Reading,
    Sample,
)
from gateway.sources.air_velocity import air_velocity
from gateway.sources.compiled_decoding import DECODERS, Entries, Follower
from gateway.sources.exchanges import TimeExchanges
from gateway.sources.module_rows import SHARED_KINDS
from gateway.sources.module_table import ModuleTable
from gateway.sources.readings import ReadingCollector
from gateway.sources.source import SourceContext
from gateway.sources.statistics import ModuleRecord

Listener = Callable[[ReceivedPacket, Chunk], None]
"""Called with a packet and the chunk that completed it, at once. Must neither wait nor raise."""


_FORCE_CLIPPED, _RATE_CLIPPED = int(Clipped.SPECIFIC_FORCE), int(Clipped.ANGULAR_RATE)
_TRIGGERED = 1 << 8
"""Added to the kind: triggered samples are counted by themselves, by the triggers' numbers."""


class SuitSource:
    """Decodes, counts and timestamps packets of modules."""

    observes = InertialBatch
    """And all other kinds of reading."""

    def __init__(self, table: ModuleTable | None = None, triggers: TriggerAnswers | None = None) -> None:
        """Begin without links.

        table: shared by all sources; None: one of its own, with estimated clocks.
        triggers: matches answers to triggers in mode TRIGGER; None in any other mode.
        """
        self.triggers = triggers
        self.table = table or ModuleTable()
        self.modules = self.table.records
        self.echoed = 0
        """Packets of a host, ours or another one's, that came back over a bus."""
        # samples of other clocks, and answers to triggers, are all for Python
        self._is_compiled = self.table.is_followed and triggers is None
        self._readings = ReadingCollector()
        self._entries = Entries()
        self._follower = Follower(self.table, self._readings)
        self._decoders: dict[str, LinkDecoder | SenderDecoders[Entries]] = {}
        self._sent_decoders: dict[str, PacketDecoder] = {}
        self._listeners: dict[type[Packet], list[Listener]] = {}
        self._exchanges = TimeExchanges(self.modules)
        self.listen(SyncResponse, self._exchanges.answered)

    @classmethod
    def of(cls, context: SourceContext) -> SuitSource:
        """Return the stream of a suit in its surroundings."""
        return cls(context.modules, context.triggers)

    def add_link(self, name: str, content: str) -> None:
        """Announce a link, before its first chunk. content: its framing."""
        if self._is_compiled:
            decoder = DECODERS[Framing(content)]
            self._decoders[name] = SenderDecoders(lambda: decoder(self._entries))
            decoder(self._entries).feed(b"")  # compiled now, not when the first packets wait
            self._follower.warm_up(self._entries)
        else:
            self._decoders[name] = LinkDecoder(Framing(content))
        self._sent_decoders[name] = packet_decoder(Framing(content))
        self.table.add_link(name)

    def listen(self, packet_class: type[Packet], listener: Listener) -> None:
        """Call ``listener`` with every packet of a class, also with one that came before."""
        self._listeners.setdefault(packet_class, []).append(listener)
        self._share(packet_class.KIND)

    def stop_listening(self, packet_class: type[Packet], listener: Listener) -> None:
        """Undo ``listen``."""
        self._listeners[packet_class].remove(listener)
        self._share(packet_class.KIND)

    def _share(self, kind: int) -> None:
        """Have kernels take the samples of a kind, unless a listener is to see each of them."""
        if kind in SHARED_KINDS:
            self._entries.leave_samples(kind, bool(self._listeners.get(PACKETS[kind])))

    def receive(self, chunk: Chunk) -> list[Reading]:
        """Return the readings that a chunk completes, in order of arrival."""
        decoder = self._decoders[chunk.link]
        packets = decoder.feed(chunk)
        self.table.begin_chunk(chunk, is_trusted=decoder.is_trusted, is_damaged=decoder.is_damaged)
        self._readings.begin(len(packets))
        each = self._follower.others(packets, chunk) if isinstance(packets, Entries) else packets
        for packet in each:
            self._take(packet, chunk)
        return self._readings.end()

    def _take(self, packet: ReceivedPacket, chunk: Chunk) -> None:
        """Pass a packet to its listeners, and add what it reads."""
        for listener in self._listeners.get(type(packet.packet), ()):
            listener(packet, chunk)
        if packet.kind in FROM_HOST:
            self.echoed += 1
            return  # our own, echoed by a bus; its time is that of no module
        read = self._read(packet, chunk)
        if isinstance(read, Sample):
            self._readings.add_sample(read)
        elif read is not None:
            self._readings.add(read)

    @property
    def readings(self) -> int:
        """Readings given out."""
        return self._readings.total

    def decoders(self) -> Iterable[LinkDecoder | SenderDecoders[Entries]]:
        """Return what takes the chunks of each link apart."""
        return self._decoders.values()

    def senders(self, link: str) -> tuple[str, ...]:
        """Return who is to be written to on a link: those who sent something valid lately, by address; nobody
        where there is but one other end."""
        decoder = self._decoders.get(link)
        return () if decoder is None else decoder.senders

    def sender_statistics(self) -> dict[str, dict[str, object]]:
        """Return who sends on each link with several senders, and who else sends there."""
        found = {name: decoder.statistics() for name, decoder in self._decoders.items()}
        return {name: statistics for name, statistics in found.items() if statistics}

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

    def dropped(self) -> dict[str, dict[str, int]]:
        """Return what was dropped, by link and reason."""
        return {
            name: {defect.name.lower(): count for defect, count in decoder.dropped.items()}
            for name, decoder in self._decoders.items()
        }

    def unreadable(self) -> tuple[str, ...]:
        """Return the links on which something came, and nothing of it was a valid packet."""
        return tuple(
            name
            for name, decoder in self._decoders.items()
            if not decoder.accepted and any(decoder.dropped.values())
        )

    def statistics(self) -> dict[str, object]:
        """Return counters for the health message."""
        return {} if self.triggers is None else {"triggers": self.triggers.figures.summary()}

    def balances(self) -> Iterator[Balance]:
        """Yield what came out of the decoders, and the readings given."""
        parts = {"from_host": self.echoed}
        if self.triggers is not None:
            parts["unexpected"] = self.triggers.figures.unexpected
        decoded = sum(decoder.accepted for decoder in self._decoders.values())
        yield Balance("packets_decoded", decoded, parts)
        yield Balance("readings", self.readings, {})

    def _read(self, received: ReceivedPacket, chunk: Chunk) -> Reading | Sample | None:
        record, time_ns = self.table.timed(
            received.module, received.module_time_us, chunk, received.relayed_us
        )
        if self.triggers is not None:
            packet = received.packet
            self.triggers.note_link(received.module, chunk.link)
            if isinstance(packet, InertialSample | InertialSampleFine) and packet.triggered:
                return self._read_triggered(self.triggers, record, received, chunk)
            # A sample without a trigger is still of use, but its instant is an estimate.
            if isinstance(packet, InertialSample | InertialSampleFine | FusedSample):
                self.triggers.sampled_alone(received.module)
        sequence = record.counter(received.kind).count(received.sequence, self.table.losses(chunk.link))
        return None if sequence is None else _reading(record, received.packet, sequence, time_ns)

    def _read_triggered(
        self, triggers: TriggerAnswers, record: ModuleRecord, received: ReceivedPacket, chunk: Chunk
    ) -> Reading | Sample | None:
        """Return the sample that answers a trigger; its instant is the trigger's, whatever the module's clock
        says.
        """
        answer = triggers.answered(received.module, received.sequence, chunk.link, chunk.arrived_ns)
        if answer is None:
            return None
        sequence = record.counter(received.kind | _TRIGGERED).count_unwrapped(
            answer.full, self.table.losses(chunk.link)
        )
        return None if sequence is None else _reading(record, received.packet, sequence, answer.sent_ns)


def _inertial(
    record: ModuleRecord, packet: InertialSample | InertialSampleFine, sequence: int, time_ns: int
) -> Sample:
    clipped = _FORCE_CLIPPED * packet.specific_force_clipped | _RATE_CLIPPED * packet.angular_rate_clipped
    field = None if packet.magnetic_field_clipped else packet.magnetic_field  # it points elsewhere
    measured = packet.specific_force or NOT_READ, packet.angular_rate or NOT_READ, field or NOT_READ
    return Sample(record.module, sequence, time_ns, measured, clipped)


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


def _reading(record: ModuleRecord, packet: Packet, sequence: int, time_ns: int) -> Reading | Sample | None:
    handler = _HANDLERS.get(type(packet))
    # What has no handler is for the listeners alone; it is counted like the rest.
    return None if handler is None else handler(record, packet, sequence, time_ns)


_HANDLERS: dict[type, Callable[..., Reading | Sample | None]] = {
    InertialSample: _inertial,
    InertialSampleFine: _inertial,
    FusedSample: _fused,
    LocalMeasurement: _local,
    LightSample: _light,
    PressureSample: _pressure,
    DeviceInfo: _info,
    Health: _health,
}
