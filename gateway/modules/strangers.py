"""Modules that are heard and that the rig does not name: nothing is made of what they send."""

from __future__ import annotations

from firmware_protocol import RELAY
from gateway.body.skeleton import WornSuit
from gateway.modules.summary import module_names
from gateway.sources.statistics import ModuleRecord
from gateway.sources.stream import Stream


class Strangers:
    """Who of those heard is in the rig, and who is not."""

    def __init__(self, stream: Stream, suit: WornSuit) -> None:
        """Look at nothing yet."""
        self._stream = stream
        self.names = module_names(suit)
        """What each module of the rig is on, by id."""
        self._told: set[int] = set()

    @property
    def known(self) -> int:
        """How many modules of the rig have been heard."""
        return len(self.names.keys() & self._stream.modules.keys())

    def news(self) -> str | None:
        """Return who is heard and not in the rig, and what to do; None when that was told already."""
        heard = self._stream.modules
        strangers = {module for module in heard if module not in self.names and module != RELAY}
        if strangers <= self._told:
            return None
        self._told |= strangers
        listed = ", ".join(_named(module, heard[module]) for module in sorted(strangers))
        silent = [f"{module} ({name})" for module, name in self.names.items() if module not in heard]
        missing = f"; of the rig, not heard: {', '.join(silent)}" if silent else ""
        return (
            f"heard, but not in the rig: module {listed}{missing}. Nothing is made of what they send: "
            "add them to the rig file, or give them its ids (mocap-gateway modules assign --allow-writes)"
        )


def _named(module: int, record: ModuleRecord) -> str:
    return str(module) if record.info is None else f"{module} (unique id {record.info.unique_id.hex()})"
