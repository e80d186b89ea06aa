"""What every live output is, and how it takes fewer poses than are reconstructed."""

from __future__ import annotations

from typing import Protocol

from gateway.frames import SkeletonFrame


class Output(Protocol):
    """Takes skeleton frames. ``offer`` never waits: a slow reader must not stall sensing."""

    def offer(self, frame: SkeletonFrame) -> None:
        """Take a frame, or drop it and count that. Never waits."""
        ...


class Thinning:
    """Lets through at most ``rate`` instants a second, on a regular grid; None lets all through."""

    def __init__(self, rate: float | None) -> None:
        self._period_ns = 0 if rate is None else round(1e9 / rate)
        self._last_ns = 0
        self._due_ns = 0

    def admits(self, time_ns: int) -> bool:
        """Return whether the value of this instant is to be kept. Time that runs backwards starts afresh."""
        if time_ns < self._last_ns:
            self._due_ns = time_ns
        self._last_ns = time_ns
        if time_ns < self._due_ns:
            return False
        on_grid = self._due_ns + self._period_ns
        self._due_ns = on_grid if on_grid > time_ns else time_ns + self._period_ns
        return True
