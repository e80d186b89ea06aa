"""Modules that fuse on board: their orientations, turned to the segments that they sit on.

``q_wb = q_we q_es q_sb``: alignment of the module on its segment, sensor to the module's own level
reference e as sent, and the heading of that reference in the world.
"""

from __future__ import annotations

import math

import numpy as np

from gateway.body.kinematics import joint_positions
from gateway.body.skeleton import WornSuit
from gateway.frames import FloatArray, ImuFrame, SkeletonFrame, Status
from gateway.geometry import quaternion


class FusedReconstructor:
    """No filter of its own: status and gaps are those of the modules' data.

    A segment without module follows its parent rigidly (PREDICTED). angular_rate: backward difference of two
    successive frames that both rest on samples, else NaN. joint_acceleration and sigma: NaN, since modules
    that fuse send neither. p_w: from the joints, the root at the origin.
    """

    def __init__(self, suit: WornSuit, nominal_interval_s: float, *, starts_neutral: bool = False) -> None:
        """Create the reconstructor of a suit.

        nominal_interval_s: of the frames; not needed, they bear their times. starts_neutral: every module's
        reference has a heading of its own, found from the first orientation of the module, at which the
        wearer stands in the neutral posture. Otherwise all references face east.
        """
        self._suit = suit
        self._starts_neutral = starts_neutral
        self._q_sb = [quaternion.conjugate(quaternion.normalise(q)) for q in suit.sensor_to_segment]
        self.reset()
        n = len(suit.module_ids)
        ones, none = np.ones((n, 3)), np.zeros(n, np.int64)
        at_rest = np.tile([1.0, 0.0, 0.0, 0.0], (n, 1))
        for k in range(2):  # so that the kernels are compiled before the first real frame comes
            self.update(ImuFrame(k, k, ones, ones, ones, none.astype(np.uint8), none, orientation=at_rest))
        self.reset()

    def reset(self) -> None:
        """Forget everything but the parameters."""
        n = self._suit.skeleton.n_segments
        self._q_we: list[FloatArray | None] = [None] * n
        self._before = np.full((n, 4), np.nan)  # orientations that rest on samples
        self._time_ns = 0

    def update(self, observation: ImuFrame, stood_s: FloatArray | None = None) -> SkeletonFrame:
        """Return the pose of one instant."""
        skeleton, rows = self._suit.skeleton, self._suit.module_of_segment
        n = skeleton.n_segments
        q_wb, status = np.full((n, 4), np.nan), np.full(n, Status.MISSING, np.uint8)
        for segment, (row, parent) in enumerate(zip(rows.tolist(), skeleton.parents.tolist(), strict=True)):
            if row < 0:
                if parent >= 0 and status[parent] != Status.MISSING:
                    q_wb[segment], status[segment] = q_wb[parent], Status.PREDICTED
            elif observation.orientation is not None and observation.status[row] <= Status.HELD:
                q_wb[segment] = self._oriented(segment, observation.orientation[row])
                status[segment] = observation.status[row]
        rests_on_samples = (status <= Status.INTERPOLATED)[:, None]
        now = np.where(rests_on_samples, q_wb, np.nan)
        rate = self._angular_rate(now, (observation.time_ns - self._time_ns) * 1e-9)
        self._before, self._time_ns = now, observation.time_ns
        return SkeletonFrame(
            sequence=observation.sequence,
            time_ns=observation.time_ns,
            q_wb=q_wb,
            angular_rate=rate,
            joint_acceleration=np.full((n, 3), np.nan),
            p_w=joint_positions(skeleton.parents, skeleton.offsets, q_wb, np.zeros(3)),
            sigma=np.full(n, np.nan),
            status=status,
            root=int(np.flatnonzero(skeleton.parents < 0)[0]),
        )

    def _oriented(self, segment: int, q_es: FloatArray) -> FloatArray:
        """Return q_wb of a segment that carries a module."""
        q_eb = quaternion.normalise(quaternion.multiply(quaternion.normalise(q_es), self._q_sb[segment]))
        q_we = self._q_we[segment]
        if q_we is None:
            q_we = self._q_we[segment] = self._heading(q_eb)
        return quaternion.canonical(quaternion.multiply(q_we, q_eb))

    def _heading(self, q_eb: FloatArray) -> FloatArray:
        """Return the rotation about the vertical that brings a segment nearest to the neutral posture."""
        if not self._starts_neutral:
            return np.array([1.0, 0.0, 0.0, 0.0])
        difference = quaternion.multiply(self._suit.skeleton.neutral, quaternion.conjugate(q_eb))
        angle = 2.0 * math.atan2(difference[3], difference[0])
        return quaternion.from_rotation_vector(np.array([0.0, 0.0, angle]))

    def _angular_rate(self, now: FloatArray, dt: float) -> FloatArray:
        """Return the angular rates (n_segments, 3), rad/s, segment axes."""
        rate = np.full((len(now), 3), np.nan)
        if dt > 0.0:
            for segment in np.flatnonzero(np.isfinite(now[:, 0]) & np.isfinite(self._before[:, 0])):
                step = quaternion.multiply(quaternion.conjugate(self._before[segment]), now[segment])
                rate[segment] = quaternion.to_rotation_vector(step) / dt
        return rate
