"""By how much a module's magnetometer is later than its accelerometer, found without any orientation.

The product of specific force and field is the same in all axes: ``f · m = (a − g) · h``, with the module's
acceleration ``a`` from its measured places and ``h`` the known field. A field that is δ late is
``m(t − δ) = m − δ ṁ``, so that ``f · m − (a − g) · h = −δ f · ṁ``: a line through the origin, whose slope
is δ. Smooth values and derivatives come from a quadratic through the last instants, all of the same middle:
the window delays nothing against anything. An orientation would not do: a causal one is late itself.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from gateway.frames import FloatArray
from gateway.geometry.compiled import compiled
from gateway.geometry.vectors import dot, norm
from gateway.reconstruction.inertial.held_arguments import hold

WINDOW_S, FEWEST = 0.06, 5
"""s that a quadratic spans, and the fewest instants of it."""
PRIOR_S, LONGEST_S = 0.02, 0.05
"""What a lag is expected to be (standard deviation about 0), and the most that is believed."""
MEMORY_S = 120.0
LATEST = 4
"""Instants by which a place may come later than what the module measured then."""
FIELD_NOISE, FIELD_RANGE = 0.5, 2.0
"""µT: of a sample; by how much the field of a room varies."""
TURNING = 3.0
"""Standard deviations by which ``f · ṁ`` must stand out of its noise: noise in it would pull δ to 0."""


class LagFinder(NamedTuple):
    """Everything remembered; changed in place. W: instants of the window; L: those kept, the newest last."""

    fit: FloatArray  # (W, 3) weights of value, slope and curvature at the middle, by instants
    interval_s: float
    times: FloatArray  # (L,) s
    seen: FloatArray  # (L, 9) specific force, field; place of the module, NaN until it is known
    sums: FloatArray  # (2,) of the straight line: x², xy, weighted


def lag_finder(interval_s: float) -> LagFinder:
    """For frames that far apart, s; to be given to kernels."""
    half = max(FEWEST // 2, round(0.5 * WINDOW_S / interval_s))
    steps = np.arange(-half, half + 1, dtype=np.float64)
    fit = np.ascontiguousarray(np.linalg.pinv(np.stack([steps**0, steps, 0.5 * steps**2], axis=1)).T)
    n = len(steps) + LATEST
    return hold(LagFinder(fit, float(interval_s), np.zeros(n), np.full((n, 9), np.nan), np.zeros(2)))


@compiled
def see_module(finder: LagFinder, time_s: float, f: FloatArray, m: FloatArray) -> None:
    """Specific force and field of an instant, (3,) in segment axes."""
    times, seen, n = finder.times, finder.seen, len(finder.times)
    for k in range(n - 1):
        times[k] = times[k + 1]
        for i in range(9):
            seen[k, i] = seen[k + 1, i]
    times[n - 1] = time_s
    for i in range(3):
        seen[n - 1, i], seen[n - 1, 3 + i], seen[n - 1, 6 + i] = f[i], m[i], np.nan


@compiled
def see_place(
    finder: LagFinder,
    time_s: float,
    place: FloatArray,
    velocity: FloatArray,
    sigma: float,
    s_of_rest: FloatArray,
    h: FloatArray,
) -> None:
    """Where the module was at time_s, not later than its newest instant.

    place, velocity (3,) of the module, world; sigma: noise of the place, m; s_of_rest (3,) −g; h (3,) µT.
    """
    n, length = len(finder.fit), len(finder.times)
    for k in range(length - 1, n - 2, -1):
        off_s = finder.times[k] - time_s
        if abs(off_s) <= 0.5 * finder.interval_s:
            for i in range(3):
                finder.seen[k, 6 + i] = place[i] + velocity[i] * off_s
            _take_window(finder, k - n + 1, sigma, s_of_rest, h)
            return


@compiled
def _take_window(
    finder: LagFinder, first: int, place_sigma: float, s_of_rest: FloatArray, h: FloatArray
) -> None:
    """The W instants from ``first`` on; nothing unless all are whole and follow each other."""
    fit, n = finder.fit, len(finder.fit)
    dt = (finder.times[first + n - 1] - finder.times[first]) / (n - 1)
    f, m, m_slope, s = np.zeros(3), np.zeros(3), np.zeros(3), s_of_rest.copy()
    slope_gain = curvature_gain = 0.0
    for k in range(n):
        seen = finder.seen[first + k]
        slope_gain += fit[k, 1] ** 2
        curvature_gain += fit[k, 2] ** 2
        for i in range(3):
            f[i] += fit[k, 0] * seen[i]
            m[i] += fit[k, 0] * seen[3 + i]
            m_slope[i] += fit[k, 1] * seen[3 + i] / dt
            s[i] += fit[k, 2] * seen[6 + i] / (dt * dt)
    x, y = -dot(f, m_slope), dot(f, m) - dot(s, h)
    if not math.isfinite(x + y) or abs(dt - finder.interval_s) > 0.2 * finder.interval_s:
        return
    is_turning = abs(x) > TURNING * norm(f) * FIELD_NOISE * math.sqrt(slope_gain) / dt
    is_disturbed = abs(norm(m) - norm(h)) > FIELD_RANGE
    keep = math.exp(-dt / MEMORY_S)
    finder.sums[0] *= keep
    finder.sums[1] *= keep
    if is_turning and not is_disturbed:
        sigma = FIELD_RANGE * norm(f) + norm(h) * place_sigma * math.sqrt(curvature_gain) / (dt * dt)
        y = min(max(y, -LONGEST_S * abs(x) - sigma), LONGEST_S * abs(x) + sigma)
        weight = 1.0 / (sigma * sigma * n)  # windows overlap
        finder.sums[0] += weight * x * x
        finder.sums[1] += weight * x * y


@compiled
def lag_s(finder: LagFinder) -> float:
    """What has been found so far, s."""
    found: float = finder.sums[1] / (finder.sums[0] + 1.0 / PRIOR_S**2)
    return min(max(found, 0.0), LONGEST_S)
