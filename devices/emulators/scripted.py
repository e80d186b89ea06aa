"""Joint angles as a script: amounts that are faded in and out, at rest or swinging, one after another.

Made of terms ``amplitude · window(t) · sin(2π frequency (t − begin) + phase)``, whose window rises within
``ramp`` from ``begin`` on and falls within ``ramp`` before ``end``; all derivatives are exact.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import pi
from typing import NamedTuple

import numpy as np

from devices.emulators.bodies import FloatArray, IntArray
from devices.emulators.waves import Derivatives, Fade


class Term(NamedTuple):
    """One contribution to one angle."""

    row: int
    axis: int
    amplitude: float  # rad
    begin: float  # s
    end: float  # s
    ramp: float = 0.8  # s
    frequency: float = 0.0  # Hz; 0 with phase π/2: a constant
    phase: float = pi / 2


def pulses(row: int, axis: int, angle: float, begin: float, end: float, count: int) -> list[Term]:
    """Return terms, angle (1 − cos) / 2, from 0 to the angle and back ``count`` times from begin to end."""
    frequency = count / (end - begin)
    ramp = min(0.3, 0.1 * (end - begin))
    return [
        Term(row, axis, 0.5 * angle, begin, end, ramp),
        Term(row, axis, 0.5 * angle, begin, end, ramp, frequency, -pi / 2),
    ]


@dataclass(frozen=True)
class Script:
    """Terms of N rows of three angles; begins anew after ``period``."""

    period: float
    amplitude: FloatArray  # (N, 3, K), as all the others
    begin: FloatArray
    end: FloatArray
    ramp: FloatArray
    frequency: FloatArray
    phase: FloatArray

    @classmethod
    def of(cls, n_rows: int, terms: list[Term], period: float) -> Script:
        """Return the script of a list of terms."""
        used: dict[tuple[int, int], int] = {}
        slots = []
        for term in terms:
            key = (term.row, term.axis)
            slots.append(used.get(key, 0))
            used[key] = slots[-1] + 1
        arrays = np.zeros((6, n_rows, 3, max(used.values(), default=1)))
        arrays[3] = 1.0  # a ramp that is nowhere divided by as 0
        for k, term in zip(slots, terms, strict=True):
            values = (term.amplitude, term.begin, term.end, term.ramp, term.frequency, term.phase)
            arrays[:, term.row, term.axis, k] = values
        return cls(period, *arrays)

    def rows(self, rows: IntArray) -> Script:
        """Return some rows only, in that order."""
        return Script(self.period, *(array[rows] for array in self._arrays()))

    def with_idle_row(self) -> Script:
        """Return one row more, which never moves."""
        idle = [np.zeros((1, *array.shape[1:])) for array in self._arrays()]
        idle[3] += 1.0
        pairs = zip(self._arrays(), idle, strict=True)
        return Script(self.period, *(np.concatenate([array, none]) for array, none in pairs))

    def evaluate(self, times: FloatArray, fade: Derivatives) -> list[Derivatives]:
        """Return the three angles at ``times`` (T, N), each (T, N); the script has its own fades."""
        at = np.mod(times, self.period)
        return [self._component(axis, at) for axis in range(3)]

    def _arrays(self) -> tuple[FloatArray, ...]:
        return self.amplitude, self.begin, self.end, self.ramp, self.frequency, self.phase

    def _component(self, axis: int, times: FloatArray) -> Derivatives:
        value, rate, acceleration = np.zeros((3, *times.shape), times.dtype)
        for k in range(self.amplitude.shape[2]):
            amplitude, begin, end, ramp, frequency, phase = (a[:, axis, k] for a in self._arrays())
            if not amplitude.any():
                continue
            window = _window(times, begin, end, ramp)
            omega = 2.0 * pi * frequency
            angle = omega * (times - begin) + phase
            sine, cosine = amplitude * np.sin(angle), amplitude * np.cos(angle)
            # Product rule, twice: the window's own derivatives matter while it opens and closes.
            value += window.value * sine
            rate += window.rate * sine + window.value * omega * cosine
            acceleration += (window.acceleration - window.value * omega**2) * sine
            acceleration += 2.0 * window.rate * omega * cosine
        return Derivatives(value, rate, acceleration)


def _window(times: FloatArray, begin: FloatArray, end: FloatArray, ramp: FloatArray) -> Derivatives:
    rise = Fade(begin, ramp).evaluate(times)  # type: ignore[arg-type]  # arrays, row by row
    fall = Fade(end - ramp, ramp).evaluate(times)  # type: ignore[arg-type]
    return Derivatives(*(up - down for up, down in zip(rise, fall, strict=True)))
