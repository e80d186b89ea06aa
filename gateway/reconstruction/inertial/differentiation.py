"""Derivatives of noisy readings with a stated bandwidth and uncertainty: local least squares over a window.

A line (for one derivative) or a parabola (for two) is fitted to the readings of the last ``window_s``:
Savitzky and Golay's method at uneven instants. Its derivative belongs to the middle of the window.
For a parabola it is the true acceleration averaged with ``(15/16)(1 − x²)²``, x = −1…1 over the window:
−3 dB at ``0.70 / window_s``. For a line it is the rate averaged with ``(3/4)(1 − x²)``: −3 dB at
``0.60 / window_s``. Independent readings of standard deviation σ, n of them evenly spaced, leave
``σ √(720 / n) / window_s²`` and ``σ √(12 / n) / window_s``.
"""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

import numpy as np

from gateway.frames import FloatArray

BANDWIDTH = {1: 0.60, 2: 0.70}
"""−3 dB frequency times window, by number of derivatives."""


class Derivative(NamedTuple):
    """The derivative of a vector."""

    time_ns: int
    """The instant that it belongs to: the middle of the window."""
    value: FloatArray  # (3,)
    sigma: FloatArray  # (3,) standard deviation that the readings' own leave in it


class Differentiator:
    """One vector signal. n_derivatives: 1 or 2; longest_gap_s: over a longer one it begins anew.

    The window is as short as the readings' own standard deviations allow the result to be within
    ``wanted_sigma``, and never longer than ``window_s``: good readings are not made to wait.

    Readings so slow that fewer than ``n_derivatives + 1`` fall into the window are differentiated over as
    many as it takes: the plain backward difference.
    """

    def __init__(
        self, n_derivatives: int, window_s: float, longest_gap_s: float, wanted_sigma: float = 0.0
    ) -> None:
        if n_derivatives not in BANDWIDTH:
            raise ValueError(f"{n_derivatives} derivatives: 1 or 2 can be had")
        self._n_derivatives = n_derivatives
        self._wanted_sigma = wanted_sigma
        self._window_ns, self._gap_ns = round(window_s * 1e9), round(longest_gap_s * 1e9)
        self._readings: deque[tuple[int, FloatArray, FloatArray]] = deque()

    def reset(self) -> None:
        """Forget all readings."""
        self._readings.clear()

    def add(self, time_ns: int, value: FloatArray, sigma: FloatArray) -> Derivative | None:
        """One reading more, later than those before, (3,) each; None until there are enough."""
        readings = self._readings
        if readings and time_ns - readings[-1][0] > self._gap_ns:
            readings.clear()
        readings.append((time_ns, value, sigma))
        least = self._n_derivatives + 1
        while len(readings) > least and time_ns - readings[0][0] > self._window_ns:
            readings.popleft()
        return self._fit(list(readings)[-self._least_number(least) :]) if len(readings) >= least else None

    def _least_number(self, least: int) -> int:
        """How many of the last readings are enough for the wanted standard deviation; else all of them."""
        newest_ns, _, sigma = self._readings[-1]
        largest = float(np.max(sigma))
        factor = 720.0 if self._n_derivatives == 2 else 12.0
        for n in range(least, len(self._readings)):
            span_s = (newest_ns - self._readings[-n][0]) * 1e-9
            if largest * math.sqrt(factor / n) < self._wanted_sigma * span_s**self._n_derivatives:
                return n
        return len(self._readings)

    def _fit(self, readings: list[tuple[int, FloatArray, FloatArray]]) -> Derivative:
        first_ns = readings[0][0]
        t = np.array([time_ns - first_ns for time_ns, _, _ in readings]) * 1e-9
        middle = float(np.mean(t))
        x = t - middle
        weights = x / np.sum(x * x)
        if self._n_derivatives == 1:
            middle += 0.5 * float(np.sum(weights * x * x))  # uneven instants: where a parabola is met exactly
        if self._n_derivatives == 2:
            q = x * x - np.sum(x**3) * weights - np.mean(x * x)
            weights = 2.0 * q / np.sum(q * q)
            middle += float(np.sum(weights * x**3)) / 6.0  # likewise a cubic
        values = np.array([value for _, value, _ in readings])
        sigmas = np.array([sigma for _, _, sigma in readings])
        sigma = np.sqrt(np.sum((weights[:, None] * sigmas) ** 2, axis=0))
        return Derivative(first_ns + round(middle * 1e9), weights @ values, sigma)
