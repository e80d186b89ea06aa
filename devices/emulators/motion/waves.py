"""Sums of sines with a smooth fade-in: motion whose derivatives are known exactly."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from devices.emulators.bodies import FloatArray, IntArray


class Derivatives(NamedTuple):
    """A quantity with its first and second time derivative, all of one shape."""

    value: FloatArray
    rate: FloatArray
    acceleration: FloatArray


@dataclass(frozen=True)
class Fade:
    """Zero for ``rest_s``, then rising to one within ``ramp_s``; three times continuously differentiable."""

    rest_s: float = 2.0
    ramp_s: float = 1.5

    def evaluate(self, times: FloatArray) -> Derivatives:
        """Return the fade and its derivatives at the given times (any shape), s."""
        u = np.clip((times - self.rest_s) / self.ramp_s, 0.0, 1.0)
        v = 1.0 - u
        return Derivatives(
            u**4 * (35.0 - 84.0 * u + 70.0 * u**2 - 20.0 * u**3),
            140.0 * (u * v) ** 3 / self.ramp_s,
            420.0 * (u * v) ** 2 * (v - u) / self.ramp_s**2,
        )


@dataclass(frozen=True)
class Waves:
    """For N rows of three components: ``fade(t) Σ_k amplitude_k sin(2π frequency_k t + phase_k)``.

    A term of frequency 0 and phase π/2 is a constant that is faded in: a joint's mean angle.
    """

    amplitude: FloatArray  # (N, 3, K)
    frequency: FloatArray  # (N, 3, K) Hz
    phase: FloatArray  # (N, 3, K) rad

    def rows(self, rows: IntArray) -> Waves:
        """Return the waves of some rows only, in that order."""
        return Waves(self.amplitude[rows], self.frequency[rows], self.phase[rows])

    def with_idle_row(self) -> Waves:
        """Return one row more, which never moves."""
        idle = np.zeros((1, *self.amplitude.shape[1:]))
        return Waves(*(np.concatenate([x, idle]) for x in (self.amplitude, self.frequency, self.phase)))

    def scaled(self, amplitude: float, frequency: float) -> Waves:
        """Return waves with all amplitudes and all frequencies multiplied."""
        return Waves(self.amplitude * amplitude, self.frequency * frequency, self.phase)

    def evaluate(self, times: FloatArray, fade: Derivatives) -> list[Derivatives]:
        """Return the three components at ``times`` (T, N), each (T, N), with their derivatives."""
        return [self._component(axis, times, fade) for axis in range(3)]

    def heading(self, times: FloatArray) -> Derivatives:
        """Return the heading of a root's path: it does not turn."""
        still = np.zeros_like(times)
        return Derivatives(still, still, still)

    def _component(self, axis: int, times: FloatArray, fade: Derivatives) -> Derivatives:
        value, rate, acceleration = np.zeros((3, *times.shape), times.dtype)
        for k in range(self.amplitude.shape[2]):
            amplitude = self.amplitude[:, axis, k]
            if not amplitude.any():
                continue
            omega = 2.0 * np.pi * self.frequency[:, axis, k]
            angle = omega * times + self.phase[:, axis, k]
            sine, cosine = np.sin(angle), np.cos(angle)
            value += amplitude * sine
            rate += (amplitude * omega) * cosine
            acceleration -= (amplitude * omega**2) * sine
        return Derivatives(  # product rule
            fade.value * value,
            fade.rate * value + fade.value * rate,
            fade.acceleration * value + 2.0 * fade.rate * rate + fade.value * acceleration,
        )


def waves(n_rows: int, terms: list[tuple[int, int, float, float, float]]) -> Waves:
    """Return waves of a list of terms (row, component, amplitude, frequency in Hz, phase in rad)."""
    used: dict[tuple[int, int], int] = {}
    slots = []
    for row, axis, *_ in terms:
        slots.append(used.get((row, axis), 0))
        used[row, axis] = slots[-1] + 1
    amplitude, frequency, phase = np.zeros((3, n_rows, 3, max(used.values(), default=1)))
    for k, (row, axis, *term) in zip(slots, terms, strict=True):
        amplitude[row, axis, k], frequency[row, axis, k], phase[row, axis, k] = term
    return Waves(amplitude, frequency, phase)
