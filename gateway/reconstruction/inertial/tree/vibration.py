"""How much of what a sensor measures is vibration, its own noise, or a shock. Compiled.

Rows of accelerations are as good as their modules are calm, and how calm they are is not known beforehand:
sensors differ by a factor of ten, and a strap on a machine or on loose clothing shakes. The fourth difference
of a motion that a suit follows is next to nothing, while noise that differs from sample to sample is in it 70
times: ``1² + 4² + 6² + 4² + 1²``. A heel that strikes, a knock at a module or a spoilt reading stands out of
that by far, and says nothing of how the segment moves.
"""

from __future__ import annotations

import math

from gateway.frames import FloatArray
from gateway.geometry.compiled import compiled
from gateway.geometry.vectors import dot
from gateway.reconstruction.inertial.tree.state import Segment, Vibration
from gateway.reconstruction.inertial.tree.tuning import Tuning

FOURTH_DIFFERENCE_GAIN = 70.0


@compiled
def watch_vibration(
    seen: Vibration, x: FloatArray, is_fresh: bool, floor: float, shock: float, tuning: Tuning, dt: float
) -> None:
    """Update ``seen`` by a reading, equations (12) and (12a).

    x: (3,) reading, own axes. is_fresh: none has come just before this one. floor: standard deviation that is
    not told from none. shock: times the mean square from which a reading is a shock.
    """
    if is_fresh:
        seen.samples = 0.0
    square, step, last = 0.0, 0.0, seen.last
    for i in range(3):
        # (12) ∇⁴ x
        change = x[i] - 4.0 * (last[i, 0] + last[i, 2]) + 6.0 * last[i, 1] + last[i, 3]
        square += change * change
        step += (x[i] - last[i, 0]) ** 2
        for k in range(3, 0, -1):
            last[i, k] = last[i, k - 1]
        last[i, 0] = x[i]
    seen.shock = 0.0
    if seen.samples < 4.0:
        seen.samples += 1.0
        return
    now, usual = square / (3.0 * FOURTH_DIFFERENCE_GAIN), max(seen.square, floor * floor)
    if now > shock * usual:
        # (12a) h: a reading that stands alone is off by that in its own step and in the next one
        seen.shock = 0.5 * math.sqrt(min(square, step))
    now = min(now, tuning.vibration_shock * usual)
    seen.square += min(1.0, dt / tuning.vibration_memory_s) * (now - seen.square)


@compiled
def shock_variance(segment: Segment, arm: FloatArray, tuning: Tuning, dt: float) -> float:
    """Return η of (12b), (m/s²)²: what shocks add to the variance of a row every dt (s).

    arm: (3,) from the module to the row's point, m.
    """
    averages = segment.averages
    turning = (2.0 * segment.rate_vibration.shock + averages.rate_shock) / tuning.smoothing_s
    square = averages.force_shock**2 + turning**2 * dot(arm, arm)
    return float(square / 3.0 * max(1.0, tuning.smoothing_s / dt))
