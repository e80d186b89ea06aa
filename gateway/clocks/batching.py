"""How a link hands over what it has: at once, or at multiples of a slot (USB frames, adapter timers).

All modules of a link share this; those behind a relay unit share its ticks. The clocks need it: a packet that
came at the end of a slot may have been ready at any time within it.
"""

from __future__ import annotations

import numpy as np

_SAME_CHUNK_NS = 200_000
"""Reads that follow each other more closely belong to one hand-over."""
_SHORTEST_SLOT_US = 400.0
_GAPS = 256
_FIRST_GAPS = (12, 48)
"""The slot is estimated early, from few gaps, since the clocks begin without knowing it; then better."""
_TOLERANCE = 0.15
"""How far, as a part of the slot, a gap may be from a multiple of it: the host wakes up late."""
_SHARE = 0.95


class LinkBatching:
    """Finds the slot of one link from the arrival times of its chunks."""

    def __init__(self) -> None:
        self.slot_us = 0.0
        """0: packets are handed over as they come."""
        self._last_ns = 0
        self._gaps: list[int] = []
        self._first = list(_FIRST_GAPS)

    def observe(self, arrived_ns: int) -> None:
        """Note the arrival of a chunk, and estimate the slot from the gaps so far."""
        gap = arrived_ns - self._last_ns
        # Reads that follow at once took the rest of what one slot had brought.
        if gap < _SAME_CHUNK_NS:
            return
        self._last_ns = arrived_ns
        self._gaps.append(gap)
        if self._first and len(self._gaps) > self._first[0]:
            self._first.pop(0)
            self.slot_us = slot_of_gaps(self._gaps[1:])
        if len(self._gaps) > _GAPS:
            self.slot_us = slot_of_gaps(self._gaps[1:])
            self._gaps = []


class RelayBatching(LinkBatching):
    """Finds the tick of the relay unit on one link, from its own stamps on the batches."""

    def __init__(self) -> None:
        super().__init__()
        self._tick_us = 0
        self._elapsed_ns = 0

    def observe_tick(self, relayed_us: int) -> None:
        """Note the stamp of the batch in which a packet came, µs modulo 2^32."""
        if relayed_us != self._tick_us:
            self._elapsed_ns += (relayed_us - self._tick_us) % 2**32 * 1000
            self._tick_us = relayed_us
            self.observe(self._elapsed_ns)


def slot_of_gaps(gaps_ns: list[int]) -> float:
    """Return the slot in µs that gaps between hand-overs are multiples of; 0 for none."""
    gaps_us = np.array(gaps_ns) * 1e-3
    slot_us = float(np.quantile(gaps_us, 0.02))
    for _ in range(2):  # the shortest gaps give it roughly, all of them exactly
        multiples = np.maximum(np.round(gaps_us / slot_us), 1.0)
        slot_us = float(np.median(gaps_us / multiples))
    fits = np.abs(gaps_us - np.round(gaps_us / slot_us) * slot_us) < _TOLERANCE * slot_us
    return slot_us if slot_us >= _SHORTEST_SLOT_US and fits.mean() >= _SHARE else 0.0
