"""What modules say: each packet declared once, with layout, unit and scale beside each field.

Everything is in SI units after decoding, in the sensor's own axes unless a field says otherwise;
a name carries its unit where it is not SI.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from math import radians
from typing import Any, ClassVar, Protocol

from firmware_protocol.codec import BodyCodec
from firmware_protocol.fields import flag, wire
from firmware_protocol.framing import MAX_MODULE, RELAY, Defect, WireFrame
from firmware_protocol.kinds import Kind
from firmware_protocol.relay import RELAY_BATCH, Entry, relay_batch, split_batch

__all__ = [
    "PACKETS",
    "DeviceInfo",
    "Health",
    "InertialSample",
    "InertialSampleFine",
    "LocalMeasurement",
    "Packet",
    "PacketDecoder",
    "ReceivedPacket",
    "Vector3",
    "WireFrameDecoder",
    "decode_body",
    "encode_packet",
    "relay_batch",
    "wire_frame",
]

Vector3 = tuple[float, float, float]

STANDARD_GRAVITY = 9.80665  # m/s²

_SPECIFIC_FORCE = "Specific force; at rest it reads 9.81 m/s² on the axis that points up."
_MAGNETIC_FIELD = "Magnetic field."
_ANGULAR_RATE = "Angular rate."
_ACCELEROMETER_CLIPPED = "An axis of the accelerometer is at the end of its range."
_MAGNETOMETER_CLIPPED = "An axis of the magnetometer is at the end of its range."
_GYROMETER_CLIPPED = "An axis of the gyrometer is at the end of its range."
_TRIGGERED = "Sampled on a trigger of the host, not on the module's own timer."


@dataclass(frozen=True, slots=True)
class InertialSample:
    """One reading of a module's inertial sensors, for streaming."""

    KIND: ClassVar[int] = int(Kind.INERTIAL_SAMPLE)

    specific_force: Vector3 | None = field(
        default=None,
        metadata=wire(
            "h", 3, "m/s²", 16 * STANDARD_GRAVITY / 2**15, presence_bit=0, sentence=_SPECIFIC_FORCE
        ),
    )
    magnetic_field: Vector3 | None = field(
        default=None, metadata=wire("h", 3, "µT", 0.05, presence_bit=1, sentence=_MAGNETIC_FIELD)
    )
    angular_rate: Vector3 | None = field(
        default=None,
        metadata=wire("h", 3, "rad/s", radians(2000) / 2**15, presence_bit=2, sentence=_ANGULAR_RATE),
    )
    specific_force_clipped: bool = field(
        default=False, metadata=flag(4, _ACCELEROMETER_CLIPPED, clips="specific_force")
    )
    magnetic_field_clipped: bool = field(
        default=False, metadata=flag(5, _MAGNETOMETER_CLIPPED, clips="magnetic_field")
    )
    angular_rate_clipped: bool = field(
        default=False, metadata=flag(6, _GYROMETER_CLIPPED, clips="angular_rate")
    )
    triggered: bool = field(default=False, metadata=flag(7, _TRIGGERED))


@dataclass(frozen=True, slots=True)
class InertialSampleFine:
    """The same in finer steps, for laboratory modules and for recordings played without loss."""

    KIND: ClassVar[int] = int(Kind.INERTIAL_SAMPLE_FINE)

    specific_force: Vector3 | None = field(
        default=None, metadata=wire("i", 3, "m/s²", 1e-5, presence_bit=0, sentence=_SPECIFIC_FORCE)
    )
    magnetic_field: Vector3 | None = field(
        default=None, metadata=wire("i", 3, "µT", 1e-4, presence_bit=1, sentence=_MAGNETIC_FIELD)
    )
    angular_rate: Vector3 | None = field(
        default=None, metadata=wire("i", 3, "rad/s", 1e-6, presence_bit=2, sentence=_ANGULAR_RATE)
    )
    specific_force_clipped: bool = field(
        default=False, metadata=flag(4, _ACCELEROMETER_CLIPPED, clips="specific_force")
    )
    magnetic_field_clipped: bool = field(
        default=False, metadata=flag(5, _MAGNETOMETER_CLIPPED, clips="magnetic_field")
    )
    angular_rate_clipped: bool = field(
        default=False, metadata=flag(6, _GYROMETER_CLIPPED, clips="angular_rate")
    )
    triggered: bool = field(default=False, metadata=flag(7, _TRIGGERED))


@dataclass(frozen=True, slots=True)
class LocalMeasurement:
    """One reading of a local measuring device, in world axes (east, north, up)."""

    KIND: ClassVar[int] = int(Kind.LOCAL_MEASUREMENT)

    quantity: int = field(
        metadata=wire(
            "B",
            meanings={1: "acceleration, m/s²", 2: "velocity, m/s", 3: "position, m"},
            sentence="What is measured, and so the unit of the two fields that follow.",
        )
    )
    value: Vector3 = field(metadata=wire("f", 3, "as quantity", sentence="The measured vector."))
    sigma: Vector3 = field(
        metadata=wire("f", 3, "as quantity", minimum=0.0, sentence="Standard deviation of each component.")
    )


@dataclass(frozen=True, slots=True)
class DeviceInfo:
    """Who a module is and what it carries. A sensor that is not there has no range and no rate."""

    KIND: ClassVar[int] = int(Kind.DEVICE_INFO)

    unique_id: bytes = field(metadata=wire("s", 12, sentence="Number of the chip, never the same twice."))
    hardware_version: tuple[int, int] = field(metadata=wire("B", 2, sentence="Major, minor."))
    firmware_version: tuple[int, int, int] = field(metadata=wire("B", 3, sentence="Major, minor, patch."))
    accelerometer_range: float | None = field(
        metadata=wire("H", 1, "m/s²", 0.1, absent=0, sentence="Largest specific force of an axis.")
    )
    gyrometer_range: float | None = field(
        metadata=wire(
            "H",
            1,
            "rad/s",
            radians(1),
            absent=0,
            sentence="Largest angular rate of an axis; one step is 1°/s.",
        )
    )
    magnetometer_range: float | None = field(
        metadata=wire("H", 1, "µT", 1.0, absent=0, sentence="Largest magnetic field of an axis.")
    )
    accelerometer_sampling_rate: float | None = field(
        metadata=wire("H", 1, "Hz", 0.1, absent=0, sentence="Samples of the accelerometer each second.")
    )
    gyrometer_sampling_rate: float | None = field(
        metadata=wire("H", 1, "Hz", 0.1, absent=0, sentence="Samples of the gyrometer each second.")
    )
    magnetometer_sampling_rate: float | None = field(
        metadata=wire("H", 1, "Hz", 0.1, absent=0, sentence="Samples of the magnetometer each second.")
    )


@dataclass(frozen=True, slots=True)
class Health:
    """How a module fares. What a module cannot know has a reserved number. Counters wrap to 0."""

    KIND: ClassVar[int] = int(Kind.HEALTH)

    battery_percent: int | None = field(
        metadata=wire("B", 1, "%", absent=255, maximum=100, sentence="Charge left in the battery.")
    )
    battery_voltage: float | None = field(
        metadata=wire("H", 1, "V", 1e-3, absent=2**16 - 1, sentence="Voltage of the battery.")
    )
    temperature_celsius: float | None = field(
        metadata=wire("h", 1, "°C", 0.01, absent=-(2**15), sentence="Temperature of the inertial sensors.")
    )
    rssi_dbm: int | None = field(
        metadata=wire("b", 1, "dBm", absent=127, sentence="Strength of the radio signal received.")
    )
    uptime_s: int = field(metadata=wire("I", 1, "s", sentence="Time since the last reset."))
    samples_taken: int = field(metadata=wire("I", sentence="Samples taken since the last reset."))
    samples_dropped: int = field(
        metadata=wire("H", sentence="Samples taken that could not be sent since the last reset.")
    )
    sensor_errors: int = field(metadata=wire("H", sentence="Failed readings since the last reset."))
    resets: int = field(metadata=wire("H", sentence="Resets since the firmware was installed."))


Packet = InertialSample | InertialSampleFine | LocalMeasurement | DeviceInfo | Health

PACKETS: dict[int, type[Packet]] = {
    packet_class.KIND: packet_class
    for packet_class in (InertialSample, InertialSampleFine, LocalMeasurement, DeviceInfo, Health)
}
"""Kind to packet."""

_CODECS: dict[int, BodyCodec[Any]] = {kind: BodyCodec(cls) for kind, cls in PACKETS.items()}
_SENDERS = frozenset(range(MAX_MODULE + 1)) | {RELAY}


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


class WireFrameDecoder(Protocol):
    """What ``FrameDecoder`` and ``CanFrameDecoder`` have in common."""

    dropped: Counter[Defect]
    accepted: int

    def feed(self, chunk: bytes) -> list[WireFrame]: ...


def encode_packet(packet: Packet) -> bytes:
    """The body of a packet.

    Inertial readings beyond the range are sent as its end, and marked clipped. Any other value that
    cannot be sent (not finite, out of range, clipped but absent) raises ValueError naming its field.
    """
    return _CODECS[packet.KIND].encode(packet)


def decode_body(kind: int, body: bytes) -> Packet | Defect:
    """The packet that a body holds, or why it holds none. Never raises."""
    codec = _CODECS.get(kind)
    return Defect.UNKNOWN_KIND if codec is None else codec.decode(body)


def wire_frame(packet: Packet, module: int, sequence: int, module_time_us: int) -> WireFrame:
    """The wire frame in which a module sends a packet. Raises ValueError as ``encode_packet``."""
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

    def feed(self, chunk: bytes) -> list[ReceivedPacket]:
        """The packets that this chunk completes, in order."""
        received: list[ReceivedPacket] = []
        for frame in self._frames.feed(chunk):
            if frame.kind == RELAY_BATCH:
                self._expand(frame, received)
            else:
                entry = frame.kind, frame.module, frame.sequence, frame.module_time_us, frame.body
                self._decode(entry, received)
        self.accepted += len(received)
        return received

    def _expand(self, batch: WireFrame, received: list[ReceivedPacket]) -> None:
        if batch.module != RELAY:
            self._dropped[Defect.BAD_MODULE] += 1
            return
        entries, is_truncated = split_batch(batch.body)
        for entry in entries:
            self._decode(entry, received)
        if is_truncated:
            self._dropped[Defect.TRUNCATED] += 1

    def _decode(self, entry: Entry, received: list[ReceivedPacket]) -> None:
        kind, module, sequence, module_time_us, body = entry
        packet = decode_body(kind, body) if module in _SENDERS else Defect.BAD_MODULE
        if type(packet) is Defect:
            self._dropped[packet] += 1
        else:
            received.append(ReceivedPacket(kind, module, sequence, module_time_us, packet))
