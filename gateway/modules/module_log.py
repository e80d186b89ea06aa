"""What is logged of modules: what they say in words, and those that the rig does not name."""

from __future__ import annotations

import logging
from collections.abc import Iterable

from devices.link import Chunk
from firmware_protocol import RELAY, ReceivedPacket
from firmware_protocol.messages import Event, LogLine
from gateway.body.skeleton import WornSuit
from gateway.modules.summary import module_names
from gateway.sources.statistics import ModuleRecord
from gateway.sources.suit import SuitSource

_log = logging.getLogger(__name__)

_EVENTS = {
    1: "button pressed",
    2: "tapped",
    3: "tapped twice",
    4: "shaken",
    5: "charger connected",
    6: "charger removed",
    7: "settings committed",
    8: "started from the factory settings: the stored ones could not be read",
}
_LEVELS = {1: "error", 2: "warning", 3: "info", 4: "debug"}

MOST_LINES = 5
"""Lines of one module in one interval; what is more is counted and reported with the next one."""

INTERVAL_NS = 1_000_000_000


class ModuleLog:
    """Bytes from outside: a module that talks without end must not fill the disk."""

    def __init__(self) -> None:
        self._interval: dict[int, int] = {}
        self._lines: dict[int, int] = {}

    def listen_to(self, stream: SuitSource) -> None:
        """Log what a stream receives from now on."""
        stream.listen(Event, self.take)
        stream.listen(LogLine, self.take)

    def take(self, received: ReceivedPacket, chunk: Chunk) -> None:
        """Log one packet, by the time at which it came."""
        packet = received.packet
        if isinstance(packet, Event):
            level, text = logging.INFO, _EVENTS.get(packet.event, f"event {packet.event}")
        elif isinstance(packet, LogLine):
            # No line of a module may look like several of ours.
            word = _LEVELS.get(packet.level, "log")
            level, text = logging.DEBUG if word == "debug" else logging.INFO, f"{word}: {packet.text!r}"
        else:
            return
        suppressed = self._suppressed(received.module, chunk.arrived_ns // INTERVAL_NS)
        if suppressed is not None:
            more = f" ({suppressed} lines before that left out)" if suppressed else ""
            _log.log(level, "module %d: %s%s", received.module, text, more)

    def _suppressed(self, module: int, interval: int) -> int | None:
        """Return how many lines were left out just before this one; None: this one is left out too."""
        left_out = 0
        if self._interval.get(module) != interval:
            left_out = max(0, self._lines.get(module, 0) - MOST_LINES)
            self._interval[module], self._lines[module] = interval, 0
        self._lines[module] += 1
        return left_out if self._lines[module] <= MOST_LINES else None


class UnknownModules:
    """Who of those heard is in the rig, and who is not."""

    def __init__(self, stream: SuitSource, suit: WornSuit, unworn: Iterable[int] = ()) -> None:
        """Look at nothing yet. unworn: numbers of those that may well be heard and not be in the rig."""
        self._stream, self._unworn = stream, frozenset({RELAY, *unworn})
        self.names = module_names(suit)
        """What each module of the rig is on, by id."""
        self._reported: set[int] = set()

    @property
    def known(self) -> int:
        """How many modules of the rig have been heard."""
        return len(self.names.keys() & self._stream.modules.keys())

    def news(self) -> str | None:
        """Return who is heard and not in the rig, and what to do; None when that was reported already."""
        reporting = self._stream.modules
        unknown = {module for module in reporting if module not in self.names} - self._unworn
        if unknown <= self._reported:
            return None
        self._reported |= unknown
        listed = ", ".join(_named(module, reporting[module]) for module in sorted(unknown))
        silent = [f"{module} ({name})" for module, name in self.names.items() if module not in reporting]
        missing = f"; of the rig, not heard: {', '.join(silent)}" if silent else ""
        return (
            f"heard, but not in the rig: module {listed}{missing}. Nothing is made of what they send: "
            "add them to the rig file, or give them its ids (mocap-gateway modules assign --allow-writes)"
        )


def _named(module: int, record: ModuleRecord) -> str:
    return str(module) if record.info is None else f"{module} (unique id {record.info.unique_id.hex()})"
