"""Which protocol versions are spoken, and how two parties agree on one."""

from __future__ import annotations

from typing import NamedTuple

from firmware_protocol.framing import PROTOCOL_VERSION


class VersionRange(NamedTuple):
    """Protocol versions from ``lowest`` to ``highest``, both included."""

    lowest: int
    highest: int


SUPPORTED = VersionRange(PROTOCOL_VERSION, PROTOCOL_VERSION)
"""What this package speaks."""

NO_VERSION = 0
"""Stands for "none in common" in the answer to HELLO."""


def negotiate(one: tuple[int, int], other: tuple[int, int]) -> int | None:
    """Return the highest version in both ranges (lowest, highest); None when they share none."""
    lowest, highest = max(one[0], other[0]), min(one[1], other[1])
    return highest if lowest <= highest and highest != NO_VERSION else None
