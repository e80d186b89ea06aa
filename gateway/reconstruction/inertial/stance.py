"""Which segments stand still, from their own modules. Compiled.

The detector is SHOE, the generalised likelihood ratio test of Skog, Händel, Nilsson & Rantakokko (IEEE Trans.
Biomed. Eng. 57, 2010), eq. 15: at rest the specific force is gravity of whatever direction and the rate is
zero,

    T = mean over a window of ‖f − g f̄/‖f̄‖‖²/σ_f² + ‖ω‖²/σ_ω²,

which is ``(E‖f‖² − 2 g ‖E f‖ + g²)/σ_f² + E‖ω‖²/σ_ω²``, as the mean of ``f · f̄`` is ``‖f̄‖²``: variance and
magnitude of the specific force in one number. Rest begins below a low threshold and ends above a higher one.
The window is short and ends abruptly: a running foot is flat on the ground for 0.1 s after a swing of 10
rad/s.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from gateway.frames import FloatArray, StatusArray
from gateway.geometry.compiled import compiled
from gateway.geometry.vectors import dot, is_finite


class StanceSettings(NamedTuple):
    """One set for all bodies and gaits."""

    window_s: float = 0.045
    """Skog et al. took 5 samples at 100 Hz."""
    force_sigma: float = 1.0
    """m/s²: a shoe gives, and sensors are off by a few tenths."""
    rate_sigma: float = 0.5
    """rad/s: a foot rolls a little while it stands."""
    begins_below: float = 4.0
    ends_above: float = 12.0
    slow_segment_s: float = 0.7
    """Segments that are not made to stand on must be still for so long: they also move slowly."""


class StanceState(NamedTuple):
    """By segment, changed in place."""

    history: FloatArray  # (n, N_HISTORY, 5) age s, specific force, square of the rate; newest first
    still_s: FloatArray  # (n,) since the test is passed


N_HISTORY = 24
"""Frames of a window at most."""


def initial_stance(n: int) -> StanceState:
    """Of n segments: nothing stands still."""
    return StanceState(np.full((n, N_HISTORY, 5), np.inf), np.zeros(n))


@compiled
def watch_stance(
    resting: FloatArray,
    settings: StanceSettings,
    state: StanceState,
    carries: FloatArray,
    gravity: float,
    force: FloatArray,
    rate: FloatArray,
    status: StatusArray,
    dt: float,
) -> None:
    """resting (n,) ← for how long each segment has been at rest, s; 0: it is not, or its module is silent.

    carries: (n,) 1 for segments that stand on the ground (feet). gravity: its size, m/s². force, rate: (n,
    3), m/s² and rad/s. dt: since the frame before, s.
    """
    for s in range(len(carries)):
        resting[s] = 0.0
        # a module that is silent, or repeats itself, shows nothing
        if status[s] > 1 or not (is_finite(force[s]) and is_finite(rate[s])):
            for k in range(N_HISTORY):
                state.history[s, k, 0] = np.inf
            state.still_s[s] = 0.0
            continue
        _remember(state.history[s], force[s], rate[s], dt)
        limit = settings.ends_above if state.still_s[s] > 0.0 else settings.begins_below
        is_still = _test(settings, state.history[s], gravity) < limit
        state.still_s[s] = state.still_s[s] + dt if is_still else 0.0
        if carries[s] > 0.0 or state.still_s[s] > settings.slow_segment_s:
            resting[s] = state.still_s[s]


@compiled
def _remember(history: FloatArray, force: FloatArray, rate: FloatArray, dt: float) -> None:
    """Put a frame before those of history (N_HISTORY, 5), the oldest of which is forgotten."""
    for k in range(N_HISTORY - 1, 0, -1):
        history[k, 0] = history[k - 1, 0] + dt
        for i in range(1, 5):
            history[k, i] = history[k - 1, i]
    history[0, 0], history[0, 4] = 0.0, dot(rate, rate)
    for i in range(3):
        history[0, 1 + i] = force[i]


@compiled
def _test(settings: StanceSettings, history: FloatArray, gravity: float) -> float:
    """T of the frames within the window; infinite while they do not fill half of it."""
    x, y, z = 0.0, 0.0, 0.0
    square, rate, count, oldest = 0.0, 0.0, 0, 0.0
    for k in range(len(history)):
        if history[k, 0] > settings.window_s:
            break
        f, g, h = history[k, 1], history[k, 2], history[k, 3]
        x, y, z = x + f, y + g, z + h
        square += f * f + g * g + h * h
        rate += history[k, 4]
        oldest = history[k, 0]
        count += 1
    if oldest < 0.4 * settings.window_s and count < len(history):
        return np.inf
    spread = (square - 2.0 * gravity * math.sqrt(x * x + y * y + z * z)) / count + gravity**2
    return spread / settings.force_sigma**2 + rate / count / settings.rate_sigma**2
