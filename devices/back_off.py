"""How long to wait before something is tried again."""

from __future__ import annotations


class BackOff:
    """Delays between attempts, s: doubling from the first to the longest."""

    def __init__(self, first: float, longest: float) -> None:
        self.longest = longest
        self._first = first
        self._next = first

    def next_delay(self) -> float:
        """Return how long to wait before the next attempt, s; it doubles at every call, up to the longest."""
        delay = self._next
        self._next = min(2 * delay, self.longest)
        return delay

    def reset(self) -> None:
        """Begin anew with the first delay: an attempt has succeeded."""
        self._next = self._first
