"""Messages of the x-IMU3 (x-io Technologies), binary and ASCII, to values and back.

A message ends with LF. The binary ones begin with 0x80 + the letter of their kind, then a u64 of microseconds
and float32 values, little-endian, with LF and ESC inside replaced as in SLIP; the ASCII ones are
``letter,microseconds,values``. Commands and their answers are JSON of one key, ``{"key":value}``. There is no
checksum: a message is believed for its length, for values that the device can measure and for a stamp that
follows on those before it (user manual v0.11, sections on data messages, commands and network discovery).
"""

from __future__ import annotations

import ipaddress
import json
import struct
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from devices.vendor_protocols.plausibility import Gate, either_way, fault

LF, ESCAPE = b"\n", b"\xdb"
_STUFFED = {ESCAPE: b"\xdb\xdd", LF: b"\xdb\xdc"}  # in this order, when stuffing
LONGEST = 4096
"""Bytes of one message; the device has no longer ones."""
LEAP_US = 2_000_000
"""A stamp this far from the newest is believed once a second one agrees with it: the device began anew, or
was silent. A single one is damage."""
DISCOVERY_PORT = 10000
"""UDP port that devices in the network announce themselves on, every second."""
COMMAND_PORT = 9000
"""UDP port on which a device takes commands, unless it is set otherwise."""
INERTIAL_HZ, MAGNETIC_HZ = 400, 20
"""Rates of the sensors, which the divisors in the settings divide."""

RATE_SETTINGS = "inertial_message_rate_divisor", "magnetometer_message_rate_divisor"
SETTINGS = (
    "device_name",
    "serial_number",
    "firmware_version",
    "binary_mode_enabled",
    *RATE_SETTINGS,
    "ahrs_message_rate_divisor",
    "high_g_accelerometer_message_rate_divisor",
    "synchronisation_enabled",
    "udp_send_port",
    "udp_receive_port",
)
"""Settings that matter to a gateway; a device has many more, which can be read and set by name."""


@dataclass(frozen=True, slots=True)
class Inertial:
    """One sample of gyroscope and accelerometer."""

    time_us: int
    angular_rate: tuple[float, float, float]  # deg/s
    specific_force: tuple[float, float, float]  # g


@dataclass(frozen=True, slots=True)
class Magnetic:
    """One sample of the magnetometer."""

    time_us: int
    field: tuple[float, float, float]  # of the field at its calibration


@dataclass(frozen=True, slots=True)
class Battery:
    """Charge of the battery."""

    time_us: int
    percent: float
    voltage: float


@dataclass(frozen=True, slots=True)
class Radio:
    """Strength of the wireless signal."""

    time_us: int
    percent: float
    power_dbm: float


@dataclass(frozen=True, slots=True)
class Temperature:
    """Temperature of the device."""

    time_us: int
    celsius: float


@dataclass(frozen=True, slots=True)
class Answer:
    """What a device answers to a command, under the key of the command."""

    key: str
    value: Any


Message = Inertial | Magnetic | Battery | Radio | Temperature | Answer


_RATE = either_way("rate_beyond_sensor", 2100.0)  # deg/s; the gyroscope ends at 2000
_FORCE = either_way("force_beyond_sensor", 25.0)  # g; the accelerometer ends at 24
_FIELD = either_way("field_beyond_sensor", 100.0)  # fields of calibration
_PERCENT = Gate("implausible_status", 0.0, 100.0)
_GATES: dict[bytes, tuple[Gate, ...]] = {
    b"I": (_RATE,) * 3 + (_FORCE,) * 3,
    b"M": (_FIELD,) * 3,
    b"B": (_PERCENT, Gate("implausible_status", 0.0, 10.0), Gate("implausible_status", 0.0, 4.0)),
    b"W": (_PERCENT, Gate("implausible_status", -200.0, 50.0)),
    b"T": (Gate("implausible_status", -60.0, 150.0),),
}
"""The numbers after the stamp, by the letter of the message."""
_UNUSED = frozenset(b"QRALEHUSYCONF")
"""Letters of messages that nothing is made from: orientations and the like of its own, accessories, notes."""


def encode_binary(letter: bytes, time_us: int, values: Sequence[float]) -> bytes:
    """Return a binary data message, with its LF."""
    content = bytes((0x80 | letter[0],)) + struct.pack(f"<Q{len(values)}f", time_us, *values)
    for byte, instead in _STUFFED.items():
        content = content.replace(byte, instead)
    return content + LF


def encode_text(letter: bytes, time_us: int, values: Sequence[float]) -> bytes:
    """Return an ASCII data message, with its CR and LF."""
    return b"%s,%d,%s\r\n" % (letter, time_us, ",".join(f"{value:.4f}" for value in values).encode())


def encode_command(key: str, value: object = None) -> bytes:
    """Return a command, or the answer to one; without a value it asks for a setting, or acts."""
    return json.dumps({key: value}, separators=(",", ":")).encode() + b"\r\n"


class Ximu3Decoder:
    """The stream of one device."""

    def __init__(self) -> None:
        self.dropped: Counter[str] = Counter()
        """bad_json, bad_length, bad_number, bad_stuffing, implausible_status, leap_in_time, not_finite,
        too_long, unknown_kind, and what is beyond a sensor: rate, force, field."""
        self.unused = 0
        """Messages of kinds that nothing is made from."""
        self._rest = b""
        self._newest_us: int | None = None
        self._doubtful_us: int | None = None

    def feed(self, data: bytes) -> list[Message]:
        """Return the messages that these bytes complete, in order."""
        # Stuffing keeps the end of line out of binary messages, so it ends every message.
        *complete, self._rest = (self._rest + data).split(LF)
        if len(self._rest) > LONGEST:
            self.dropped["too_long"] += 1
            self._rest = b""
        found = []
        for message in complete:
            read = self._read(message) if message.strip() else None
            if read is not None:
                found.append(read)
        return found

    def _read(self, message: bytes) -> Message | None:
        first = message[0]
        letter = bytes((first & 0x7F,))
        if letter in _GATES:
            # The top bit of the first byte marks a binary message; the letter is the same.
            numbers = self._binary(message, letter) if first >= 0x80 else self._text(message, letter)
            return None if numbers is None else self._judged(letter, *numbers)
        if first == ord("{"):
            return self._answer(message)
        if letter[0] in _UNUSED or first == ord("^"):
            self.unused += 1
        else:
            self.dropped["unknown_kind"] += 1
        return None

    def _binary(self, message: bytes, letter: bytes) -> tuple[int, tuple[float, ...]] | None:
        content = message
        # Undone in the reverse order, or an escaped escape would be undone twice.
        for byte, instead in reversed(_STUFFED.items()):
            content = content.replace(instead, byte)
        if message.count(ESCAPE) != message.count(b"\xdb\xdc") + message.count(b"\xdb\xdd"):
            self.dropped["bad_stuffing"] += 1
            return None
        size = len(_GATES[letter])
        if len(content) != 9 + 4 * size:
            self.dropped["bad_length"] += 1
            return None
        time_us, *values = struct.unpack(f"<Q{size}f", content[1:])
        return time_us, tuple(values)

    def _text(self, message: bytes, letter: bytes) -> tuple[int, tuple[float, ...]] | None:
        _, *words = message.rstrip(b"\r").split(b",")
        if len(words) != 1 + len(_GATES[letter]):
            self.dropped["bad_length"] += 1
            return None
        try:
            return int(words[0]), tuple(map(float, words[1:]))
        except ValueError:
            self.dropped["bad_number"] += 1
            return None

    def _answer(self, message: bytes) -> Answer | None:
        pair = _single_pair(message)
        if pair is None:
            self.dropped["bad_json"] += 1
            return None
        return Answer(*pair)

    def _judged(self, letter: bytes, time_us: int, values: tuple[float, ...]) -> Message | None:
        reason = fault(values, _GATES[letter]) or self._fault_of_stamp(time_us)
        if reason is not None:
            self.dropped[reason] += 1
            return None
        if letter == b"I":
            a, b, c, d, e, f = values
            return Inertial(time_us, (a, b, c), (d, e, f))
        if letter == b"M":
            a, b, c = values
            return Magnetic(time_us, (a, b, c))
        if letter == b"T":
            return Temperature(time_us, values[0])
        return (Battery if letter == b"B" else Radio)(time_us, values[0], values[1])

    def _fault_of_stamp(self, time_us: int) -> str | None:
        newest_us, self._doubtful_us, doubtful_us = self._newest_us, None, self._doubtful_us
        if newest_us is None or abs(time_us - newest_us) <= LEAP_US:
            follows = True
        else:
            follows = doubtful_us is not None and abs(time_us - doubtful_us) <= LEAP_US
        if follows and 0 <= time_us < 2**63:
            self._newest_us = time_us
            return None
        self._doubtful_us = time_us
        return "leap_in_time"


def _single_pair(message: bytes) -> tuple[str, Any] | None:
    """Return key and value of JSON that has one; None for anything else."""
    try:
        content = json.loads(message)
    except (ValueError, RecursionError):
        return None
    if not isinstance(content, dict) or len(content) != 1:
        return None
    return next(iter(content.items()))


@dataclass(frozen=True, slots=True)
class Announcement:
    """A device in the network, as it announces itself."""

    name: str
    serial_number: str
    address: str
    tcp_port: int
    send_port: int
    """UDP port that it sends to."""
    receive_port: int
    """UDP port on which it takes commands."""
    battery_percent: int | None
    rssi_percent: int | None


def encode_announcement(announced: Announcement) -> bytes:
    """Return the datagram in which a device announces itself."""
    content = {
        "name": announced.name,
        "sn": announced.serial_number,
        "ip": announced.address,
        "port": announced.tcp_port,
        "send": announced.send_port,
        "receive": announced.receive_port,
        "rssi": announced.rssi_percent,
        "battery": announced.battery_percent,
        "status": 0,
    }
    return json.dumps(content, separators=(",", ":")).encode()


def read_announcement(data: bytes) -> Announcement | None:
    """Return what a datagram on the discovery port announces; None for one that is no announcement."""
    try:
        content = json.loads(data)
        ports = [int(content[key]) for key in ("port", "send", "receive")]
        levels = [_level(content.get(key)) for key in ("battery", "rssi")]
        words = [str(content["name"]), str(content["sn"]), str(ipaddress.ip_address(content["ip"]))]
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError):
        return None
    if not all(0 <= port < 2**16 for port in ports) or not all(0 < len(word) <= 64 for word in words):
        return None
    return Announcement(words[0], words[1], words[2], ports[0], ports[1], ports[2], levels[0], levels[1])


def _level(value: object) -> int | None:
    return round(float(value)) if isinstance(value, int | float) else None
