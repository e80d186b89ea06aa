"""What a filter that ran forward and one that ran backward say together (two-filter smoothing). Compiled.

At every instant the forward filter knows the past and the backward one (``time_reversal``) the future. They
are put together by their covariances (Fraser & Potter 1969); the rotation between them is the innovation.
"""

from __future__ import annotations

import math

import numpy as np

from gateway.frames import FloatArray
from gateway.geometry import quaternion
from gateway.geometry.compiled import compiled
from gateway.geometry.vectors import is_finite
from gateway.reconstruction.inertial.blocks import inverse_3_into


@compiled
def put_together(
    q_wb: FloatArray, P: FloatArray, q_back: FloatArray, P_back: FloatArray, sigma: FloatArray
) -> None:
    """Orientations (T, n, 4) of the forward filter take in those of the backward one, in place, and sigma
    (T, n) says how sure both are together. P, P_back: (T, n, 3, 3) rad², world axes.

    With the rotation ``δ = log(R_back R⁻¹)`` the orientation moves by ``P (P + P_back)⁻¹ δ``. Where only one
    of them knows anything, that one counts. The backward filter starts from the forward one's end, so the two
    are not independent: sigma claims no more than the surer one.
    """
    both, known = np.empty((3, 3)), np.empty((3, 3))
    for t in range(q_wb.shape[0]):
        for s in range(q_wb.shape[1]):
            if not is_finite(q_back[t, s]):
                continue
            sure = math.sqrt(P_back[t, s, 0, 0] + P_back[t, s, 1, 1] + P_back[t, s, 2, 2])
            if not is_finite(q_wb[t, s]):
                q_wb[t, s] = q_back[t, s]
                sigma[t, s] = sure
                continue
            for i in range(3):
                for j in range(3):
                    both[i, j] = P[t, s, i, j] + P_back[t, s, i, j]
            inverse_3_into(known, both)
            gain = P[t, s] @ known
            difference = quaternion.multiply(q_back[t, s], quaternion.conjugate(q_wb[t, s]))
            turn = gain @ quaternion.to_rotation_vector(difference)
            q = quaternion.multiply(quaternion.from_rotation_vector(turn), q_wb[t, s])
            q_wb[t, s] = quaternion.canonical(quaternion.normalise(q))
            sigma[t, s] = min(sigma[t, s], sure)
