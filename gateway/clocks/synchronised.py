"""Clocks of modules that keep themselves together: one line of rate and offset for all that agree."""

from __future__ import annotations

from gateway.clocks.batching import LinkBatching
from gateway.clocks.counter import COUNTER_BITS, unwrap
from gateway.clocks.estimated import EstimatedClock
from gateway.clocks.module_clock import ClockFigures

_EARLY_NS, _LATE_NS = 500_000_000, 2_000_000_000
"""A stamp that is so far ahead of its arrival, or behind it, does not count the time of a group."""
_PATIENCE_NS = 300_000_000
"""A module out of step for so long has left; a single stamp may be damaged."""
_LOOKS_NS = 1_000_000_000
"""So often a module looks whether an older group counts its time."""


class _Group:
    """Modules that count one time."""

    def __init__(self, batching: LinkBatching) -> None:
        """Begin without members; ``batching`` is that of the first module's link."""
        self.clock = EstimatedClock(batching)
        self.members = 0

    def is_in_step(self, stamp_us: int, arrived_ns: int) -> bool:
        """Return whether a stamp of 32 bits can be of this time; the first one always is."""
        if not self.members:
            return True
        return -_EARLY_NS <= arrived_ns - self.instant_ns(stamp_us) <= _LATE_NS

    def instant_ns(self, stamp_us: int) -> int:
        """Return the gateway time, ns, of a stamp, by what is known now."""
        return self.clock.instant_ns(unwrap(stamp_us, COUNTER_BITS, self.clock.newest_us))


class SynchronisedClocks:
    """All groups, the oldest first: one where all modules are synchronised."""

    def __init__(self) -> None:
        self._groups: list[_Group] = []

    def clock(self, batching: LinkBatching) -> SynchronisedClock:
        """Return the clock of another module. batching: of its link."""
        return SynchronisedClock(self, batching)

    def join(self, stamp_us: int, arrived_ns: int, batching: LinkBatching) -> _Group:
        """Return the group whose time a stamp is of, a new one where there is none; one more is in it."""
        for group in self._groups:
            if group.is_in_step(stamp_us, arrived_ns):
                break
        else:
            group = _Group(batching)
            self._groups.append(group)
        group.members += 1
        return group

    def leave(self, group: _Group) -> None:
        """Take one out of a group, which ends with the last."""
        group.members -= 1
        if not group.members:
            self._groups.remove(group)


class SynchronisedClock:
    """A module that counts the time of a group: what one member is sent holds for all."""

    def __init__(self, all_clocks: SynchronisedClocks, batching: LinkBatching) -> None:
        self.restarts = 0
        """How often it was found to count another time than its group."""
        self._all, self._batching = all_clocks, batching
        self._group: _Group | None = None
        self._out_since_ns: int | None = None
        self._looked_ns = 0

    def gateway_time(self, module_time_us: int, arrived_ns: int) -> int:
        """Return the gateway time, ns, of a 32-bit stamp that arrived at ``arrived_ns``."""
        group = self._group
        if group is None:
            group = self._joined(module_time_us, arrived_ns)
        elif not group.is_in_step(module_time_us, arrived_ns):
            if self._out_since_ns is None:
                self._out_since_ns = arrived_ns
            # A few packets that were under way for long must not move the module out of its group.
            if arrived_ns - self._out_since_ns < _PATIENCE_NS:
                return min(group.instant_ns(module_time_us), arrived_ns)
            self.restarts += 1
            group = self._joined(module_time_us, arrived_ns)
        elif arrived_ns - self._looked_ns > _LOOKS_NS:
            group = self._joined(module_time_us, arrived_ns)
        self._out_since_ns = None
        return group.clock.gateway_time(module_time_us, arrived_ns)

    def figures(self) -> ClockFigures:
        """Return offset and rate of its group."""
        return ClockFigures(0, 0.0) if self._group is None else self._group.clock.figures()

    def _joined(self, stamp_us: int, arrived_ns: int) -> _Group:
        """Return the oldest group that counts its time, which it is in from now on."""
        group = self._all.join(stamp_us, arrived_ns, self._batching)
        if self._group is not None:
            self._all.leave(self._group)
        self._group, self._looked_ns = group, arrived_ns
        return group
