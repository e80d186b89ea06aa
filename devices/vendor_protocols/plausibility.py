"""What the numbers of a message can be: a gate for each, counted by its name.

For protocols that check little or nothing of what they carry.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple


class Gate(NamedTuple):
    """What one number can be."""

    name: str
    """Under which values beyond are counted."""
    least: float
    most: float


def either_way(name: str, most: float) -> Gate:
    """Return the gate of a number that is as large either way."""
    return Gate(name, -most, most)


def fault(values: Sequence[float], gates: Iterable[Gate]) -> str | None:
    """Name what is wrong with numbers, one gate each; None: the device can have measured them."""
    for value, gate in zip(values, gates, strict=True):
        if not gate.least <= value <= gate.most:
            return gate.name if math.isfinite(value) else "not_finite"
    return None
