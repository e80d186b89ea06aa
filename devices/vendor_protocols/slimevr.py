"""Datagrams between SlimeVR trackers and their server, both ways, to values and back.

Everything is big-endian. A tracker sends a u32 kind and a u64 number that grows by one with each datagram,
then what the kind says; kinds 100 and 101 bundle several. The server sends the same with number 0, but for
its answer to a handshake (the byte 3 and a text) and to a sensor's information (kind, sensor, state). UDP has
a sum of its own over a datagram, the protocol has none: a message is believed for its length, for values that
a tracker can measure and for a number that follows on those before (packet layouts of protocol version 22, as
in the server's ``trackers/udp`` and the tracker's ``network`` folders).
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from enum import IntEnum

from devices.vendor_protocols.plausibility import Gate, either_way, fault
from devices.vendor_protocols.rotations import Quaternion

PORT = 6969
"""UDP port of the server, on which trackers look for it by broadcast."""
VERSION = 22
"""Of the protocol; trackers that name an older one send acceleration in other axes than orientation."""
BUNDLES, COMPACT_BUNDLES = 1, 2
"""Features of a server: bits of its flags."""
MAGNETOMETER = 1
"""The setting of kinds 24 and 25 that switches it."""
ALL_SENSORS = 255


class Kind(IntEnum):
    """What a datagram, or a part of a bundle, holds."""

    HEARTBEAT = 0
    ROTATION = 1  # from the server: its heartbeat
    HANDSHAKE = 3
    ACCELERATION = 4
    PING = 10
    BATTERY = 12
    TAP = 13
    ERROR = 14
    SENSOR_INFO = 15
    SECOND_ROTATION = 16
    ROTATION_DATA = 17
    SIGNAL = 19
    TEMPERATURE = 20
    USER_ACTION = 21
    FEATURES = 22
    ROTATION_AND_ACCELERATION = 23
    SETTING_DONE = 24
    SET_SETTING = 25
    BUNDLE = 100
    COMPACT_BUNDLE = 101


_UNUSED = frozenset((*range(5, 10), 11, 13, 14, 18, 21, 26, 27, 28, 29, 30, 105, 200))
"""Kinds that nothing is made from: raw rotations of old, text for a screen, taps, inspection, fingers."""
_NORMAL = 1
"""Of a rotation that is measured; others correct one of old."""
_HEAD = struct.Struct(">IQ")
_GREETING = b"\x03Hey OVR =D 5"
_GREETING_SIZE = 64
_Q15, _Q7 = 32768.0, 128.0
_FORWARD = 1000
"""A number may run ahead by so many lost datagrams; what does not follow is believed once ``_AGREED`` in a
row follow on each other: the tracker began anew, or was away. A single one is damage, or overtaken."""
_AGREED = 3

_Reader = Callable[[int, bytes], "Iterable[Message]"]
"""Number of a datagram and payload to messages. Raises ``struct.error`` for a wrong length."""
Vector = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Handshake:
    """A tracker looks for its server."""

    version: int
    firmware: str
    mac: str
    """Twelve hexadecimal digits; empty where it names none."""
    imu: int = 0
    board: int = 0
    mcu: int = 0


@dataclass(frozen=True, slots=True)
class Rotation:
    """Orientation of one sensor: its axes to a level reference of its own, z up."""

    number: int
    """Of the datagram."""
    sensor: int
    orientation: Quaternion  # w x y z, as sent; its norm is near 1


@dataclass(frozen=True, slots=True)
class Acceleration:
    """Linear acceleration of one sensor, gravity removed, m/s²."""

    number: int
    sensor: int
    acceleration: Vector


@dataclass(frozen=True, slots=True)
class SensorInfo:
    """A sensor presents itself, again and again until it is acknowledged."""

    sensor: int
    state: int
    """0 off, 1 well, 2 ill."""
    imu: int
    settings: int
    """Bit 0: its magnetometer is on; bit 1: it can be."""


@dataclass(frozen=True, slots=True)
class Pong:
    """A ping, returned."""

    token: int


@dataclass(frozen=True, slots=True)
class Battery:
    """Charge of the battery."""

    voltage: float
    share: float


@dataclass(frozen=True, slots=True)
class Signal:
    """Strength of the wireless signal."""

    dbm: int


@dataclass(frozen=True, slots=True)
class Temperature:
    """Temperature of a sensor."""

    sensor: int
    celsius: float


@dataclass(frozen=True, slots=True)
class Features:
    """What the firmware can do: bits."""

    flags: int


@dataclass(frozen=True, slots=True)
class SettingDone:
    """A setting was taken."""

    sensor: int
    setting: int


Message = (
    Handshake
    | Rotation
    | Acceleration
    | SensorInfo
    | Pong
    | Battery
    | Signal
    | Temperature
    | Features
    | SettingDone
)

_ACCELERATION = (either_way("acceleration_beyond_sensor", 320.0),) * 3  # m/s²; the accelerometers end at 16 g
_SHARE, _VOLTAGE = Gate("implausible_status", 0.0, 1.5), Gate("implausible_status", 0.0, 30.0)
_CELSIUS = (Gate("implausible_status", -60.0, 150.0),)
_DBM = (Gate("implausible_status", -127.0, 0.0),)
_NORM = (Gate("not_a_rotation", 1.0 - 4e-4, 1.0 + 4e-4),)
"""Square of a quaternion's norm: firmware sends unit ones, in float32 or 16 bits."""


class SlimevrDecoder:
    """The datagrams of one tracker."""

    def __init__(self) -> None:
        self.dropped: Counter[str] = Counter()
        """bad_header, bad_length, unknown_kind, out_of_order, repeated, leap_in_number, not_finite,
        not_a_rotation, acceleration_beyond_sensor, implausible_status."""
        self.unused = 0
        """Messages of kinds that nothing is made from."""
        self.missed = 0
        """Datagrams that have not come, or came too late, by the numbers of those that did."""
        self._newest = -1
        self._doubtful = -1
        self._agreed = 0

    def feed(self, datagram: bytes) -> list[Message]:
        """Return the messages of a datagram."""
        if len(datagram) < _HEAD.size:
            self.dropped["bad_length"] += 1
            return []
        kind, number = _HEAD.unpack_from(datagram)
        if kind > 0xFF:
            self.dropped["bad_header"] += 1
            return []
        parts = self._parts(kind, datagram[_HEAD.size :])
        if parts is None:
            self.dropped["bad_length"] += 1
            return []
        # A tracker that was restarted counts from anew, and greets first.
        if number == 0 and kind == Kind.HANDSHAKE:
            self._newest, self._agreed = -1, 0
        elif not (number == 0 and kind == Kind.PING) and not self._follows(number):
            return []
        return [message for each, payload in parts for message in self._read(each, payload, number)]

    def _parts(self, kind: int, payload: bytes) -> list[tuple[int, bytes]] | None:
        """Return what a datagram consists of; None where lengths do not add up."""
        if kind not in (Kind.BUNDLE, Kind.COMPACT_BUNDLE):
            return [(kind, payload)]
        parts, place = [], 0
        size, head = (2, 4) if kind == Kind.BUNDLE else (1, 1)
        while place < len(payload):
            length = int.from_bytes(payload[place : place + size], "big")
            end = place + size + length
            if length < head or end > len(payload):
                return None
            part = payload[place + size : end]
            parts.append((int.from_bytes(part[:head], "big"), part[head:]))
            place = end
        return parts

    def _follows(self, number: int) -> bool:
        ahead = number - self._newest
        if self._newest < 0 or 0 < ahead <= _FORWARD:
            self.missed += ahead - 1 if self._newest >= 0 else 0
            self._newest, self._agreed = number, 0
            return True
        # A single strange number is damage; several that follow one another are the tracker's new count.
        is_next = 0 < number - self._doubtful <= _AGREED
        self._agreed = self._agreed + 1 if self._agreed and is_next else 1
        self._doubtful = number
        if self._agreed >= _AGREED and number < 1 << 63:
            self._newest, self._agreed = number, 0
            return True
        if -_FORWARD < ahead <= 0:
            self.dropped["out_of_order" if ahead else "repeated"] += 1
        else:
            self.dropped["leap_in_number"] += 1
        return False

    def _read(self, kind: int, payload: bytes, number: int) -> Iterator[Message]:
        reader = _READERS.get(kind)
        if reader is None:
            if kind in _UNUSED or kind == Kind.HEARTBEAT:
                self.unused += kind != Kind.HEARTBEAT
            else:
                self.dropped["unknown_kind"] += 1
            return
        try:
            found = reader(number, payload)
        except struct.error:
            self.dropped["bad_length"] += 1
            return
        for message in found:
            reason = _fault(message)
            if reason is None:
                yield message
            else:
                self.dropped[reason] += 1


def _fault(message: Message) -> str | None:
    """Name what is wrong with a message; None: a tracker can have sent it."""
    values: tuple[float, ...] = ()
    gates: tuple[Gate, ...] = ()
    match message:
        case Rotation(orientation=orientation):
            values, gates = (sum(part * part for part in orientation),), _NORM
        case Acceleration(acceleration=acceleration):
            values, gates = acceleration, _ACCELERATION
        case Battery(voltage, share):
            values, gates = (voltage, share), (_VOLTAGE, _SHARE)
        case Temperature(celsius=celsius):
            values, gates = (celsius,), _CELSIUS
        case Signal(dbm):
            values, gates = (dbm,), _DBM
    return fault(values, gates)


def _handshake(_number: int, payload: bytes) -> Iterable[Message]:
    board, imu, mcu, _, _, _, version, length = struct.unpack_from(">7IB", payload)
    begin = struct.calcsize(">7IB")
    text, rest = payload[begin : begin + length], payload[begin + length :]
    if len(text) != length or len(rest) < 6:
        raise struct.error
    firmware = "".join(chr(byte) for byte in text if 32 <= byte < 127)
    mac = rest[:6].hex() if any(rest[:6]) else ""
    return (Handshake(version, firmware, mac, imu, board, mcu),)


def _acceleration(number: int, payload: bytes) -> Iterable[Message]:
    if len(payload) == 12:  # a phone, which has one sensor
        payload += b"\0"
    x, y, z, sensor = struct.unpack(">3fB", payload)
    return (Acceleration(number, sensor, (x, y, z)),)


def _rotation_of(sensor: int) -> _Reader:
    def read(number: int, payload: bytes) -> Iterable[Message]:
        x, y, z, w = struct.unpack(">4f", payload)
        return (Rotation(number, sensor, (w, x, y, z)),)

    return read


def _rotation_data(number: int, payload: bytes) -> Iterable[Message]:
    sensor, kind, x, y, z, w, _ = struct.unpack(">2B4fB", payload)
    return (Rotation(number, sensor, (w, x, y, z)),) if kind == _NORMAL else ()


def _both(number: int, payload: bytes) -> Iterable[Message]:
    sensor, *values = struct.unpack(">B7h", payload)
    x, y, z, w = (value / _Q15 for value in values[:4])
    a, b, c = (value / _Q7 for value in values[4:])
    return Rotation(number, sensor, (w, x, y, z)), Acceleration(number, sensor, (a, b, c))


def _sensor_info(_number: int, payload: bytes) -> Iterable[Message]:
    sensor, state = struct.unpack_from(">2B", payload)
    imu = payload[2] if len(payload) > 2 else 0
    settings = int.from_bytes(payload[3:5], "big") if len(payload) > 4 else 0
    return (SensorInfo(sensor, state, imu, settings),)


def _ping(_number: int, payload: bytes) -> Iterable[Message]:
    return (Pong(*struct.unpack(">I", payload)),)


def _battery(_number: int, payload: bytes) -> Iterable[Message]:
    if len(payload) == 4:
        return (Battery(0.0, *struct.unpack(">f", payload)),)
    return (Battery(*struct.unpack(">2f", payload)),)


def _signal(_number: int, payload: bytes) -> Iterable[Message]:
    _, dbm = struct.unpack(">Bb", payload)
    return (Signal(dbm),)


def _temperature(_number: int, payload: bytes) -> Iterable[Message]:
    return (Temperature(*struct.unpack(">Bf", payload)),)


def _features(_number: int, payload: bytes) -> Iterable[Message]:
    if not 0 < len(payload) <= 16:
        raise struct.error
    return (Features(int.from_bytes(payload, "little")),)


def _setting_done(_number: int, payload: bytes) -> Iterable[Message]:
    return (SettingDone(*struct.unpack(">BH", payload)),)


_READERS: dict[int, _Reader] = {
    Kind.ROTATION: _rotation_of(0),
    Kind.SECOND_ROTATION: _rotation_of(1),
    Kind.HANDSHAKE: _handshake,
    Kind.ACCELERATION: _acceleration,
    Kind.PING: _ping,
    Kind.BATTERY: _battery,
    Kind.SENSOR_INFO: _sensor_info,
    Kind.ROTATION_DATA: _rotation_data,
    Kind.SIGNAL: _signal,
    Kind.TEMPERATURE: _temperature,
    Kind.FEATURES: _features,
    Kind.ROTATION_AND_ACCELERATION: _both,
    Kind.SETTING_DONE: _setting_done,
}


def encode(kind: int, number: int = 0, payload: bytes = b"") -> bytes:
    """Return a datagram."""
    return _HEAD.pack(kind, number) + payload


def encode_bundle(number: int, parts: Iterable[tuple[int, bytes]]) -> bytes:
    """Return a datagram of several messages, each a kind and a payload."""
    each = ((struct.pack(">I", kind) + payload) for kind, payload in parts)
    return encode(Kind.BUNDLE, number, b"".join(struct.pack(">H", len(part)) + part for part in each))


def handshake(sent: Handshake) -> bytes:
    """Return the payload of a handshake."""
    text = sent.firmware.encode("ascii")
    numbers = (sent.board, sent.imu, sent.mcu, 0, 0, 0, sent.version, len(text))
    return struct.pack(">7IB", *numbers) + text + bytes.fromhex(sent.mac or "00" * 6)


def rotation_data(sensor: int, orientation: Quaternion) -> bytes:
    """Return the payload of a rotation. orientation: w x y z."""
    w, x, y, z = orientation
    return struct.pack(">2B4fB", sensor, _NORMAL, x, y, z, w, 0)


def acceleration(sensor: int, linear: Vector) -> bytes:
    """Return the payload of an acceleration, m/s²."""
    return struct.pack(">3fB", *linear, sensor)


def rotation_and_acceleration(sensor: int, orientation: Quaternion, linear: Vector) -> bytes:
    """Return the payload of both in steps of 2⁻¹⁵ and 2⁻⁷ m/s²."""
    w, x, y, z = orientation
    turned = (_short(part * _Q15) for part in (x, y, z, w))
    return struct.pack(">B7h", sensor, *turned, *(_short(part * _Q7) for part in linear))


def sensor_info(info: SensorInfo) -> bytes:
    """Return the payload in which a sensor presents itself."""
    return struct.pack(">3BH3B", info.sensor, info.state, info.imu, info.settings, 0, 0, 0)


def battery(charge: Battery) -> bytes:
    """Return the payload of a battery."""
    return struct.pack(">2f", charge.voltage, charge.share)


def signal(dbm: int) -> bytes:
    """Return the payload of a signal strength."""
    return struct.pack(">Bb", ALL_SENSORS, dbm)


def temperature(measured: Temperature) -> bytes:
    """Return the payload of a temperature."""
    return struct.pack(">Bf", measured.sensor, measured.celsius)


def setting_done(done: SettingDone) -> bytes:
    """Return the payload that says a setting was taken."""
    return struct.pack(">BH", done.sensor, done.setting)


def _short(value: float) -> int:
    return min(max(round(value), -32768), 32767)


GREETING = _GREETING.ljust(_GREETING_SIZE, b"\0")
"""Answer of a server to a handshake."""


def acknowledge(sensor: int, state: int) -> bytes:
    """Return a server's answer to what a sensor says of itself."""
    return struct.pack(">I2B", Kind.SENSOR_INFO, sensor, state)


def ping(token: int) -> bytes:
    """Return a ping, which the tracker returns whole."""
    return encode(Kind.PING, 0, struct.pack(">I", token))


def set_setting(sensor: int, setting: int, value: bool) -> bytes:
    """Return what switches a setting of a tracker."""
    return encode(Kind.SET_SETTING, 0, struct.pack(">BHB", sensor, setting, value))


@dataclass(frozen=True, slots=True)
class Greeting:
    """A server takes a tracker on."""


@dataclass(frozen=True, slots=True)
class FromServer:
    """Anything else that a server sends."""

    kind: int
    payload: bytes


def read_from_server(datagram: bytes) -> Greeting | FromServer | None:
    """Return what a server says; None for what no server sends."""
    if datagram.startswith(_GREETING):
        return Greeting()
    if len(datagram) < 4 or any(datagram[:3]):
        return None
    kind = datagram[3]
    if kind == Kind.SENSOR_INFO and len(datagram) == 6:
        return FromServer(kind, datagram[4:])
    return FromServer(kind, datagram[_HEAD.size :]) if len(datagram) >= _HEAD.size else None
