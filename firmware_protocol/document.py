"""Writes ``README.md``, the protocol's description for firmware authors, from the declarations.

::

    python -m firmware_protocol.document > firmware_protocol/README.md
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Iterable, Sequence

from firmware_protocol import can_framing
from firmware_protocol.fields import INTEGER_RANGE, Layout, MaskFlag, WireField, layout_of
from firmware_protocol.framing import (
    CHECKSUM_FIELD,
    HEADER_FIELDS,
    MAX_FRAME_SIZE,
    Defect,
    encode_frame,
    serialize,
)
from firmware_protocol.golden_defects import GOOD
from firmware_protocol.kinds import CAN_PRIORITY, LOWEST_CAN_PRIORITY, Kind
from firmware_protocol.packets import PACKETS, Packet
from firmware_protocol.prose import (
    BYTE_STREAM,
    CAN,
    HISTORY,
    INTRODUCTION,
    RELAY,
    RULES,
    VECTORS,
    WORKED_EXAMPLE,
)
from firmware_protocol.relay import ENTRY_FIELDS


def render() -> str:
    """The whole of ``README.md``."""
    sections = [
        INTRODUCTION,
        "## Wire frame",
        _fixed_table((*HEADER_FIELDS, _body("what the kind says"), CHECKSUM_FIELD)),
        f"The largest wire frame is {MAX_FRAME_SIZE} bytes before stuffing.",
        BYTE_STREAM,
        _worked_example(),
        "## Kinds",
        _kind_table(),
        "A receiver accepts a body of exactly the length that its kind and mask demand.",
        *(_packet_section(packet_class) for packet_class in PACKETS.values()),
        _relay_section(),
        _can_section(),
        RULES,
        "## What a receiver drops, and how it counts it",
        _table(("Reason", "What was wrong"), ((defect.name, defect.value) for defect in Defect)),
        VECTORS,
        HISTORY,
    ]
    return "\n\n".join(section.strip() for section in sections) + "\n"


def _table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(str(cell) for cell in line) + " |" for line in lines)


def _fixed_table(declared: Sequence[WireField]) -> str:
    """Fields that are always there, with their offsets up to one of unknown size."""
    has_steps = any(f.scale is not None for f in declared)
    head = ("Offset", "Field", "Type", "Unit", *(("One step",) if has_steps else ()), "Meaning")
    rows = []
    offset: int | None = 0
    for f in declared:
        step = (_scale(f),) if has_steps else ()
        rows.append((_offset(offset), f"`{f.name}`", _type_name(f), f.unit, *step, _meaning(f)))
        offset = None if offset is None or f.count == 0 else offset + f.size
    return _table(head, rows)


def _offset(offset: int | None) -> str:
    return "then" if offset is None else str(offset)


def _body(sentence: str) -> WireField:
    return WireField(name="body", code="s", count=0, sentence=sentence.capitalize() + ".")


def _type_name(declared: WireField) -> str:
    return declared.type_name if declared.count else "bytes"


def _kind_table() -> str:
    rows = [
        (f"0x{kind:02X}", f"`{kind.name}`", _sizes(kind), CAN_PRIORITY.get(kind, LOWEST_CAN_PRIORITY))
        for kind in Kind
    ]
    return _table(("Kind", "Name", "Body, bytes", "CAN priority"), rows)


def _sizes(kind: Kind) -> str:
    if kind not in PACKETS:
        return "any"
    layout = layout_of(PACKETS[kind])
    sizes = sorted({_body_size(layout, mask) for mask in layout.valid_masks()})
    return ", ".join(map(str, sizes))


def _body_size(layout: Layout, mask: int) -> int:
    return int(layout.has_mask) + sum(f.size for f in layout.present(mask))


def _packet_section(packet_class: type[Packet]) -> str:
    layout = layout_of(packet_class)
    title = f"### 0x{packet_class.KIND:02X} {packet_class.__name__}"
    parts = [title, inspect.getdoc(packet_class) or ""]
    if layout.has_mask:
        parts += [
            "The body begins with a `mask` (u8) and goes on with the fields whose bit is set, in this order:",
            _masked_table(layout.fields),
            "The other bits of the mask:",
            _flag_table(layout),
        ]
    else:
        parts.append(_fixed_table(layout.fields))
    return "\n\n".join(parts)


def _masked_table(declared: Sequence[WireField]) -> str:
    rows = [
        (f.presence_bit, f"`{f.name}`", f.type_name, f.unit, _scale(f), _range(f), f.sentence)
        for f in declared
    ]
    return _table(("Mask bit", "Field", "Type", "Unit", "One step", "Range", "Meaning"), rows)


def _flag_table(layout: Layout) -> str:
    used: dict[int, MaskFlag] = {f.bit: f for f in layout.flags}
    taken = {f.presence_bit for f in layout.fields}
    rows = [
        (bit, f"`{used[bit].name}`" if bit in used else "reserved", _flag_meaning(used.get(bit)))
        for bit in range(8)
        if bit not in taken
    ]
    return _table(("Mask bit", "Flag", "Meaning when 1"), rows)


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
        parts.append(f"At least {declared.minimum:g}.")
    if declared.maximum is not None:
        parts.append(f"At most {declared.maximum:g}.")
    if declared.absent is not None:
        parts.append(f"{declared.absent}: none or not known.")
    return " ".join(parts)


def _relay_section() -> str:
    table = _fixed_table((*ENTRY_FIELDS, _body("as many bytes as length says")))
    return "\n\n".join([f"### 0x{Kind.RELAY_BATCH:02X} RelayBatch", RELAY.strip(), table])


def _worked_example() -> str:
    return WORKED_EXAMPLE.format(
        body=GOOD.body.hex(" "),
        raw=serialize(GOOD).hex(" "),
        sent=encode_frame(GOOD).hex(" "),
        pieces="\n".join(
            f"{piece.identifier:08x}  {piece.data.hex(' ')}" for piece in can_framing.fragment(GOOD)
        ),
    )


def _can_section() -> str:
    identifier = _table(
        ("Bits", "Part", "Meaning"),
        (
            (_bits(name), f"`{name}`", can_framing.IDENTIFIER_MEANINGS[name])
            for name, _ in can_framing.IDENTIFIER_BITS
        ),
    )
    payload = _fixed_table(
        (*can_framing.HEAD_FIELDS, _body("as many bytes as body_length says"), CHECKSUM_FIELD)
    )
    return CAN.format(
        identifier=identifier,
        payload=payload,
        classic=can_framing.MAX_CLASSIC_BODY_SIZE,
        fd=can_framing.MAX_CAN_BODY_SIZE,
        lengths=", ".join(str(length) for length in can_framing.FD_LENGTHS if length >= 8),
    )


def _bits(name: str) -> str:
    shift, width = can_framing.IDENTIFIER_SHIFT[name], dict(can_framing.IDENTIFIER_BITS)[name]
    return f"{shift + width - 1}–{shift}" if width > 1 else str(shift)


if __name__ == "__main__":
    sys.stdout.write(render())
