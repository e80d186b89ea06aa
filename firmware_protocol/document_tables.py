"""Declarations as tables of Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from firmware_protocol.fields import INTEGER_RANGE, Layout, MaskFlag, WireField


def table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Return a table of Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(str(cell) for cell in line) + " |" for line in lines)


def fixed_table(declared: Sequence[WireField]) -> str:
    """Return fields that are always there, with their offsets up to one of unknown size."""
    has_steps = any(f.scale is not None for f in declared)
    head = ("Offset", "Field", "Type", "Unit", *(("One step",) if has_steps else ()), "Meaning")
    rows = []
    offset: int | None = 0
    for f in declared:
        step = (_scale(f),) if has_steps else ()
        rows.append((_offset(offset), f"`{f.name}`", _type_name(f), f.unit, *step, _meaning(f)))
        # Behind a field of unknown size no offset is known.
        offset = None if offset is None or f.count == 0 else offset + f.size
    return table(head, rows)


def _offset(offset: int | None) -> str:
    return "then" if offset is None else str(offset)


def body_field(sentence: str) -> WireField:
    """Return a field of as many bytes as something else says."""
    return WireField(name="body", code="s", count=0, sentence=sentence.capitalize() + ".")


def _type_name(declared: WireField) -> str:
    if not declared.is_rest:
        return declared.type_name
    name = "text" if declared.is_text else "bytes"
    return name if declared.max_size is None else f"{name}, {declared.min_size} to {declared.max_size}"


def masked_table(declared: Sequence[WireField]) -> str:
    """Return fields that a bit of the mask says are there."""
    rows = [
        (f.presence_bit, f"`{f.name}`", f.type_name, f.unit, _scale(f), _range(f), f.sentence)
        for f in declared
    ]
    return table(("Mask bit", "Field", "Type", "Unit", "One step", "Range", "Meaning"), rows)


def flag_table(layout: Layout) -> str:
    """Return the bits of the mask that are values themselves, and those that are reserved."""
    used: dict[int, MaskFlag] = {f.bit: f for f in layout.flags}
    taken = {f.presence_bit for f in layout.fields}
    rows = [
        (bit, f"`{used[bit].name}`" if bit in used else "reserved", _flag_meaning(used.get(bit)))
        for bit in range(8)
        if bit not in taken
    ]
    return table(("Mask bit", "Flag", "Meaning when 1"), rows)


def _flag_meaning(declared: MaskFlag | None) -> str:
    if declared is None:
        return "Always 0; a body with this bit set is dropped."
    condition = f" Only with `{declared.clips}` present." if declared.clips else ""
    return declared.sentence + condition


def _scale(declared: WireField) -> str:
    return "" if declared.scale is None else repr(declared.scale)


def _range(declared: WireField) -> str:
    limit = INTEGER_RANGE[declared.code][1] * (declared.scale or 1)
    return f"±{limit:.6g}"


def _meaning(declared: WireField) -> str:
    parts = [declared.sentence]
    if declared.meanings:
        parts.append("; ".join(f"{number}: {meaning}" for number, meaning in declared.meanings.items()) + ".")
    if declared.minimum is not None:
        parts.append(f"At least {_number(declared.minimum)}.")
    if declared.maximum is not None:
        parts.append(f"At most {_number(declared.maximum)}.")
    if declared.absent is not None:
        parts.append(f"{declared.absent}: none or not known.")
    return " ".join(parts)


def _number(limit: float) -> str:
    return f"{limit:.0f}" if float(limit).is_integer() else f"{limit:.6g}"
