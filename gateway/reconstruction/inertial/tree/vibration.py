"""How much of what an accelerometer feels is vibration, or its own noise. Compiled.

Rows of accelerations are as good as their modules are calm, and how calm they are is not known beforehand:
sensors differ by a factor of ten, and a strap on a machine or on loose clothing shakes. The fourth difference
of a motion that a suit follows is next to nothing, while noise that differs from sample to sample is in it 70
times: ``1² + 4² + 6² + 4² + 1²``.
"""

from __future__ import annotations

from gateway.frames import FloatArray
from gateway.geometry.compiled import compiled
from gateway.reconstruction.inertial.tree.state import Vibration
from gateway.reconstruction.inertial.tree.tuning import Tuning

FOURTH_DIFFERENCE_GAIN = 70.0


@compiled
def watch_vibration(seen: Vibration, f: FloatArray, is_fresh: bool, tuning: Tuning, dt: float) -> None:
    """Update ``seen.square``, mean square vibration of a component, (m/s²)², equation (12).

    f: (3,) own axes, m/s². is_fresh: no sample has come just before this one.
    """
    if is_fresh:
        seen.samples = 0.0
    square, last = 0.0, seen.last
    for i in range(3):
        # (12) ∇⁴ f
        change = f[i] - 4.0 * (last[i, 0] + last[i, 2]) + 6.0 * last[i, 1] + last[i, 3]
        square += change * change
        for k in range(3, 0, -1):
            last[i, k] = last[i, k - 1]
        last[i, 0] = f[i]
    if seen.samples < 4.0:
        seen.samples += 1.0
        return
    floor = tuning.vibration_floor * tuning.vibration_floor
    square = min(square / (3.0 * FOURTH_DIFFERENCE_GAIN), tuning.vibration_shock * max(seen.square, floor))
    seen.square += min(1.0, dt / tuning.vibration_memory_s) * (square - seen.square)
