"""How far headings of a reference are from what accelerations at the joints say of them.

Two modules on either side of a joint feel the same acceleration of its centre:

    Rz(δ) (f_p + A_p r_p) = f_c + A_c r_c

with specific forces f in the reference's world, A the second derivative of a module's rotation matrix, r from
a module to the joint's centre in its own axes, and δ the turn about the vertical by which the reference has
the child too far, seen from the parent. Both sides are low-passed alike. All of a recording gives δ and both
r by least squares: no filter, no field, and of the rig only a loose prior of the lever arms. Where the
headings of a reference come from another filter, this says how far they can be believed.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.signal import butter, filtfilt
from scipy.spatial.transform import Rotation

from gateway.body.skeleton import WornSuit
from gateway.frames import FloatArray

_CUTOFF_HZ = 5.0
"""Motion of the body, without what skin and straps add."""
_GAP_S = 0.3
"""So close to a sample that the reference does not know, nothing is used."""
_EVERY_S = 0.05
_FORCE_SIGMA = 0.5
"""m/s², of a joint that is no point and of modules that are not rigid on their segments."""
_ARM_SIGMA = 0.15
"""m, of the lever arms that the rig states."""


class _Track(NamedTuple):
    """What one module felt, in the reference's world, low-passed."""

    force: FloatArray  # (T, 3) m/s²
    arm: FloatArray  # (T, 3, 3) m/s² for each metre in sensor axes
    known: NDArray[np.bool_]  # (T,)


def heading_errors(suit: WornSuit, rate_hz: float, force: FloatArray, q_wb: FloatArray) -> FloatArray:
    """Return (M,) headings of the reference less those that the accelerations agree to, rad, mean 0.

    force: (T, M, 3) m/s², sensor axes; q_wb: (T, M, 4) reference of the segments of the suit's modules; every
    segment between two of them has a module, too.
    """
    parents = suit.skeleton.parents
    tracks = {
        segment: _track(suit, segment, rate_hz, force[:, row], q_wb[:, row])
        for segment, row in enumerate(suit.module_of_segment.tolist())
        if row >= 0
    }
    errors = np.zeros(suit.skeleton.n_segments)
    for segment in tracks:
        if (parent := int(parents[segment])) in tracks:
            errors[segment] = errors[parent] + _turn(suit, segment, parent, tracks, rate_hz)
    of_modules = np.array([errors[suit.module_of_segment == row][0] for row in range(force.shape[1])])
    centred: FloatArray = of_modules - of_modules.mean()
    return centred


def _track(suit: WornSuit, segment: int, rate_hz: float, force: FloatArray, q_wb: FloatArray) -> _Track:
    known = np.isfinite(q_wb).all(axis=1)
    last_known = np.maximum(np.cumsum(known) - 1, 0)
    filled = q_wb[np.flatnonzero(known)[last_known]]
    mounted = Rotation.from_quat(suit.sensor_to_segment[segment], scalar_first=True)
    rotation = Rotation.from_quat(filled, scalar_first=True) * mounted
    low = butter(2, _CUTOFF_HZ / (0.5 * rate_hz))
    matrices = filtfilt(*low, rotation.as_matrix().reshape(-1, 9), axis=0)
    bent = np.gradient(np.gradient(matrices, axis=0), axis=0) * rate_hz**2
    reach = 2 * round(_GAP_S * rate_hz) + 1
    is_clear = np.convolve(~known, np.ones(reach), "same") == 0
    return _Track(
        filtfilt(*low, rotation.apply(force), axis=0),
        bent.reshape(-1, 3, 3),
        is_clear,
    )


def _turn(suit: WornSuit, child: int, parent: int, tracks: dict[int, _Track], rate_hz: float) -> float:
    """Return how much further the reference has turned the child than accelerations say, rad."""
    rows = np.flatnonzero(tracks[child].known & tracks[parent].known)[:: max(round(_EVERY_S * rate_hz), 1)]
    (of_c, by_c), (of_p, by_p) = ((tracks[s].force[rows], tracks[s].arm[rows]) for s in (child, parent))
    centre = {child: -suit.lever_arms[child], parent: suit.skeleton.offsets[child] - suit.lever_arms[parent]}
    arm_c, arm_p = (
        Rotation.from_quat(suit.sensor_to_segment[s], scalar_first=True).inv().apply(centre[s])
        for s in (child, parent)
    )

    def residuals(x: FloatArray) -> FloatArray:
        cos, sin = np.cos(x[0]), np.sin(x[0])
        turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
        apart = of_c + by_c @ x[1:4] - (of_p + by_p @ x[4:7]) @ turn.T
        loose = (x[1:4] - arm_c, x[4:7] - arm_p)
        weighed: FloatArray = np.concatenate(
            [apart.ravel() / _FORCE_SIGMA, np.concatenate(loose) / _ARM_SIGMA]
        )
        return weighed

    found = least_squares(residuals, np.concatenate([[0.0], arm_c, arm_p]), loss="soft_l1")
    return float(found.x[0])
