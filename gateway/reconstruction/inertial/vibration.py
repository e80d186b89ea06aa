"""How much of what an accelerometer feels is vibration, or its own noise. Compiled.

Rows of accelerations are as good as their modules are calm, and how calm they are nobody tells beforehand:
sensors differ by a factor of ten, and a strap on a machine or on loose clothing shakes. The fourth difference
of a motion that a suit follows is next to nothing, while noise that differs from sample to sample is in it
70 times: ``1² + 4² + 6² + 4² + 1²``.
"""

from __future__ import annotations

from gateway.frames import FloatArray
from gateway.geometry.compiled import compiled
from gateway.reconstruction.inertial.chain_state import FilterState

MEMORY_S = 1.0
CALM = 0.1
"""m/s²: vibration below it is not told from none."""
SHOCK = 9.0
"""One sample counts for so many times the mean square, not more: a heel that strikes is no vibration."""
GAIN = 70.0


@compiled
def watch_vibration(state: FilterState, s: int, f: FloatArray, is_fresh: bool, dt: float) -> None:
    """One specific force (3,) more of segment s, own axes, m/s²; is_fresh: none has come just before it.

    ``state.vibration[s, 0]`` ← the mean square of a component, (m/s²)².
    """
    seen = state.vibration[s]
    if is_fresh:
        seen[1] = 0.0
    square = 0.0
    for i in range(3):
        column = 2 + 4 * i
        change = f[i] - 4.0 * (seen[column] + seen[column + 2]) + 6.0 * seen[column + 1] + seen[column + 3]
        square += change * change
        for k in range(column + 3, column, -1):
            seen[k] = seen[k - 1]
        seen[column] = f[i]
    if seen[1] < 4.0:
        seen[1] += 1.0
        return
    square = min(square / (3.0 * GAIN), SHOCK * max(seen[0], CALM * CALM))
    seen[0] += min(1.0, dt / MEMORY_S) * (square - seen[0])
