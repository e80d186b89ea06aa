"""What the modules of several files are called, by what their names do not share."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from devices.vendor_formats.sheets import FormatError

MOST_MODULES = 60
"""Ids from 60 on are left to local measuring devices."""


_SIDES = frozenset(("left", "right", "l", "r"))


def labels_of(paths: Sequence[Path]) -> list[str]:
    """Return a name for each file: its stem without what all have in common, cut between words."""
    stems = [path.stem for path in paths]
    words = [re.split(r"(?<=[_\- ])", stem) for stem in stems]
    shared = 0
    while len(stems) > 1 and all(len(each) > shared + 1 for each in words):
        # Of 'left thigh' and 'left shank' the side belongs to both names.
        if len({each[shared] for each in words}) > 1 or words[0][shared].strip("_- ").lower() in _SIDES:
            break
        shared += 1
    return ["".join(each[shared:]) for each in words]


def refuse_repeats(labels: Sequence[str]) -> None:
    """Raise ``FormatError`` for two modules of one name, or for more than there can be."""
    for label in labels:
        if labels.count(label) > 1:
            raise FormatError(f"two modules are called '{label}': name each once")
    if len(labels) > MOST_MODULES:
        raise FormatError(f"{len(labels)} modules: {MOST_MODULES} at most can be in one recording")
