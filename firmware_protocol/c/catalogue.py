"""The header's lists: packets of every kind, verbs with their arguments and payloads, settings."""

from __future__ import annotations

import inspect
import struct
from collections.abc import Iterable, Iterator
from typing import Any

from firmware_protocol.c.constants import enum_members, enum_source
from firmware_protocol.c.conversions import (
    conversion_source,
    function,
    get_lines,
    loops_over,
    put_lines,
    refusals,
    return_if,
    text_refusal,
    validity_source,
)
from firmware_protocol.c.records import Record, record_of_fields, struct_source
from firmware_protocol.c.si_values import si_source
from firmware_protocol.c.spelling import C_TYPES, comment, define, heading, literal, macro_name, snake
from firmware_protocol.commands import VERBS, Result, VerbDeclaration
from firmware_protocol.device_settings import SETTINGS, Setting, encode_value
from firmware_protocol.fields import BYTE_ORDER, layout_of
from firmware_protocol.packets import PACKETS

_SETTINGS_SENTENCE = "Everything that a module can be told to keep."


def packets_source() -> str:
    """Return every packet, and the union of them all."""
    records = [
        Record(cls.__name__, f"0x{kind:02X}. {inspect.cleandoc(cls.__doc__ or '')}", layout_of(cls))
        for kind, cls in PACKETS.items()
    ]
    sections = [heading("Packets: the bodies of wire frames")]
    for record in records:
        sections += [struct_source(record), conversion_source(record), si_source(record)]
    return "\n\n".join(section for section in [*sections, _any_packet(records)] if section)


def _any_packet(records: list[Record]) -> str:
    names = [snake(record.name) for record in records]
    union = [f"        {record.c_type} {name};" for record, name in zip(records, names, strict=True)]
    lines = [comment("A packet of any kind."), "typedef struct {", "    uint8_t kind; /* mocap_kind */"]
    lines += ["    union {", *union, "    } as;", "} mocap_packet;", ""]
    calls = [f"mocap_decode_{name}(body, size, &packet->as.{name})" for name in names]
    lines += [
        comment("The packet that a body holds, or why it holds none."),
        function(
            "mocap_defect mocap_decode_packet(uint8_t kind, const uint8_t *body, size_t size, "
            "mocap_packet *packet)",
            ["packet->kind = kind;", *_switch_on_kind("kind", names, calls, "MOCAP_UNKNOWN_KIND")],
        ),
        "",
    ]
    calls = [f"mocap_encode_{name}(&packet->as.{name}, body, capacity)" for name in names]
    head = "size_t mocap_encode_packet(const mocap_packet *packet, uint8_t *body, size_t capacity)"
    lines += [function(head, _switch_on_kind("packet->kind", names, calls, "0u")), "", _known_kinds(names)]
    return "\n".join(lines)


def _known_kinds(names: list[str]) -> str:
    cases = [f"    case {macro_name('kind', name)}:" for name in names]
    lines = ["switch (kind) {", *cases, "        return true;", "    default:", "        return false;", "}"]
    note = comment("Whether a body of this kind is a packet; a relay batch holds several.")
    return note + "\n" + function("bool mocap_is_packet(uint8_t kind)", lines)


def _switch_on_kind(kind: str, names: list[str], calls: list[str], otherwise: str) -> list[str]:
    cases: list[str] = []
    for name, call in zip(names, calls, strict=True):
        cases += [f"    case {macro_name('kind', name)}:", f"        return {call};"]
    return [f"switch ({kind}) {{", *cases, "    default:", f"        return {otherwise};", "}"]


def verbs_source() -> str:
    """Return verbs and results, and a record for whatever goes with a verb."""
    sections = [
        heading("Commands: verbs, their arguments and payloads"),
        enum_source("verb", "What a command asks for.", ((v.name, n, v.sentence) for n, v in VERBS.items())),
        enum_source("result", "How a command ended.", enum_members(Result)),
        _changes_device(),
    ]
    for declared in VERBS.values():
        for record in _verb_records(declared):
            sections += [struct_source(record), conversion_source(record), si_source(record)]
    return "\n\n".join(section for section in sections if section)


def _verb_records(declared: VerbDeclaration) -> Iterator[Record]:
    for part, fields in (
        ("arguments", declared.arguments),
        ("payload", declared.payload),
        ("entry", declared.entries),
    ):
        if fields:
            where = f"{part} of {declared.name}"
            if part == "payload" and declared.entries:
                where = f"{where}, before its entries"
            if part == "entry":
                where = f"one of at most {declared.max_entries} entries in the payload of {declared.name}"
            yield record_of_fields(f"{declared.name}_{part}", f"{where.capitalize()}.", fields)


def _changes_device() -> str:
    verbs = [f"    case {macro_name('verb', v.name)}:" for v in VERBS.values() if v.changes_device]
    lines = ["switch (verb) {", *verbs, "        return true;", "    default:", "        return false;", "}"]
    note = comment("Whether the device keeps what the verb changes; refused while writes are locked.")
    return note + "\n" + function("bool mocap_verb_changes_device(uint8_t verb)", lines)


def settings_source() -> str:
    """Return the settings: struct, keys, factory values, one value at a time to and from bytes."""
    record = record_of_fields("Settings", _SETTINGS_SENTENCE, [s.value for s in SETTINGS.values()])
    keys = ", ".join(f"{key}u" for key in SETTINGS)
    sizes = [setting.value.size for setting in SETTINGS.values()]
    sections = [
        heading("Settings"),
        struct_source(record),
        enum_source("setting", "Key of each.", ((s.name, k, "") for k, s in SETTINGS.items())),
        define(macro_name("settings"), f"{len(SETTINGS)}u", "how many there are")
        + "\n"
        + define(macro_name("max_setting_size"), f"{max(sizes)}u", "bytes of the largest value"),
        comment("Key of the i-th setting, in rising order.")
        + "\n"
        + function(
            "uint8_t mocap_setting_key(size_t i)",
            [f"static const uint8_t keys[MOCAP_SETTINGS] = {{{keys}}};", "return keys[i];"],
        ),
        validity_source(record),
        _factory(),
        _read_setting(),
        _write_setting(),
        si_source(record),
    ]
    return "\n\n".join(sections)


def _factory() -> str:
    lines = ["memset(settings, 0, sizeof *settings);"]
    for setting in SETTINGS.values():
        lines += _factory_lines(setting)
    note = comment("The settings with which a module leaves the factory.")
    return note + "\n" + function("void mocap_settings_set_factory(mocap_settings *settings)", lines)


def _factory_lines(setting: Setting) -> Iterator[str]:
    """Yield assignments of what is not zero."""
    declared, target = setting.value, f"settings->{setting.name}"
    raw = encode_value(setting.key, setting.factory)
    elements: Iterable[Any] = (
        # Bytes stand for themselves; other values are written as numbers.
        raw if declared.code == "s" else struct.unpack(BYTE_ORDER + declared.struct_format, raw)
    )
    for place, element in enumerate(elements):
        if element:
            value = f"{element!r}f" if declared.code == "f" else literal(element, declared.code)
            yield f"{target}[{place}] = {value};" if declared.count > 1 else f"{target} = {value};"


def _read_setting() -> str:
    cases: list[str] = []
    for setting in SETTINGS.values():
        body = [
            *return_if(f"capacity < {setting.value.size}u", "0u"),
            *put_lines(setting.value, f"settings->{setting.name}"),
            "break;",
        ]
        cases += [f"case {macro_name('setting', setting.name)}:", *(f"    {line}" for line in body)]
    lines = ["uint8_t *p = value;", "size_t i;", "switch (key) {", *(f"    {line}" for line in cases)]
    lines += ["    default:", "        return 0u;", "}", "return (size_t)(p - value);"]
    settings = "const mocap_settings *settings, uint8_t key"
    head = f"size_t mocap_settings_read({settings}, uint8_t *value, size_t capacity)"
    note = comment("The bytes of one setting; 0 for a key that there is not.")
    return note + "\n" + function(head, lines)


def _write_setting() -> str:
    cases: list[str] = []
    for setting in SETTINGS.values():
        name = macro_name("setting", setting.name)
        cases += [f"case {name}: {{", *(f"    {line}" for line in _write_lines(setting)), "}"]
    lines = ["const uint8_t *p = value;", "switch (key) {", *(f"    {line}" for line in cases)]
    lines += ["    default:", "        return MOCAP_RESULT_NO_SUCH_SETTING;", "}"]
    settings = "mocap_settings *settings, uint8_t key"
    head = f"mocap_result mocap_settings_write({settings}, const uint8_t *value, size_t size)"
    note = comment("Takes one setting from bytes; what is no value of it is refused and changes nothing.")
    return note + "\n" + function(head, lines)


def _write_lines(setting: Setting) -> list[str]:
    declared, target = setting.value, f"settings->{setting.name}"
    wrong_size = return_if(f"size != {declared.size}u", "MOCAP_RESULT_BAD_ARGUMENTS")
    if declared.code == "s":
        text = text_refusal(declared, "p", f"{declared.count}u")
        refused = return_if(" || ".join(text), "MOCAP_RESULT_BAD_ARGUMENTS") if text else []
        copied = f"memcpy({target}, p, {declared.count}u);"
        return [*wrong_size, *refused, copied, "return MOCAP_RESULT_DONE;"]
    shape = f"[{declared.count}]" if declared.count > 1 else ""
    lines = [
        f"{C_TYPES[declared.code]} v{shape};",
        *(["size_t i;"] if loops_over([declared]) else []),
        *wrong_size,
    ]
    lines += [
        # A last step of p that nothing reads would make compilers warn.
        line
        for line in get_lines(declared, "v")
        if not (declared.count == 1 and line.startswith("p +="))
    ]
    refused = return_if(
        " || ".join(refusals(declared, "v[i]" if shape else "v")) or "false", "MOCAP_RESULT_BAD_ARGUMENTS"
    )
    if shape:
        refused = [f"for (i = 0; i < {declared.count}u; ++i) {{", *(f"    {line}" for line in refused), "}"]
    if declared.is_restricted:
        lines += refused
    stored = f"memcpy({target}, v, sizeof v);" if shape else f"{target} = v;"
    return [*lines, stored, "return MOCAP_RESULT_DONE;"]
