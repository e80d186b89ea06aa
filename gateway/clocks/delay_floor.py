"""The least delay of one way, as a line that is followed: state around the kernels of ``floor_filter``."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from gateway.clocks import floor_filter
from gateway.frames import FloatArray

REMEMBERED = 1_000
"""Packets over which the mean delay is averaged."""
SHORTEST_SLOT_US = 40.0
"""No host's arrival time is finer."""
_LARGEST_RATE_PPM = 10_000.0
_OFFSET_SIGMA_US = 1e6
_MEAN_DELAY_US = 1_000.0
_CONFLICT = 5.0
"""Standard deviations that packets can move a state by; by more, it was surer than it had reason to be."""


class FloorWalk(NamedTuple):
    """How a floor changes by itself."""

    rate_sigma_ppm: float
    """Of the rate, before anything is known."""
    rate_ppm2_per_s: float
    offset_us2_per_s: float


CRYSTAL = FloorWalk(rate_sigma_ppm=3_000.0, rate_ppm2_per_s=1.0 / 60.0, offset_us2_per_s=4.0)
"""Real modules have been seen 0.3 % off; temperature moves a rate by 1 ppm in a minute; sampling timers
are not perfect."""
TRANSPORT = FloorWalk(rate_sigma_ppm=1e-3, rate_ppm2_per_s=0.0, offset_us2_per_s=1.0)
"""The shortest round trip of a link stays what it is."""


class DelayFloor:
    """Offset and rate of the floor of delays, with their covariance."""

    def __init__(self, walk: FloorWalk = CRYSTAL) -> None:
        self._walk = walk
        self.packets = 0
        """Taken in so far; counted up to ``REMEMBERED``."""
        self.residual_us = 0.0
        """Mean delay of recent packets above the floor."""
        self._mean_delay_us = _MEAN_DELAY_US
        self._x: FloatArray = np.zeros(2)
        self._P: FloatArray = np.zeros((2, 2))
        self.begin(walk.rate_sigma_ppm)

    def begin(self, rate_sigma_ppm: float) -> None:
        """Forget the offset; keep the rate as a first guess, so sure."""
        self._time_us: int | None = None
        self._x[0] = 0.0
        self._P = np.diag([_OFFSET_SIGMA_US**2, rate_sigma_ppm**2])
        self._remember()

    def take_back(self, forgets_delays: bool = False) -> None:
        """Be as at the last ``begin`` or ``rebase``: what was taken in since then comes once more.

        The mean delay found meanwhile stays, but with ``forgets_delays``: then it was waiting for a slot.
        """
        self.packets = 0
        self._time_us, x, self._P = self._begun
        self._x = x.copy()
        if forgets_delays:
            self._mean_delay_us = _MEAN_DELAY_US

    def rebase(self) -> None:
        """Count module time anew from here; the floor stays what it was."""
        if self._time_us is not None:
            self._time_us = 0
            self._remember()

    def _remember(self) -> None:
        self._begun = self._time_us, self._x.copy(), self._P

    @property
    def is_known(self) -> bool:
        """Whether a stamp has come since the beginning or the last reset."""
        return self._time_us is not None

    @property
    def rate_ppm(self) -> float:
        """Estimated rate of the module's clock against gateway time, ppm."""
        return float(self._x[1])

    @property
    def rate_sigma_ppm(self) -> float:
        """Standard deviation of the rate; before anything is known, that of crystals as such."""
        return math.sqrt(self._P[1, 1])

    @property
    def sigma_us(self) -> float:
        """Standard deviation of the offset at the newest time; of no meaning before there is one."""
        return math.sqrt(self._P[0, 0])

    def offset_us(self, time_us: int) -> float:
        """Return the floor at a module time."""
        since_us = 0 if self._time_us is None else time_us - self._time_us
        return float(self._x[0] + self._x[1] * 1e-6 * since_us)

    def update(self, newest_us: int, elapsed_s: FloatArray, delays_us: FloatArray, slot_us: float) -> None:
        """Take in packets.

        newest_us: module time that the state shall stand at; elapsed_s: (n,) before it (<= 0);
        delays_us: (n,).
        """
        x, P = self._at(newest_us, elapsed_s, delays_us)
        slot_us = max(slot_us, SHORTEST_SLOT_US)
        packets = (elapsed_s, delays_us, self._mean_delay_us, slot_us)
        after, P_after, score, residual_us = floor_filter.update(x, P, *packets)
        if floor_filter.distance(x, P, after) > _CONFLICT:
            # Rather the floor is another one than the rate: a crystal keeps it.
            P = np.diag([_OFFSET_SIGMA_US**2, P[1, 1]])
            after, P_after, score, residual_us = floor_filter.update(x, P, *packets)
        if abs(after[1]) < _LARGEST_RATE_PPM:
            x, P = after, P_after
        else:  # no crystal is like that: a backlog that came all at once; it gives the least delay only
            x[0] = min(x[0], float((delays_us - x[1] * elapsed_s).min()))
        self._x, self._P, self._time_us = x, P, newest_us
        n = len(delays_us)
        self.packets = min(self.packets + n, REMEMBERED)
        self._mean_delay_us *= math.exp(min(max(score / (self.packets + 20), -0.5), 0.5))
        self.residual_us += (residual_us - self.residual_us) * n / self.packets

    def _at(
        self, newest_us: int, elapsed_s: FloatArray, delays_us: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return state and covariance before packets are taken in, at the newest of them."""
        if self._time_us is None:
            return np.array([delays_us.min(), self._x[1]]), self._P
        walk, since_s = self._walk, (newest_us - self._time_us) * 1e-6
        return floor_filter.predict(self._x, self._P, since_s, walk.offset_us2_per_s, walk.rate_ppm2_per_s)


def warm_up() -> None:
    """Compile the kernels now, not when the first packets wait."""
    floor = DelayFloor()
    for time_us in (1, 2):
        floor.update(time_us, np.zeros(1), np.ones(1), 0.0)
