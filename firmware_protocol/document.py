"""Writes ``README.md``, the protocol's description for firmware authors, from the declarations.

::

    python -m firmware_protocol.document > firmware_protocol/README.md

In this order: declarations as tables of Markdown, the sections on commands, settings, flash, long wire
frames on CAN and versions, then packets, signing, CAN and the page of it all. What no declaration
holds is in ``prose``.
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Iterable, Sequence
from zlib import crc32

from firmware_protocol import can_framing, relay, signing
from firmware_protocol.can_transfer import FLOW_CONTROL_FIELDS, TransferParams
from firmware_protocol.commands import (
    ANSWER_MEMORY,
    BROADCAST_ANSWER_DELAY_US,
    VERBS,
    VerbDeclaration,
)
from firmware_protocol.device_settings import SETTINGS, Setting
from firmware_protocol.fields import INTEGER_RANGE, Layout, MaskFlag, WireField, layout_of
from firmware_protocol.flash_slots import ENTRY_FIELDS, MAX_IMAGE_SIZE, SLOT_FIELDS, SLOT_SIZE
from firmware_protocol.framing import (
    CHECKSUM_FIELD,
    HEADER_FIELDS,
    MAX_FRAME_SIZE,
    SUPPORTED,
    Defect,
    encode_frame,
    serialize,
)
from firmware_protocol.golden import GOOD, KEY
from firmware_protocol.kinds import CAN_PRIORITY, FROM_HOST, LOWEST_CAN_PRIORITY, Kind
from firmware_protocol.messages import MAX_PIECE_DATA_SIZE, RESULTS
from firmware_protocol.packets import PACKETS, Packet
from firmware_protocol.prose import (
    BYTE_STREAM,
    CAN,
    COMMANDS,
    DBC,
    FLASH,
    HISTORY,
    INTRODUCTION,
    RELAY,
    RULES,
    SETTINGS_RULES,
    SIGNING,
    TRANSFER,
    VECTORS,
    VERSIONS,
    WORKED_EXAMPLE,
)


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


def command_section() -> str:
    """Return all verbs."""
    overview = table(
        ("Verb", "Name", "Changes the device", "Does what"),
        (
            (number, f"`{verb.name}`", "yes" if verb.changes_device else "", verb.sentence)
            for number, verb in VERBS.items()
        ),
    )
    text = COMMANDS.format(memory=ANSWER_MEMORY, delay_ms=BROADCAST_ANSWER_DELAY_US // 1000)
    results = table(("Result", "Meaning"), RESULTS.items())
    return "\n\n".join([text.strip(), results, overview, *map(_verb_section, VERBS.values())])


def _verb_section(verb: VerbDeclaration) -> str:
    parts = [f"#### {int(verb.verb)} {verb.name}", verb.sentence]
    for title, fields in (("Arguments:", verb.arguments), ("Payload of the answer:", verb.payload)):
        parts += [title, fixed_table(fields)] if fields else []
    if verb.entries:
        parts += [f"then entries, at most {verb.max_entries}, each:", fixed_table(verb.entries)]
    if not verb.arguments and not verb.payload:
        parts.append("No arguments; an empty payload.")
    return "\n\n".join(parts)


def setting_section() -> str:
    """Return all settings."""
    overview = table(
        ("Key", "Name", "Type", "Unit", "One step", "From", "To", "Factory", "Meaning"),
        map(_setting_row, SETTINGS.values()),
    )
    return "\n\n".join([SETTINGS_RULES.strip(), overview])


def _setting_row(setting: Setting) -> tuple[object, ...]:
    declared = setting.value
    meanings = "; ".join(f"{number}: {meaning}" for number, meaning in declared.meanings.items())
    return (
        setting.key,
        f"`{declared.name}`",
        declared.type_name,
        declared.unit,
        "" if declared.scale is None else repr(declared.scale),
        *_limits(declared),
        _factory(setting),
        f"{declared.sentence} {meanings}{'.' if meanings else ''}".strip(),
    )


def _limits(declared: WireField) -> tuple[str, str]:
    """Return the least and the largest value, where they are not given by a list of meanings or by the
    type."""
    if declared.maximum is None:
        return "", ""
    return f"{declared.minimum or 0:.6g}", f"{declared.maximum:.6g}"


def _factory(setting: Setting) -> str:
    if setting.value.is_text:
        return "empty"
    if setting.value.count > 1:
        return "matrices 1, all else 0, 25 °C"
    return f"{setting.factory:.6g}"


def flash_section() -> str:
    """Return the two slots."""
    checksum = WireField(name="crc32", code="I", sentence="Over all bytes before it, magic included.")
    value = WireField(name="value", code="s", count=0, sentence="As many bytes as size says.")
    return FLASH.format(
        head=fixed_table(SLOT_FIELDS),
        entry=fixed_table((*ENTRY_FIELDS, value)),
        checksum=fixed_table((checksum,)),
        size=SLOT_SIZE,
        largest=MAX_IMAGE_SIZE,
    ).strip()


def transfer_section() -> str:
    """Long wire frames on CAN."""
    params = TransferParams()
    return TRANSFER.format(
        flow_control=fixed_table(FLOW_CONTROL_FIELDS),
        piece=MAX_PIECE_DATA_SIZE,
        flow_ms=params.flow_timeout_ns // 1_000_000,
        piece_ms=params.piece_timeout_ns // 1_000_000,
        wait_ms=params.wait_interval_ns // 1_000_000,
        retries=params.max_retries,
    ).strip()


def version_section() -> str:
    """Return how host and module agree on a version."""
    lowest, highest = SUPPORTED
    versions = f"version {lowest} alone" if lowest == highest else f"versions {lowest} to {highest}"
    return VERSIONS.format(versions=versions).strip()


def render() -> str:
    """Return the whole of ``README.md``."""
    sections = [
        INTRODUCTION,
        "## Wire frame",
        fixed_table((*HEADER_FIELDS, body_field("what the kind says"), CHECKSUM_FIELD)),
        f"The largest wire frame is {MAX_FRAME_SIZE} bytes before stuffing.",
        BYTE_STREAM,
        _worked_example(),
        _signing_section(),
        "## Kinds",
        _kind_table(),
        "A receiver accepts a body of exactly the length that its kind and mask demand. It counts kinds that "
        "it does not know and skips them. The header of a kind that the host sends names the module that is "
        "meant: 0 to 63, 254 the relay, 255 all of them.",
        *(_packet_section(packet_class) for packet_class in PACKETS.values()),
        _relay_section(),
        command_section(),
        setting_section(),
        flash_section(),
        _can_section(),
        transfer_section(),
        DBC,
        version_section(),
        RULES,
        "## What a receiver drops, and how it counts it",
        table(("Reason", "What was wrong"), ((defect.name, defect.value) for defect in Defect)),
        VECTORS,
        HISTORY,
    ]
    return "\n\n".join(section.strip() for section in sections) + "\n"


def _kind_table() -> str:
    rows = [
        (
            f"0x{kind:02X}",
            f"`{kind.name}`",
            "host" if kind in FROM_HOST else "module",
            _sizes(kind),
            CAN_PRIORITY.get(kind, LOWEST_CAN_PRIORITY),
        )
        for kind in Kind
    ]
    return table(("Kind", "Name", "Sent by", "Body, bytes", "CAN priority"), rows)


def _sizes(kind: Kind) -> str:
    if kind not in PACKETS:
        return "any"
    layout = layout_of(PACKETS[kind])
    sizes = sorted({layout.sizes(mask) for mask in layout.valid_masks()})
    return ", ".join(str(least) if least == most else f"{least} to {most}" for least, most in sizes)


def _packet_section(packet_class: type[Packet]) -> str:
    layout = layout_of(packet_class)
    title = f"### 0x{packet_class.KIND:02X} {packet_class.__name__}"
    parts = [title, inspect.getdoc(packet_class) or ""]
    if layout.has_mask:
        parts += [
            "The body begins with a `mask` (u8) and goes on with the fields whose bit is set, in this order:",
            masked_table(layout.fields),
            "The other bits of the mask:",
            flag_table(layout),
        ]
    else:
        parts.append(fixed_table(layout.fields))
    return "\n\n".join(parts)


def _relay_section() -> str:
    table = fixed_table((*relay.ENTRY_FIELDS, body_field("as many bytes as length says")))
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


def _signing_section() -> str:
    signer = crc32(b"module 3's chip")
    sent = encode_frame(GOOD)
    return SIGNING.format(
        key_size=signing.KEY_SIZE,
        tag_size=signing.TAG_SIZE,
        window=signing.WINDOW,
        signature=fixed_table(signing.SIGNATURE_FIELDS),
        signer=signer,
        sent=signing.SignedFrames(KEY, signer).sign(sent).removesuffix(sent).hex(" "),
    )


def _can_section() -> str:
    identifier = table(
        ("Bits", "Part", "Meaning"),
        (
            (_bits(name), f"`{name}`", can_framing.IDENTIFIER_MEANINGS[name])
            for name, _ in can_framing.IDENTIFIER_BITS
        ),
    )
    payload = fixed_table(
        (*can_framing.HEAD_FIELDS, body_field("as many bytes as body_length says"), CHECKSUM_FIELD)
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
