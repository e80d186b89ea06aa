"""What went into a part of the gateway, and what became of it: totals that are always even."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Balance:
    """One total, and what became of it."""

    name: str
    total: int
    parts: Mapping[str, int]

    @property
    def unaccounted(self) -> int:
        """Total less all parts: 0, or the gateway has a defect."""
        return self.total - sum(self.parts.values())

    def summary(self) -> dict[str, object]:
        """For the health message."""
        return {"total": self.total, "parts": dict(self.parts), "unaccounted": self.unaccounted}


def unaccounted(balances: Sequence[Balance]) -> dict[str, int]:
    """By name: what is left over, where that is anything but 0."""
    return {balance.name: balance.unaccounted for balance in balances if balance.unaccounted}
