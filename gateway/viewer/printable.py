"""Names that others chose, on a terminal."""

from __future__ import annotations

_REPLACED = "\N{REPLACEMENT CHARACTER}"


def printable(text: str) -> str:
    """Return a text without what a terminal would obey: control characters, escapes, changes of direction."""
    return text if text.isprintable() else "".join(c if c.isprintable() else _REPLACED for c in text)
