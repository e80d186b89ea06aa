"""The header's constants: limits of the protocol, kinds, reasons to drop, places in CAN identifiers."""

from __future__ import annotations

from collections.abc import Iterable
from enum import IntEnum
from itertools import pairwise

from firmware_protocol import can_framing, commands, flash_slots, framing, relay, signing
from firmware_protocol.c.conversions import function, return_if
from firmware_protocol.c.spelling import c_name, comment, define, heading, macro_name
from firmware_protocol.fields import WireField
from firmware_protocol.framing import NO_VERSION, SUPPORTED
from firmware_protocol.kinds import CAN_PRIORITY, FROM_HOST, LOWEST_CAN_PRIORITY, Kind
from firmware_protocol.messages import UNIQUE_ID_SIZE
from firmware_protocol.packets import PACKETS

_HEAD_SIZE = sum(f.size for f in can_framing.HEAD_FIELDS)
_HEADER_SIZE = sum(f.size for f in framing.HEADER_FIELDS)
_CHECKSUM_SIZE = framing.CHECKSUM_FIELD.size


def constants_source() -> str:
    """Return every constant, the enumerations, and the functions that return what belongs to a kind."""
    sections = [
        heading("Constants of the protocol"),
        "\n".join(define(macro_name(name), f"{value}u", note) for name, value, note in _limits()),
        _identifier_places(),
        enum_source("defect", "Why received bytes were dropped.", _defects()),
        define(macro_name("defects"), f"{len(framing.Defect) + 1}u", "how many counters there are"),
        enum_source("kind", "What a wire frame carries.", ((k.name, int(k), _kind_note(k)) for k in Kind)),
        _priority(),
        _module_check(),
    ]
    return "\n\n".join(sections)


def enum_source(name: str, sentence: str, members: Iterable[tuple[str, int, str]]) -> str:
    """Return an enumeration, from names, numbers and remarks."""
    prefix = () if name == "defect" else (name,)
    lines: list[str] = []
    for member, number, note in members:
        lines += [comment(note, "    ")] if note else []
        lines.append(f"    {macro_name(*prefix, member)} = {number},")
    lines[-1] = lines[-1].rstrip(",")
    return "\n".join([comment(sentence), "typedef enum {", *lines, f"}} {c_name(name)};"])


def enum_members(enum: type[IntEnum]) -> Iterable[tuple[str, int, str]]:
    """Return members of a declared enumeration, without remarks."""
    return ((member.name, int(member), "") for member in enum)


def _limits() -> Iterable[tuple[str, int, str]]:
    return (
        ("protocol_version", framing.PROTOCOL_VERSION, ""),
        ("lowest_version", SUPPORTED.lowest, "spoken by this header"),
        ("highest_version", SUPPORTED.highest, ""),
        ("no_version", NO_VERSION, ""),
        ("delimiter", framing.DELIMITER[0], ""),
        ("max_module", framing.MAX_MODULE, "largest id of a module"),
        ("relay", framing.RELAY, "the relay's id"),
        ("broadcast", framing.BROADCAST, "from the host: every module"),
        ("header_size", _HEADER_SIZE, "version, kind, module, sequence, module_time_us"),
        ("min_frame_size", framing.MIN_FRAME_SIZE, "header and checksum"),
        ("max_frame_size", framing.MAX_FRAME_SIZE, "before stuffing"),
        ("max_body_size", framing.MAX_BODY_SIZE, ""),
        ("max_stuffed_size", framing.MAX_STUFFED_SIZE, "without delimiter"),
        ("key_size", signing.KEY_SIZE, "of a signed link"),
        ("tag_size", signing.TAG_SIZE, ""),
        ("signature_mark", signing.MARK, ""),
        ("signature_size", signing.SIGNATURE_SIZE, "mark, signer, count, tag"),
        ("sent_signature_size", signing.SENT_SIGNATURE_SIZE, "stuffed, with its delimiter"),
        ("host_signer", signing.HOST_SIGNER, ""),
        ("relay_entry_size", _size(relay.ENTRY_FIELDS), "before the body of an entry"),
        ("relay_max_entry_body_size", relay.MAX_ENTRY_BODY_SIZE, ""),
        ("can_head_size", _HEAD_SIZE, "sequence, module_time_us, body_length"),
        ("can_overhead", _HEAD_SIZE + _CHECKSUM_SIZE, "head and checksum"),
        ("can_max_body_size", can_framing.MAX_CAN_BODY_SIZE, "CAN FD"),
        ("can_max_classic_body_size", can_framing.MAX_CLASSIC_BODY_SIZE, ""),
        ("can_max_padding", _max_padding(), "CAN FD"),
        ("unique_id_size", UNIQUE_ID_SIZE, ""),
        ("answer_memory", commands.ANSWER_MEMORY, "answers that a device remembers"),
        ("broadcast_answer_delay_us", commands.BROADCAST_ANSWER_DELAY_US, "times the device's id"),
        ("factory_reset_magic", commands.FACTORY_RESET_MAGIC, ""),
        ("all_files", commands.ALL_FILES, ""),
        ("slot_magic", flash_slots.SLOT_MAGIC, ""),
        ("slot_magic_size", flash_slots.SLOT_FIELDS[0].size, ""),
        ("slot_head_size", _size(flash_slots.SLOT_FIELDS), "magic, generation, length, reserved"),
        ("slot_entry_size", _size(flash_slots.ENTRY_FIELDS), "key, size"),
        ("slot_image_size", flash_slots.MAX_IMAGE_SIZE, "a slot with every setting"),
    )


def _size(fields: Iterable[WireField]) -> int:
    return sum(f.size for f in fields)


def _max_padding() -> int:
    lengths = can_framing.FD_LENGTHS
    return max(longer - shorter for shorter, longer in pairwise(lengths)) - 1


def _identifier_places() -> str:
    bits = (
        f"{name}:{width} [{can_framing.IDENTIFIER_SHIFT[name]}]"
        for name, width in can_framing.IDENTIFIER_BITS
    )
    note = comment("CAN identifier, 29 bits; name:bits [lowest bit]: " + ", ".join(bits))
    places = (
        define(macro_name("can", name, "shift"), f"{shift}u")
        for name, shift in can_framing.IDENTIFIER_SHIFT.items()
    )
    return "\n".join([note, *places])


def _defects() -> Iterable[tuple[str, int, str]]:
    yield "GOOD", 0, "nothing was wrong"
    for number, defect in enumerate(framing.Defect, start=1):
        yield defect.name, number, defect.value


def _kind_note(kind: Kind) -> str:
    return "from the host" if kind in FROM_HOST else ""


def _priority() -> str:
    lines = ["switch (kind) {"]
    for priority in sorted(set(CAN_PRIORITY.values()) - {LOWEST_CAN_PRIORITY}):
        kinds = [kind for kind in Kind if CAN_PRIORITY.get(kind) == priority]
        lines += [f"    case {macro_name('kind', kind.name)}:" for kind in kinds]
        lines.append(f"        return {priority}u;")
    lines += ["    default:", f"        return {LOWEST_CAN_PRIORITY}u;", "}"]
    note = comment("Arbitration priority of a kind: 0 wins over all, 7 yields to all.")
    return note + "\n" + function(f"uint8_t {c_name('can', 'priority')}(uint8_t kind)", lines)


def _module_check() -> str:
    from_host = " || ".join(
        f"kind == {macro_name('kind', k.name)}" for k in Kind if k in FROM_HOST and k in PACKETS
    )
    lines = [
        *return_if("module <= MOCAP_MAX_MODULE || module == MOCAP_RELAY", "true"),
        f"return module == MOCAP_BROADCAST && ({from_host});",
    ]
    note = comment("Whether a header may hold this id: the module that sends, or that the host means.")
    return note + "\n" + function("bool mocap_is_module_allowed(uint8_t kind, uint8_t module)", lines)
