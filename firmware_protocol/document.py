"""Writes ``README.md``, the protocol's description for firmware authors, from the declarations.

::

    python -m firmware_protocol.document > firmware_protocol/README.md
"""

from __future__ import annotations

import inspect
import sys
from zlib import crc32

from firmware_protocol import can_framing, signing
from firmware_protocol.document_commands import (
    command_section,
    flash_section,
    setting_section,
    transfer_section,
    version_section,
)
from firmware_protocol.document_tables import body_field, fixed_table, flag_table, masked_table, table
from firmware_protocol.fields import layout_of
from firmware_protocol.framing import (
    CHECKSUM_FIELD,
    HEADER_FIELDS,
    MAX_FRAME_SIZE,
    Defect,
    encode_frame,
    serialize,
)
from firmware_protocol.golden_defects import GOOD
from firmware_protocol.golden_signing import KEY
from firmware_protocol.kinds import CAN_PRIORITY, FROM_HOST, LOWEST_CAN_PRIORITY, Kind
from firmware_protocol.packets import PACKETS, Packet
from firmware_protocol.prose import (
    BYTE_STREAM,
    CAN,
    DBC,
    HISTORY,
    INTRODUCTION,
    RELAY,
    RULES,
    SIGNING,
    VECTORS,
    WORKED_EXAMPLE,
)
from firmware_protocol.relay import ENTRY_FIELDS


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
    table = fixed_table((*ENTRY_FIELDS, body_field("as many bytes as length says")))
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
