"""What names may look like that come from outside."""

from __future__ import annotations

_REPLACED = "\N{REPLACEMENT CHARACTER}"

RECORDING_NAME = r"^[A-Za-z0-9][A-Za-z0-9_-]{0,63}$"
"""Nothing that could mean another folder."""

KEPT_FILE = r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,127}$"
"""Of a file in the folder of the recordings: nothing that could mean another folder, nothing hidden."""

PLAIN_NAME = r"^[A-Za-z0-9_-]+$"
"""Of a gateway, or a person: a level of a topic, and part of a file's name."""

UNIQUE_ID = r"^[0-9a-f]{24}$"
"""Of a device: 12 bytes, hexadecimal."""

SETTING_PLACE = r"^[a-z0-9_]+(\.[a-z0-9_]+){0,3}$"
"""Of a setting of the gateway, with the sections that it stands in."""

LOWER_NAME = r"^[a-z0-9_]+$"
"""Of a segment, a body or a joint."""

IN_WORDS = {
    RECORDING_NAME: "a name of up to 64 letters a to z, digits, '-' and '_' is wanted, and no path",
    KEPT_FILE: "a name of up to 128 letters a to z, digits, '-', '_' and '.' is wanted, and no path; "
    "recording/list has them",
    PLAIN_NAME: "a name of letters a to z, digits, '-' and '_' is wanted",
    UNIQUE_ID: "this is no unique id: 24 hexadecimal digits (0-9, a-f) are wanted",
    SETTING_PLACE: "the name of a setting is wanted, such as recording.rotate_minutes",
    LOWER_NAME: "a name of small letters a to z, digits and '_' is wanted",
}
"""What to write instead, by the pattern that a name does not fit."""


def printable(text: str) -> str:
    """Return a text without what a terminal would obey: control characters, escapes, changes of direction."""
    return text if text.isprintable() else "".join(c if c.isprintable() else _REPLACED for c in text)
