"""Structs of the header, and the constants that belong to them, from declared layouts."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from firmware_protocol.c.spelling import (
    C_TYPES,
    ascii_text,
    c_name,
    comment,
    define,
    literal,
    macro_name,
    slug,
    snake,
)
from firmware_protocol.fields import INTEGER_RANGE, Layout, MaskFlag, WireField
from firmware_protocol.messages import RESULTS


@dataclass(frozen=True, slots=True)
class Record:
    """A run of fields that becomes one struct: a packet, a verb's arguments, all settings."""

    name: str
    sentence: str
    layout: Layout

    @property
    def c_type(self) -> str:
        """Name of the struct."""
        return c_name(self.name)


def record_of_fields(name: str, sentence: str, fields: Sequence[WireField]) -> Record:
    """Return a record without a mask."""
    return Record(name, sentence, Layout(fields=tuple(fields), flags=()))


def struct_source(record: Record) -> str:
    """Return constants and struct of a record."""
    lines = [*_constants(record), "", comment(record.sentence), "typedef struct {"]
    if record.layout.has_mask:
        lines += ["    uint8_t mask; /* which fields are present, and flags */"]
    for declared in record.layout.fields:
        lines += [comment(member_comment(declared), "    "), *(f"    {m};" for m in members(declared))]
    return "\n".join([*lines, f"}} {record.c_type};"])


def members(declared: WireField) -> tuple[str, ...]:
    """Return the members that hold a field."""
    c_type = C_TYPES[declared.code]
    if declared.is_rest:
        return f"const {c_type} *{declared.name}", f"size_t {declared.name}_size"
    return (f"{c_type} {declared.name}" + (f"[{declared.count}]" if declared.count > 1 else ""),)


def member_comment(declared: WireField) -> str:
    """Return unit, step, meaning and limits of a field in words."""
    parts = [declared.sentence]
    if declared.scale is not None:
        parts.append(f"One step is {declared.scale:.9g} {declared.unit}.")
    elif declared.unit:
        parts.append(f"In {declared.unit}.")
    if declared.is_rest:
        parts.append(f"{declared.min_size} to {declared.max_size} bytes.")
    if declared.is_text and not declared.is_rest:
        parts.append("UTF-8, zeros after its end.")
    if declared.meanings:
        parts.append("; ".join(f"{n} {meaning}" for n, meaning in declared.meanings.items()) + ".")
    if declared.code == "f":
        parts += [f"At least {declared.minimum:g}."] if declared.minimum is not None else []
        parts += [f"At most {declared.maximum:g}."] if declared.maximum is not None else []
    elif declared.minimum is not None or declared.maximum is not None:
        parts.append("From {} to {} steps.".format(*raw_limits(declared)))
    if declared.absent is not None:
        parts.append(f"{declared.absent}: none or not known.")
    return " ".join(parts)


def presence_macro(record: Record, declared: WireField) -> str:
    """Return the name of the mask bit that says a field is there."""
    return macro_name(record.name, "has", declared.name)


def flag_macro(record: Record, declared: MaskFlag) -> str:
    """Return the name of the mask bit of a flag."""
    return macro_name(record.name, declared.name)


def raw_limits(declared: WireField) -> tuple[int, int]:
    """Return the smallest and largest number on the wire that an integer field allows ("not known" aside)."""
    low, high = INTEGER_RANGE[declared.code]
    scale = 1 if declared.scale is None else declared.scale
    if declared.minimum is not None:
        low = max(low, _first_allowed(declared, round(declared.minimum / scale), +1))
    if declared.maximum is not None:
        high = min(high, _first_allowed(declared, round(declared.maximum / scale), -1))
    if declared.absent is not None:
        low, high = low + (declared.absent == low), high - (declared.absent == high)
    return low, high


def _first_allowed(declared: WireField, near: int, step: int) -> int:
    """Return the number at a limit: the outermost that, times the scale, the declaration accepts."""
    scale = 1 if declared.scale is None else declared.scale
    within = (number for number in (near - step, near, near + step) if _is_within(declared, number * scale))
    return next(within)


def _is_within(declared: WireField, value: float) -> bool:
    return (declared.minimum is None or value >= declared.minimum) and (
        declared.maximum is None or value <= declared.maximum
    )


def _constants(record: Record) -> Iterator[str]:
    for declared in record.layout.fields:
        if declared.presence_bit is not None:
            yield define(presence_macro(record, declared), f"0x{1 << declared.presence_bit:02X}u")
    for flag in record.layout.flags:
        yield define(flag_macro(record, flag), f"0x{1 << flag.bit:02X}u", flag.sentence)
    for declared in record.layout.fields:
        yield from _field_constants(record, declared)
    sizes = [record.layout.sizes(mask) for mask in record.layout.valid_masks()]
    yield define(macro_name(record.name, "min_size"), f"{min(low for low, _ in sizes)}u")
    yield define(macro_name(record.name, "max_size"), f"{max(high for _, high in sizes)}u")


def _field_constants(record: Record, declared: WireField) -> Iterator[str]:
    # An event's `event` makes MOCAP_EVENT_BUTTON, not MOCAP_EVENT_EVENT_BUTTON.
    words = (record.name,) if snake(record.name) == declared.name else (record.name, declared.name)
    if declared.absent is not None:
        yield define(macro_name(*words, "absent"), literal(declared.absent, declared.code))
    if declared.code in INTEGER_RANGE and (declared.minimum, declared.maximum) != (None, None):
        low, high = raw_limits(declared)
        yield define(macro_name(*words, "min"), literal(low, declared.code))
        yield define(macro_name(*words, "max"), literal(high, declared.code))
    if declared.meanings is not RESULTS:  # those are an enumeration of their own
        for number, meaning in declared.meanings.items():
            # The whole meaning is said where its name leaves something out.
            note = meaning if slug(meaning) != slug(meaning.replace(",", " ").replace(":", " ")) else ""
            yield define(macro_name(*words, slug(meaning)), literal(number, declared.code), ascii_text(note))
