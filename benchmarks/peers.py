"""The methods that the accuracy suite compares: the gateway's own, a variant, and the library imufusion."""

from __future__ import annotations

from collections.abc import Sequence

import imufusion
import numpy as np
from scipy.spatial.transform import Rotation

from gateway.body.skeleton import WornSuit
from gateway.emulation import recordings
from gateway.frames import ImuFrame, SkeletonFrame
from gateway.reconstruction.inertial.observations import SegmentObserver
from gateway.reconstruction.inertial.tree.reconstructor import ChainSettings, JointReconstructor
from gateway.reconstruction.reconstructor import update_many

IMUFUSION = "imufusion"
NO_FIELD = "joint, no field"
GRAVITY = 9.81
NWU_TO_ENU = Rotation.from_euler("z", 90.0, degrees=True)
TIMEOUT_S = 5.0


class ImufusionReconstructor:
    """With the settings that its documentation recommends, gyroscope bias estimated. Units: °/s and g."""

    def __init__(self, suit: WornSuit, nominal_interval_s: float) -> None:
        rate_hz = 1.0 / nominal_interval_s
        self._settings = imufusion.AhrsSettings(
            sample_rate=rate_hz,
            convention=imufusion.CONVENTION_NWU,
            gain=0.5,
            gyroscope_range=2000.0,
            acceleration_rejection=10.0,
            magnetic_rejection=10.0,
            rejection_timeout=TIMEOUT_S,
        )
        self._bias_settings = imufusion.BiasSettings(sample_rate=rate_hz)
        self._observer = SegmentObserver(suit)
        self._n = suit.skeleton.n_segments
        self.reset()

    def reset(self) -> None:
        """Fresh filters."""
        self._filters = [imufusion.Ahrs().set_settings(self._settings) for _ in range(self._n)]
        self._biases = [imufusion.Bias().set_settings(self._bias_settings) for _ in range(self._n)]

    def update(self, observation: ImuFrame) -> SkeletonFrame:
        """Orientations only; a segment without values keeps its last."""
        seen, n = self._observer.observe(observation), len(self._filters)
        for s, (ahrs, bias) in enumerate(zip(self._filters, self._biases, strict=True)):
            rate, force, field = seen.angular_rate[s], seen.specific_force[s], seen.magnetic_field[s]
            if not (np.isfinite(rate).all() and np.isfinite(force).all()):
                continue
            rate = bias.update(np.degrees(rate))
            if np.isfinite(field).all():
                ahrs.update(rate, force / GRAVITY, field)
            else:
                ahrs.update_no_magnetometer(rate, force / GRAVITY)
        nothing = np.full((n, 3), np.nan)
        q_nwu = Rotation.from_quat([ahrs.get_quaternion() for ahrs in self._filters], scalar_first=True)
        q_wb = (NWU_TO_ENU * q_nwu).as_quat(scalar_first=True)
        sigma = np.full(n, np.nan)
        return SkeletonFrame(
            observation.sequence, observation.time_ns, q_wb, nothing, nothing, nothing, sigma, seen.status, 0
        )


def solved(
    method: str, suit: WornSuit, nominal_interval_s: float, frames: Sequence[ImuFrame]
) -> list[SkeletonFrame]:
    """All frames by ``imufusion``, by ``joint, no field``, or by a method of the gateway."""
    if method == IMUFUSION:
        return update_many(ImufusionReconstructor(suit, nominal_interval_s), frames)
    if method == NO_FIELD:
        without_field = ChainSettings(uses_field=False)
        return update_many(JointReconstructor(suit, nominal_interval_s, without_field), frames)
    return recordings.solved(method, suit, nominal_interval_s, frames)
