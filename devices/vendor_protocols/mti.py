"""Messages of Xsens MTi devices: Xbus on a serial line, and their CAN frames, to values and back.

On a serial line a message is ``FA FF MID LEN data CS``, big-endian, all bytes after FA adding up to 0
modulo 256; LEN 255 announces a length of two bytes. ``MTData2`` (0x36) holds items of an identifier, a size
and a value, in one of four number formats (low-level communication protocol documentation). On CAN every
quantity is a frame of its own, as ``xsens.dbc`` says.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from typing import NamedTuple

from devices.vendor_protocols.plausibility import Gate, either_way, fault
from firmware_protocol import CanFrame, pack_can_records, unpack_can_records

PREAMBLE, BUS = 0xFA, 0xFF
LONGEST = 2048
"""Bytes of data of one message."""
TICK_US = 100
"""µs of one count of ``sample_time_fine``."""
EVERY_PACKET = 0xFFFF
"""Rate, in the output configuration, of items that come with every packet."""


class Mid(IntEnum):
    """Messages; the answer to one is numbered one higher."""

    REQUEST_DEVICE_ID = 0x00
    GO_TO_MEASUREMENT = 0x10
    REQUEST_FIRMWARE = 0x12
    GO_TO_CONFIG = 0x30
    MT_DATA_2 = 0x36
    WAKE_UP = 0x3E
    ERROR = 0x42
    OUTPUT_CONFIGURATION = 0xC0


class Number(NamedTuple):
    """How numbers are written."""

    size: int
    read: Callable[[bytes], float]
    write: Callable[[float], bytes]


def _fixed_16_32(value: float) -> bytes:
    whole = round(value * 2**32)
    return (whole & 0xFFFFFFFF).to_bytes(4, "big") + (whole >> 32).to_bytes(2, "big", signed=True)


NUMBERS = (
    Number(4, lambda data: float(struct.unpack(">f", data)[0]), lambda value: struct.pack(">f", value)),
    Number(
        4,
        lambda data: int.from_bytes(data, "big", signed=True) / 2**20,
        lambda value: round(value * 2**20).to_bytes(4, "big", signed=True),
    ),
    Number(  # the fraction stands before the whole number
        6,
        lambda data: int.from_bytes(data[4:], "big", signed=True) + int.from_bytes(data[:4], "big") / 2**32,
        _fixed_16_32,
    ),
    Number(8, lambda data: float(struct.unpack(">d", data)[0]), lambda value: struct.pack(">d", value)),
)
"""By the two lowest bits of an identifier: float32, fixed point 12.20, fixed point 16.32, float64."""
AXES = "ENU", "NED", "NWU"
"""By the two bits above: axes of the world, for what is given in them."""


class Item(NamedTuple):
    """One quantity of ``MTData2``."""

    identifier: int
    """Without number format and axes."""
    layout: int | str
    """How many numbers of the identifier's format; or, as ``struct`` has it, how it is laid out."""


ITEMS: Mapping[str, Item] = {
    "temperature": Item(0x0810, 1),
    "utc": Item(0x1010, "IHBBBBBB"),
    "packet_counter": Item(0x1020, "H"),
    "sample_time_fine": Item(0x1060, "I"),
    "sample_time_coarse": Item(0x1070, "I"),
    "quaternion": Item(0x2010, 4),
    "rotation_matrix": Item(0x2020, 9),
    "euler_angles": Item(0x2030, 3),
    "baro_pressure": Item(0x3010, "I"),
    "delta_v": Item(0x4010, 3),
    "acceleration": Item(0x4020, 3),
    "free_acceleration": Item(0x4030, 3),
    "acceleration_hr": Item(0x4040, 3),
    "altitude_ellipsoid": Item(0x5020, 1),
    "position_ecef": Item(0x5030, 3),
    "lat_lon": Item(0x5040, 2),
    "gnss_pvt": Item(0x7010, "IHBBBBBBIiBBBBiiiiIIiiiiiIIiHHHHHHH"),
    "rate_of_turn": Item(0x8020, 3),
    "delta_q": Item(0x8030, 4),
    "rate_of_turn_hr": Item(0x8040, 3),
    "magnetic_field": Item(0xC020, 3),
    "velocity": Item(0xD010, 3),
    "status_byte": Item(0xE010, "B"),
    "status_word": Item(0xE020, "I"),
}
"""By name. What is not listed is passed over by its size."""
_NAMES = {item.identifier: name for name, item in ITEMS.items()}
CLIPPED = {"acceleration": 0b111 << 8, "rate_of_turn": 0b111 << 11, "magnetic_field": 0b111 << 14}
"""Bits of the status word that say that an axis was at the end of its range."""

_GATES: Mapping[str, tuple[Gate, ...]] = {
    "acceleration": (either_way("force_beyond_sensor", 250.0),) * 3,  # m/s²; up to 20 g
    "rate_of_turn": (either_way("rate_beyond_sensor", 40.0),) * 3,  # rad/s; up to 2000 deg/s
    "magnetic_field": (either_way("field_beyond_sensor", 100.0),) * 3,  # fields of calibration
}


@dataclass(frozen=True, slots=True)
class Measurement:
    """What belongs to one instant."""

    values: Mapping[str, tuple[float, ...]]
    """By name of ``ITEMS``: m/s², rad/s, fields of calibration, degrees, whole numbers."""
    axes: str = AXES[0]
    """Name the axes of what is given in the world."""

    def whole(self, name: str) -> int | None:
        """Return a whole number, such as a counter; None: it was not sent."""
        found = self.values.get(name)
        return None if found is None else int(found[0])


@dataclass(frozen=True, slots=True)
class Reply:
    """Any other message."""

    mid: int
    data: bytes = field(default=b"")


Message = Measurement | Reply


def encode(mid: int, data: bytes = b"") -> bytes:
    """Return a message for the serial line."""
    length = bytes((len(data),)) if len(data) < 0xFF else b"\xff" + len(data).to_bytes(2, "big")
    content = bytes((BUS, mid)) + length + data
    return bytes((PREAMBLE,)) + content + bytes((-sum(content) & 0xFF,))


def encode_item(name: str, values: Sequence[float], number: int = 0, axes: int = 0) -> bytes:
    """Return one item of ``MTData2``. number, axes: places in ``NUMBERS`` and ``AXES``."""
    item = ITEMS[name]
    if isinstance(item.layout, str):
        data, identifier = struct.pack(f">{item.layout}", *values), item.identifier
    else:
        data = b"".join(map(NUMBERS[number].write, values))
        identifier = item.identifier | number | axes << 2
    return identifier.to_bytes(2, "big") + bytes((len(data),)) + data


def decode_items(data: bytes) -> Measurement | None:
    """Return what ``MTData2`` holds; None where sizes do not fit."""
    values, axes, place = {}, AXES[0], 0
    while place < len(data):
        identifier, size = int.from_bytes(data[place : place + 2], "big"), data[place + 2 : place + 3]
        content = data[place + 3 : place + 3 + (size[0] if size else 0)]
        if not size or len(content) != size[0]:
            return None
        place += 3 + size[0]
        # The lowest four bits are precision and axes, not the kind of data.
        name = _NAMES.get(identifier & 0xFFF0)
        if name is None:
            continue
        found = _numbers(ITEMS[name].layout, identifier & 0x3, content)
        if found is None:
            return None
        values[name] = found
        if isinstance(ITEMS[name].layout, int):
            axes = AXES[min(identifier >> 2 & 0x3, len(AXES) - 1)]
    return Measurement(values, axes)


def _numbers(layout: int | str, number: int, content: bytes) -> tuple[float, ...] | None:
    if isinstance(layout, str):
        if len(content) != struct.calcsize(f">{layout}"):
            return None
        return struct.unpack(f">{layout}", content)
    form = NUMBERS[number]
    if len(content) != layout * form.size:
        return None
    return tuple(form.read(content[at : at + form.size]) for at in range(0, len(content), form.size))


def judged(measurement: Measurement, dropped: Counter[str]) -> Measurement | None:
    """Return a measurement that its device can have made; None, and the reason counted, for any other."""
    for name, gates in _GATES.items():
        why = fault(measurement.values[name], gates) if name in measurement.values else None
        if why is not None:
            dropped[why] += 1
            return None
    return measurement


class MtiDecoder:
    """The stream of one device on a serial line."""

    def __init__(self) -> None:
        self.dropped: Counter[str] = Counter()
        """bad_checksum, bad_item, not_finite, noise (bytes between messages), and what is beyond a
        sensor: rate, force, field."""
        self.unused = 0
        """Items and messages that nothing is made from."""
        self._rest = b""

    def feed(self, data: bytes) -> list[Message]:
        """Return the messages that these bytes complete, in order."""
        found: list[Message] = []
        rest = self._rest + data
        while True:
            begin = rest.find(PREAMBLE)
            self.dropped["noise"] += len(rest) if begin < 0 else begin
            rest = b"" if begin < 0 else rest[begin:]
            length = _length(rest)
            if length is None or len(rest) < length:
                break
            if length and sum(rest[1:length]) & 0xFF == 0:
                message = self._read(rest[2], rest[4 if rest[3] != 0xFF else 6 : length - 1])
                found += [] if message is None else [message]
                rest = rest[length:]
            else:
                # what follows the preamble may hold another one, which is the true one
                self.dropped["bad_checksum" if length else "noise"] += 1
                rest = rest[1:]
        self._rest = rest
        self.dropped += Counter()  # without the zeros
        return found

    def _read(self, mid: int, data: bytes) -> Message | None:
        if mid != Mid.MT_DATA_2:
            return Reply(mid, data)
        measurement = decode_items(data)
        if measurement is None:
            self.dropped["bad_item"] += 1
            return None
        return judged(measurement, self.dropped)


def _length(rest: bytes) -> int | None:
    """Return the bytes of the message that begins here; 0: none does; None: not yet known."""
    if len(rest) > 1 and rest[1] not in (BUS, 0x01):
        return 0
    if len(rest) < 4:
        return None
    # A length of 255 says that the real one follows in two bytes.
    if rest[3] != 0xFF:
        return rest[3] + 5
    if len(rest) < 6:
        return None
    length = int.from_bytes(rest[4:6], "big")
    # A longer message would make us wait for bytes that never come.
    return length + 7 if length <= LONGEST else 0


class CanItem(NamedTuple):
    """One quantity on CAN: numbers of 16 bits in units."""

    identifier: int
    name: str
    unit: float


CAN_TIME, CAN_COUNTER, CAN_STATUS = 0x05, 0x06, 0x11
CAN_ITEMS = (
    CanItem(0x21, "quaternion", 2.0**-15),
    CanItem(0x32, "rate_of_turn", 2.0**-9),
    CanItem(0x34, "acceleration", 2.0**-8),
    CanItem(0x35, "free_acceleration", 2.0**-8),
    CanItem(0x41, "magnetic_field", 2.0**-10),
)
_BY_IDENTIFIER = {item.identifier: item for item in CAN_ITEMS}
_BEGINS = frozenset({CAN_TIME, CAN_COUNTER})
_COMPLETE = frozenset({"acceleration", "rate_of_turn"})


class MtiCanDecoder:
    """CAN frames of one device, its identifiers as they are delivered."""

    def __init__(self) -> None:
        self.dropped: Counter[str] = Counter()
        """bad_length, incomplete, without_head, and what is beyond a sensor: rate, force, field."""
        self.unused = 0
        """Frames of identifiers that nothing is made from."""
        self._head: dict[str, tuple[float, ...]] = {}
        self._values: dict[str, tuple[float, ...]] = {}
        self._taken: set[str] = set()  # of the instant that the head is of
        self._expected: set[str] = set()
        """What heads have held: the device sends it with every instant."""

    def feed(self, data: bytes) -> list[Measurement]:
        """Return the measurements that CAN records complete, in order.

        Acceleration and rate of turn of one instant are one; the magnetic field is another, of the same
        instant, since it comes after them and not every time.
        """
        found = []
        for frame in unpack_can_records(data):
            measurement = self._take(frame)
            if measurement is not None and judged(measurement, self.dropped) is not None:
                found.append(measurement)
        return found

    def _take(self, frame: CanFrame) -> Measurement | None:
        name, layout, unit = _can_layout(frame.identifier)
        if not name or frame.is_extended or frame.is_error or frame.is_remote:
            self.unused += 1
            return None
        if len(frame.data) != struct.calcsize(layout):
            self.dropped["bad_length"] += 1
            return None
        values = tuple(each * unit for each in struct.unpack(layout, frame.data))
        # These come first in each instant; what follows them belongs to it.
        if frame.identifier in _BEGINS or name == "status_word":
            self._begin(frame.identifier, name, values)
            return None
        return self._measured(name, values)

    def _measured(self, name: str, values: tuple[float, ...]) -> Measurement | None:
        """Return what a quantity of the present instant completes."""
        if name in self._taken or not self._expected <= self._head.keys():
            self.dropped["without_head"] += 1  # time or count of its instant have not come
            return None
        self._taken.add(name)
        self._values[name] = values
        if name == "magnetic_field":
            return Measurement({**self._head, name: self._values.pop(name)})
        if name in _COMPLETE and self._values.keys() >= _COMPLETE:
            complete, self._values = self._values, {}
            return Measurement({**self._head, **complete})
        return None

    def _begin(self, identifier: int, name: str, values: tuple[float, ...]) -> None:
        """Begin another instant; with the time stamp, or with the counter where there is none."""
        if identifier == CAN_TIME or (identifier == CAN_COUNTER and "sample_time_us" not in self._head):
            self.dropped["incomplete"] += bool(self._values.keys() & _COMPLETE)
            self._head, self._values, self._taken = {}, {}, set()
        self._head[name] = values
        if identifier in _BEGINS:
            self._expected.add(name)
        self.dropped += Counter()


def _can_layout(identifier: int) -> tuple[str, str, float]:
    if identifier == CAN_TIME:
        return "sample_time_us", ">I", 1
    if identifier == CAN_COUNTER:
        return "packet_counter", ">H", 1
    if identifier == CAN_STATUS:
        return "status_word", ">I", 1
    item = _BY_IDENTIFIER.get(identifier)
    if item is None:
        return "", "", 1
    return item.name, ">4h" if item.name == "quaternion" else ">3h", item.unit


def encode_can(measurement: Mapping[str, Iterable[float]]) -> bytes:
    """Return the CAN records of one instant, in the order in which a device sends them."""
    frames = []
    for identifier in (CAN_TIME, CAN_COUNTER, CAN_STATUS, *_BY_IDENTIFIER):
        name, layout, unit = _can_layout(identifier)
        if name in measurement:
            counts = [round(value / unit) for value in measurement[name]]
            if unit != 1:
                counts = [min(max(count, -(2**15)), 2**15 - 1) for count in counts]
            frames.append(CanFrame(identifier, struct.pack(layout, *counts), is_extended=False))
    return pack_can_records(frames)


def encode_output_configuration(outputs: Mapping[str, int], number: int = 0) -> bytes:
    """Return the data of ``OUTPUT_CONFIGURATION``: items by name with rates in Hz, in a number format."""
    pairs = []
    for name, rate in outputs.items():
        item = ITEMS[name]
        pairs.append(struct.pack(">HH", item.identifier | number * isinstance(item.layout, int), rate))
    return b"".join(pairs)


def read_output_configuration(data: bytes) -> dict[str, int]:
    """Return items by name with their rates, Hz; those that are not known here by their identifiers."""
    pairs = struct.iter_unpack(">HH", data[: len(data) // 4 * 4])
    return {_NAMES.get(xdi & 0xFFF0, f"0x{xdi:04x}"): rate for xdi, rate in pairs}
