"""The sections of ``README.md`` on commands, settings, flash, long wire frames on CAN, and versions."""

from __future__ import annotations

from firmware_protocol.can_transfer import FLOW_CONTROL_FIELDS, TransferParams
from firmware_protocol.commands import (
    ANSWER_MEMORY,
    BROADCAST_ANSWER_DELAY_US,
    VERBS,
    VerbDeclaration,
)
from firmware_protocol.device_settings import SETTINGS, Setting
from firmware_protocol.document_tables import fixed_table, table
from firmware_protocol.fields import WireField
from firmware_protocol.flash_slots import ENTRY_FIELDS, MAX_IMAGE_SIZE, SLOT_FIELDS, SLOT_SIZE
from firmware_protocol.messages import MAX_PIECE_DATA_SIZE, RESULTS
from firmware_protocol.prose import COMMANDS, FLASH, SETTINGS_RULES, TRANSFER, VERSIONS
from firmware_protocol.versions import SUPPORTED


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
