"""What went into a part of the gateway, and what became of it: totals that are always even."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
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
        """Return total, parts and rest, for the health message."""
        return {"total": self.total, "parts": dict(self.parts), "unaccounted": self.unaccounted}


def joined(shares: Iterable[Balance]) -> list[Balance]:
    """Return whole balances from the shares of several parts: totals and parts of one name are added up."""
    totals: dict[str, int] = {}
    parts: dict[str, Counter[str]] = {}
    for share in shares:
        totals[share.name] = totals.get(share.name, 0) + share.total
        of_name = parts.setdefault(share.name, Counter())
        for part, count in share.parts.items():
            of_name[part] += count
    return [Balance(name, total, dict(parts[name])) for name, total in totals.items()]


def unaccounted(balances: Sequence[Balance]) -> dict[str, int]:
    """Return by name what is left over, where that is anything but 0."""
    return {balance.name: balance.unaccounted for balance in balances if balance.unaccounted}
