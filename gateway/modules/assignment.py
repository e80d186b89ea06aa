"""Which ids make a module the one of a segment, whoever has that id now. Pure."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from firmware_protocol import MAX_MODULE


@dataclass(frozen=True)
class Proposal:
    """What is to be written so that a module belongs to a segment."""

    segment: str
    unique_id: str
    before: int
    after: int
    displaced: str | None
    """Unique id of the module that has the id now; it gets ``before`` in exchange."""

    @property
    def is_right_already(self) -> bool:
        """Whether nothing would change."""
        return self.before == self.after

    @property
    def ids(self) -> dict[str, int]:
        """Module id by unique id, as the verb ``assign`` takes them."""
        ids = {self.unique_id: self.after}
        return ids if self.displaced is None else {**ids, self.displaced: self.before}

    def __str__(self) -> str:
        if self.is_right_already:
            return f"it is module {self.after} already"
        exchange = f", and module {self.after} ({self.displaced}) becomes module {self.before}"
        return f"it becomes module {self.after}{exchange if self.displaced else ''}"


class Wardrobe:
    """Who has which id, and which id each segment wants, while modules are assigned one after another."""

    def __init__(self, listed: Mapping[str, Any]) -> None:
        """Index the answer of the verb ``list``, which must have no conflicts."""
        self.segments: dict[str, int] = dict(listed["segments"])
        self.ids: dict[str, int] = {
            module["unique_id"]: module["module"]
            for module in listed["modules"]
            if module["answers"] and module["module"] <= MAX_MODULE
        }

    def propose(self, segment: str, unique_id: str) -> Proposal:
        """Return what makes this module that of the segment. Raises ``KeyError`` for one that was not
        heard."""
        wanted, before = self.segments[segment], self.ids[unique_id]
        holders = [uid for uid, module in self.ids.items() if module == wanted and uid != unique_id]
        return Proposal(segment, unique_id, before, wanted, holders[0] if holders else None)

    def note(self, changes: list[Mapping[str, Any]]) -> None:
        """Take over what was written."""
        for change in changes:
            if "module_id" in change["after"]:
                self.ids[change["unique_id"]] = change["after"]["module_id"]
