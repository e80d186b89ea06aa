"""Describe the wire to the tools of a CAN bus, from the declarations, as a DBC file.

::

    python -m firmware_protocol.dbc          # writes module.dbc: module 0

``mocap-gateway config dbc`` writes the file of a suit. A DBC file knows CAN frames, not wire frames:
each piece is a message of its own, for each module, since the identifier holds the module. What it
cannot say, and how the signals are named, stands in ``README.md`` under "DBC file". Letters outside
ASCII are spelt out: tools disagree on the encoding.

A packet is first laid out in the joined pieces, element after element; then the pieces of classic CAN
cut it, or CAN FD takes it whole. A number that a piece's end cuts becomes two signals, whose physical
values add up to the number's: little-endian, so that the high part counts 2^bits as much.
"""

from __future__ import annotations

import inspect
import struct
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from firmware_protocol.can_framing import (
    CLASSIC_DATA_SIZE,
    EXTENDED,
    FD_DATA_SIZE,
    FD_LENGTHS,
    HEAD_FIELDS,
    OVERHEAD,
    identifier,
)
from firmware_protocol.fields import BYTE_ORDER, Layout, WireField, layout_of
from firmware_protocol.framing import BROADCAST, CHECKSUM_FIELD
from firmware_protocol.kinds import FROM_HOST
from firmware_protocol.packets import PACKETS, InertialSample, Packet

SENSORS = "sensors"
"""Signal of a sample's presence bits."""

_AXES = {3: "xyz", 4: "wxyz"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Signal:
    """One number in a CAN frame, or in the joined pieces of several."""

    name: str
    bit: int
    """Place of its lowest bit."""
    width: int
    """Bits."""
    is_signed: bool = False
    is_float: bool = False
    factor: float = 1.0
    unit: str = ""
    meanings: Mapping[int, str] = field(default_factory=dict)
    masks: tuple[int, ...] = ()
    """Values of ``sensors`` with which the signal is there; empty: always."""


def packet_signals(layout: Layout, mask: int) -> list[Signal]:
    """Return the signals of a packet with this mask in its joined pieces, up to a part of any length."""
    signals = _run_of_signals(HEAD_FIELDS, 0)
    body = 8 * sum(f.size for f in HEAD_FIELDS)
    if layout.has_mask:
        signals += _mask_signals(layout, body)
        body += 8
    tail = () if layout.rest else (CHECKSUM_FIELD,)
    return signals + _run_of_signals((*layout.present(mask), *tail), body)


def multiplexed_signals(layout: Layout) -> list[Signal]:
    """Return the signals with every mask, told apart by ``sensors``. All else is as ``packet_signals`` has
    it.

    One that moves as others come and go is named for its first byte where it is not in its last place.
    """
    # One combination for every set of optional fields: each may move those behind it.
    combinations = range(1 << sum(f.presence_bit is not None for f in layout.fields))
    signals: dict[tuple[str, int], Signal] = {}
    masks: dict[tuple[str, int], list[int]] = {}
    for mask in combinations:
        for signal in packet_signals(layout, mask):
            signals[signal.name, signal.bit] = signal
            masks.setdefault((signal.name, signal.bit), []).append(mask)
    # The last place, with all fields present, keeps the plain name.
    last = {name: max(bit for other, bit in signals if other == name) for name, _ in signals}
    return [
        replace(
            signal,
            name=name if bit == last[name] else f"{name}_at_{bit // 8}",
            masks=() if len(masks[name, bit]) == len(combinations) else tuple(masks[name, bit]),
        )
        for (name, bit), signal in signals.items()
    ]


def cut(signals: list[Signal], place: int) -> list[Signal]:
    """Return the signals that the classic piece at this place holds, counted from its own first bit."""
    size = 8 * CLASSIC_DATA_SIZE
    start = place * size
    return [part for signal in signals for part in _parts(signal, start, start + size)]


def _parts(signal: Signal, start: int, stop: int) -> Iterator[Signal]:
    end = signal.bit + signal.width
    if end <= start or signal.bit >= stop:
        return
    if start <= signal.bit and end <= stop:
        yield replace(signal, bit=signal.bit - start)
        return
    # A signal cut by a frame's end: the high part weighs as many bits more as the low one has.
    is_low = signal.bit >= start
    width = stop - signal.bit if is_low else end - start
    weight = 1.0 if is_low or signal.is_float else 2.0 ** (start - signal.bit)
    yield replace(
        signal,
        name=f"{signal.name}_{'low' if is_low else 'high'}",
        bit=max(signal.bit - start, 0),
        width=width,
        # Only the highest part has the sign; a cut float has no meaning of its own.
        is_signed=signal.is_signed and not is_low and not signal.is_float,
        is_float=False,
        factor=signal.factor * weight,
        unit="" if signal.is_float else signal.unit,
        meanings={},
    )


def _run_of_signals(declared: Sequence[WireField], start: int) -> list[Signal]:
    signals: list[Signal] = []
    for each in declared:
        signals += _field_signals(each, start)
        start += 8 * each.size
    return signals


def _mask_signals(layout: Layout, start: int) -> list[Signal]:
    """Return the mask byte: the presence bits, which come first, as one number, and each flag."""
    present = {f.presence_bit: f.name for f in layout.fields if f.presence_bit is not None}
    names = {
        mask: " ".join(name for bit, name in present.items() if mask >> bit & 1) or "none"
        for mask in range(1 << len(present))
    }
    sensors = Signal(name=SENSORS, bit=start, width=len(present), meanings=names)
    flags = [Signal(name=flag.name, bit=start + flag.bit, width=1) for flag in layout.flags]
    return [sensors, *flags]


def _field_signals(declared: WireField, start: int) -> list[Signal]:
    if declared.is_rest:
        return []
    size = struct.calcsize(BYTE_ORDER + declared.code) * 8
    meanings = dict(declared.meanings)
    if declared.absent is not None:
        meanings[declared.absent] = "none or not known"
    return [
        Signal(
            name=name,
            bit=start + place * size,
            width=size,
            is_signed=declared.code in "bhif",
            is_float=declared.code == "f",
            factor=1.0 if declared.scale is None else declared.scale,
            unit=declared.unit,
            meanings=meanings,
        )
        for place, name in enumerate(_element_names(declared))
    ]


def _element_names(declared: WireField) -> list[str]:
    if declared.count == 1:
        return [declared.name]
    is_vector = declared.scale is not None or declared.code == "f"
    endings = _AXES.get(declared.count, "") if is_vector else ""
    return [f"{declared.name}_{endings[place] if endings else place}" for place in range(declared.count)]


PATH = Path(__file__).parent / "module.dbc"
ALL_SENSORS = tuple(f.name for f in layout_of(InertialSample).fields)

_EXTENDED_CAN, _EXTENDED_CAN_FD = 1, 15  # of the attribute VFrameFormat
_FORMATS = ["StandardCAN", "ExtendedCAN", *["reserved"] * 12, "StandardCAN_FD", "ExtendedCAN_FD"]
_SPELT_OUT = str.maketrans({"²": "^2", "µ": "u", "°": "deg", "×": "x", "−": "-"})


@dataclass(frozen=True, slots=True)
class Message:
    """One CAN frame."""

    name: str
    identifier: int
    length: int
    is_fd: bool
    sender: str
    comment: str
    signals: tuple[Signal, ...]


def render(modules: Sequence[int], sensors: Sequence[str] = ALL_SENSORS) -> str:
    """Return the whole file.

    modules: ids, each with messages of its own, besides those that the host sends to all.
    sensors: those that samples hold on classic CAN.
    """
    messages = [
        message
        for packet_class in PACKETS.values()
        for module in (*modules, *((BROADCAST,) if packet_class.KIND in FROM_HOST else ()))
        for message in _messages(packet_class, module, sensors)
    ]
    nodes = ["Host", *(f"Module_{module}" for module in modules)]
    sections = [
        'VERSION ""',
        "NS_ :\n",
        "BS_:",
        f"BU_: {' '.join(nodes)}",
        *map(_message_text, messages),
        "\n".join(f'CM_ BO_ {_number(m)} "{m.comment}";' for m in messages),
        'BA_DEF_ BO_ "VFrameFormat" ENUM ' + ",".join(f'"{name}"' for name in _FORMATS) + ";",
        f'BA_DEF_DEF_ "VFrameFormat" "{_FORMATS[_EXTENDED_CAN]}";',
        "\n".join(map(_format_text, messages)),
        "\n".join(text for m in messages for text in _meaning_texts(m)),
        "\n".join(
            f"SIG_VALTYPE_ {_number(m)} {s.name} : 1;" for m in messages for s in m.signals if s.is_float
        ),
        "\n".join(text for m in messages for text in _multiplex_texts(m)),
    ]
    # DBC files are read in many code pages: only ASCII is safe.
    return "\n\n".join(sections).translate(_SPELT_OUT) + "\n"


def _messages(packet_class: type[Packet], module: int, sensors: Sequence[str]) -> list[Message]:
    layout = layout_of(packet_class)
    mask = sum(1 << f.presence_bit for f in layout.fields if f.presence_bit is not None and f.name in sensors)
    least = OVERHEAD + layout.sizes(mask)[0]
    classic = [
        _message(packet_class, module, place, place == _n_pieces(least) - 1, signals, least)
        # Where the size is not fixed, only what comes before the last piece is sure to be there.
        for place in range(_n_pieces(least) - (layout.rest is not None))
        if (signals := cut(packet_signals(layout, mask), place))
    ]
    return classic + _fd_messages(packet_class, module, layout)


def _fd_messages(packet_class: type[Packet], module: int, layout: Layout) -> list[Message]:
    largest = OVERHEAD + max(layout.sizes(mask)[1] for mask in layout.valid_masks())
    if layout.rest or largest > FD_DATA_SIZE:
        return []
    signals = multiplexed_signals(layout)
    return [_message(packet_class, module, 0, True, signals, largest, is_fd=True)]


def _message(
    packet_class: type[Packet],
    module: int,
    place: int,
    is_last: bool,
    signals: Sequence[Signal],
    size: int,
    is_fd: bool = False,
) -> Message:
    rest = size - place * CLASSIC_DATA_SIZE
    return Message(
        name=f"{packet_class.__name__}_{module}_{'fd' if is_fd else f'p{place}'}",
        identifier=identifier(packet_class.KIND, module, place, is_last),
        length=min(n for n in FD_LENGTHS if n >= size) if is_fd else min(rest, CLASSIC_DATA_SIZE),
        is_fd=is_fd,
        sender="Host" if packet_class.KIND in FROM_HOST else f"Module_{module}",
        comment=(inspect.getdoc(packet_class) or "").split("\n\n", maxsplit=1)[0].replace('"', "'"),
        signals=tuple(signals),
    )


def _n_pieces(size: int) -> int:
    return -(-size // CLASSIC_DATA_SIZE)


def _number(message: Message) -> int:
    return message.identifier | EXTENDED


def _message_text(message: Message) -> str:
    is_multiplexed = any(signal.masks for signal in message.signals)
    head = f"BO_ {_number(message)} {message.name}: {message.length} {message.sender}"
    return "\n".join([head, *(_signal_text(signal, is_multiplexed) for signal in message.signals)])


def _signal_text(signal: Signal, is_multiplexed: bool) -> str:
    selector = " M" if is_multiplexed and signal.name == SENSORS else ""
    if signal.masks:
        selector = f" m{signal.masks[0]}"
    sign = "-" if signal.is_signed else "+"
    factor = repr(signal.factor) if signal.factor % 1 else f"{signal.factor:.0f}"
    place = f"{signal.bit}|{signal.width}@1{sign}"
    return f' SG_ {signal.name}{selector} : {place} ({factor},0) [0|0] "{signal.unit}" Vector__XXX'


def _format_text(message: Message) -> str:
    return (
        f'BA_ "VFrameFormat" BO_ {_number(message)} {_EXTENDED_CAN_FD if message.is_fd else _EXTENDED_CAN};'
    )


def _meaning_texts(message: Message) -> Iterable[str]:
    for signal in message.signals:
        if signal.meanings:
            values = " ".join(f'{value} "{meaning}"' for value, meaning in signal.meanings.items())
            yield f"VAL_ {_number(message)} {signal.name} {values} ;"


def _multiplex_texts(message: Message) -> Iterable[str]:
    for signal in message.signals:
        if signal.masks:
            ranges = ", ".join(f"{mask}-{mask}" for mask in signal.masks)
            yield f"SG_MUL_VAL_ {_number(message)} {signal.name} {SENSORS} {ranges};"


if __name__ == "__main__":
    PATH.write_text(render([0]), encoding="ascii")
