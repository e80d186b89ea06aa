"""Every packet by its kind, and chunks of a link to packets."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Any, Protocol, get_args

from firmware_protocol.codec import BodyCodec
from firmware_protocol.framing import BROADCAST, MAX_MODULE, RELAY, Defect, Entry, WireFrame
from firmware_protocol.kinds import FROM_HOST
from firmware_protocol.messages import (
    Acknowledgement,
    Command,
    DeviceInfo,
    Event,
    Health,
    LogLine,
    SamplingTrigger,
    SyncRequest,
    SyncResponse,
    TransferToHost,
    TransferToModule,
)
from firmware_protocol.relay import RELAY_BATCH, relay_batch, split_batch
from firmware_protocol.samples import (
    FusedSample,
    InertialSample,
    InertialSampleFine,
    LightSample,
    LocalMeasurement,
    PassThrough,
    PressureSample,
    Quaternion,
    Vector3,
)

__all__ = [
    "PACKETS",
    "Acknowledgement",
    "Command",
    "DeviceInfo",
    "Event",
    "FusedSample",
    "Health",
    "InertialSample",
    "InertialSampleFine",
    "LightSample",
    "LocalMeasurement",
    "LogLine",
    "Packet",
    "PacketDecoder",
    "PassThrough",
    "PressureSample",
    "Quaternion",
    "ReceivedPacket",
    "SamplingTrigger",
    "SyncRequest",
    "SyncResponse",
    "TransferToHost",
    "TransferToModule",
    "Vector3",
    "WireFrameDecoder",
    "decode_body",
    "encode_packet",
    "relay_batch",
    "wire_frame",
]

Packet = (
    InertialSample
    | InertialSampleFine
    | FusedSample
    | LocalMeasurement
    | LightSample
    | PressureSample
    | PassThrough
    | DeviceInfo
    | Health
    | Event
    | LogLine
    | SyncRequest
    | SyncResponse
    | SamplingTrigger
    | Command
    | Acknowledgement
    | TransferToModule
    | TransferToHost
)

PACKETS: dict[int, type[Packet]] = {packet_class.KIND: packet_class for packet_class in get_args(Packet)}
"""Kind to packet."""

_CODECS: dict[int, BodyCodec[Any]] = {kind: BodyCodec(cls) for kind, cls in PACKETS.items()}
_SENDERS = frozenset(range(MAX_MODULE + 1)) | {RELAY}
_RECEIVED = {
    kind: (codec.decode, _SENDERS | {BROADCAST} if kind in FROM_HOST else _SENDERS)
    for kind, codec in _CODECS.items()
}
"""By kind, what decodes it, and the ids that a header may hold: of the module that sends, or is meant."""


@dataclass(frozen=True, slots=True)
class ReceivedPacket:
    """A packet with the header it came under."""

    kind: int
    module: int
    sequence: int
    """Count of the module's packets of this kind, modulo 2^16."""
    module_time_us: int
    """Module's clock at the moment of sampling, µs modulo 2^32."""
    packet: Packet
    relayed_us: int | None = None
    """Relay's clock when it sent the batch that held the packet, µs modulo 2^32; None: came by itself."""


class WireFrameDecoder(Protocol):
    """What ``FrameDecoder`` and ``CanFrameDecoder`` have in common."""

    dropped: Counter[Defect]
    accepted: int

    def entries(self, chunk: bytes) -> list[Entry]:
        """Return what a chunk completes, in order: headers and bodies, checked."""


def encode_packet(packet: Packet) -> bytes:
    """Return the body of a packet.

    Inertial readings beyond the range are sent as its end, and marked clipped. Any other value that
    cannot be sent (not finite, out of range, clipped but absent) raises ValueError naming its field.
    """
    return _CODECS[packet.KIND].encode(packet)


def decode_body(kind: int, body: bytes) -> Packet | Defect:
    """Return the packet that a body holds, or why it holds none. Never raises."""
    codec = _CODECS.get(kind)
    return Defect.UNKNOWN_KIND if codec is None else codec.decode(body)


def wire_frame(packet: Packet, module: int, sequence: int, module_time_us: int) -> WireFrame:
    """Return the wire frame of a packet that ``module`` sends, or that the host sends to it.

    Raises ValueError as ``encode_packet``.
    """
    return WireFrame(packet.KIND, module, sequence, module_time_us, encode_packet(packet))


class PacketDecoder:
    """Chunks of a link to packets; relay batches come out as the packets they hold.

    ``feed`` never raises; it counts what it drops.
    """

    def __init__(self, frames: WireFrameDecoder) -> None:
        self.accepted = 0
        """Packets handed out."""
        self._frames = frames
        self._dropped: Counter[Defect] = Counter()

    @property
    def dropped(self) -> Counter[Defect]:
        """What was dropped by reason, wire frames and packets together."""
        return self._frames.dropped + self._dropped

    @property
    def damaged(self) -> int:
        """How many drops there were that packets of ours may have been lost in."""
        frames = self._frames.dropped
        if not frames and not self._dropped:
            return 0  # asked twice a chunk, and mostly so
        return frames.total() + self._dropped.total() - frames[Defect.FOREIGN]

    def feed(self, chunk: bytes) -> list[ReceivedPacket]:
        """Return the packets that this chunk completes, in order."""
        return self._receive(self._frames.entries(chunk))

    def take(self, frame: WireFrame) -> list[ReceivedPacket]:
        """Return the packets of a wire frame that came another way, such as by ``TransferReceiver``."""
        return self._receive([(frame.kind, frame.module, frame.sequence, frame.module_time_us, frame.body)])

    def _receive(self, entries: list[Entry]) -> list[ReceivedPacket]:
        received: list[ReceivedPacket] = []
        for entry in entries:
            if entry[0] == RELAY_BATCH:
                self._expand(entry, received)
            else:
                self._take_entry(entry, received)
        self.accepted += len(received)
        return received

    def _expand(self, batch: Entry, received: list[ReceivedPacket]) -> None:
        _, module, _, relayed_us, body = batch
        if module != RELAY:
            self._dropped[Defect.BAD_MODULE] += 1
            return
        entries, is_truncated = split_batch(body)
        for entry in entries:
            self._take_entry(entry, received, relayed_us)
        if is_truncated:
            self._dropped[Defect.TRUNCATED] += 1

    def _take_entry(
        self, entry: Entry, received: list[ReceivedPacket], relayed_us: int | None = None
    ) -> None:
        packet = self.decode(entry, relayed_us)
        if packet is not None:
            received.append(packet)

    def decode(self, entry: Entry, relayed_us: int | None = None) -> ReceivedPacket | None:
        """Return the packet of a wire frame that is no batch, or of an entry of one; None where it was
        dropped."""
        kind, module, sequence, module_time_us, body = entry
        known = _RECEIVED.get(kind)
        if known is None:
            packet: Packet | Defect = Defect.UNKNOWN_KIND
        else:
            decode, modules = known
            packet = decode(body) if module in modules else Defect.BAD_MODULE
        if type(packet) is Defect:
            self._dropped[packet] += 1
            return None
        return ReceivedPacket(kind, module, sequence, module_time_us, packet, relayed_us)
