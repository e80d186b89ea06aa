"""Where the numbers of a packet lie in the CAN frames that carry it, as signals of a DBC file.

A packet is first laid out in the joined pieces, element after element; then the pieces of classic CAN
cut it, or CAN FD takes it whole. A number that a piece's end cuts becomes two signals, whose physical
values add up to the number's: little-endian, so that the high part counts 2^bits as much.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

from firmware_protocol.can_framing import HEAD_FIELDS
from firmware_protocol.can_records import CLASSIC_DATA_SIZE
from firmware_protocol.fields import BYTE_ORDER, Layout, WireField
from firmware_protocol.framing import CHECKSUM_FIELD

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
