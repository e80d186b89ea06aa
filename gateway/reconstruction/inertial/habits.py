"""How a module has been moving, and hence what a gap in its samples may have done to it. Compiled.

Within a tenth of a second or so a segment turns by about the mean of the rates before and after. Beyond that
nobody knows which way it turned; but limbs come back to where they use to be, so that the mean orientation of
the last seconds tells more than the last one does as soon as the module may have left it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gateway.frames import FloatArray, IntArray
from gateway.geometry import quaternion
from gateway.geometry.compiled import compiled
from gateway.geometry.vectors import norm

RATE_MEMORY_S, MEAN_MEMORY_S = 3.0, 8.0
LONGEST_TURN_S = 0.4
"""Up to here the mean rate of both ends tells how far a limb has turned; measured on people and on a rig."""
CURVATURE = 2.0
"""1/s: error of that turn over rate times the gap's square."""
WANDERING = 0.78
"""√s: error of the last orientation over rate times the root of the gap."""
DRIFT = 0.15
"""rad/s at which the mean orientation itself becomes old."""
SLOWEST = 0.5
"""rad/s: so fast any module may turn while nobody looks, however still it was."""
FLOOR, START_ERROR = 0.02, 0.5
"""rad: of any orientation before a gap, and of one at the start, less with every second since."""


class Habits(NamedTuple):
    """By segment, changed in place; of the sound samples."""

    orientation: FloatArray  # (n, 4) the last, sensor to the filter's world
    mean: FloatArray  # (n, 4) of the last seconds; its length says how far they spread
    specific_force: FloatArray  # (n, 3) last values, sensor axes
    angular_rate: FloatArray  # (n, 3)
    magnetic_field: FloatArray  # (n, 3) NaN where there was none
    turning: FloatArray  # (n,) (rad/s)², mean square of the rate about an axis
    swing: FloatArray  # (n,) (m/s²)², mean square of what the specific force's norm is off gravity
    seconds: FloatArray  # (n,) of samples, up to now


def no_habits(n: int) -> Habits:
    """Of n segments of which nothing is known yet."""
    q, v = np.zeros((n, 4)), np.zeros((n, 3))
    return Habits(q, q.copy(), v, v.copy(), v.copy(), np.zeros(n), np.zeros(n), np.zeros(n))


def clear(habits: Habits) -> None:
    """Forget all of it, in place."""
    for values in habits:
        values[...] = 0.0


@compiled
def note(
    habits: Habits,
    segments: IntArray,
    rows: IntArray,
    is_sound: NDArray[np.bool_],
    q: FloatArray,
    f: FloatArray,
    w: FloatArray,
    x: FloatArray,
    gravity: float,
    dt: float,
) -> None:
    """One instant. segments, rows: (k,) segments with modules, and these; is_sound: (n,), q: (n, 4) by
    segment; f, w, x: (m, 3) by row; dt: s that a sample stands for."""
    for s, row in zip(segments, rows):  # noqa: B905 - strict is not known to the compiler
        if not is_sound[s]:
            continue
        habits.orientation[s] = q[s]
        habits.specific_force[s], habits.angular_rate[s], habits.magnetic_field[s] = f[row], w[row], x[row]
        habits.seconds[s] += dt
        share = dt / min(habits.seconds[s], RATE_MEMORY_S)
        square = (w[row, 0] ** 2 + w[row, 1] ** 2 + w[row, 2] ** 2) / 3.0
        habits.turning[s] += share * (square - habits.turning[s])
        habits.swing[s] += share * ((norm(f[row]) - gravity) ** 2 - habits.swing[s])
        share = dt / min(habits.seconds[s], MEAN_MEMORY_S)
        sign = -1.0 if np.sum(q[s] * habits.mean[s]) < 0.0 else 1.0
        habits.mean[s] += share * (sign * q[s] - habits.mean[s])


@compiled
def after_gap(habits: Habits, s: int, gap_s: float, rate: FloatArray) -> tuple[FloatArray, float]:
    """The orientation to be expected of segment s (4,), and its standard deviation about an axis, rad.

    rate: (3,) mean of those before and after the gap, rad/s, without bias.
    """
    known = FLOOR + START_ERROR / (1.0 + habits.seconds[s])
    fastest = math.sqrt(max(habits.turning[s], SLOWEST**2, np.sum(rate**2) / 3.0))
    if gap_s <= LONGEST_TURN_S:
        turned = quaternion.from_rotation_vector(rate * gap_s)
        return quaternion.multiply(habits.orientation[s], turned), CURVATURE * gap_s**2 * fastest + known
    wandered = WANDERING * math.sqrt(gap_s) * fastest
    length = math.sqrt(np.sum(habits.mean[s] ** 2))
    spread = math.sqrt(max(0.0, 4.0 * (1.0 - length**2)) + (DRIFT * gap_s) ** 2)
    if spread < wandered and length > 0.0:
        return habits.mean[s] / length, min(spread, math.pi) + known
    return habits.orientation[s].copy(), min(wandered, math.pi) + known
