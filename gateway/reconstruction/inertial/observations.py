"""What the modules measured, by segment and in segment axes."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from gateway.body.skeleton import WornSuit
from gateway.frames import FloatArray, ImuFrame, IntArray, Status, StatusArray, SunSight
from gateway.geometry import quaternion, rotation_matrix
from gateway.geometry.compiled import compiled
from gateway.geometry.vectors import is_finite

MISSING = Status.MISSING.value


class SegmentObservations(NamedTuple):
    """One instant, by segment; NaN where a segment has no module or the module no value."""

    specific_force: FloatArray  # (n_segments, 3) m/s², segment axes, at the module
    angular_rate: FloatArray  # (n_segments, 3) rad/s, segment axes
    magnetic_field: FloatArray  # (n_segments, 3) µT, segment axes
    status: StatusArray  # (n_segments,) of the module's row; MISSING without module or specific force
    clipped: StatusArray  # (n_segments,) of its sensors, ``Clipped``


class SegmentObserver:
    """Turns the rows of ``ImuFrame`` (modules, sensor axes) into segments and their axes."""

    def __init__(self, suit: WornSuit) -> None:
        self._module_of_segment = suit.module_of_segment.astype(np.int64)
        self._R_bs = sensor_to_segment_matrices(suit)

    def observe(self, imu_frame: ImuFrame) -> SegmentObservations:
        """Return the frame by segment, in segment axes."""
        # copied, so that a read-only or strided array does not have the kernel compiled again
        rows = (imu_frame.specific_force, imu_frame.angular_rate, imu_frame.magnetic_field)
        f, w, x = (np.array(row, np.float64, order="C") for row in rows)
        status, clipped = np.array(imu_frame.status, np.uint8), clipped_of(imu_frame)
        observed = no_observations(len(self._module_of_segment))
        by_segment_into(observed, self._module_of_segment, self._R_bs, f, w, x, status, clipped)
        return observed


def no_observations(n: int) -> SegmentObservations:
    """Return the observations of n segments without any sample."""
    f, w, x = (np.full((n, 3), np.nan) for _ in range(3))
    return SegmentObservations(f, w, x, np.full(n, MISSING, np.uint8), np.zeros(n, np.uint8))


def clipped_of(imu_frame: ImuFrame) -> StatusArray:
    """Return which sensors of a frame are at the end of their ranges, (n_modules,) ``Clipped``.

    None is if the frame has no such field.
    """
    if imu_frame.clipped is None:
        return np.zeros(len(imu_frame.status), np.uint8)
    return np.array(imu_frame.clipped, np.uint8)


def with_sun_as_field(imu_frame: ImuFrame, sun: SunSight) -> ImuFrame:
    """Return the frame with the sun's direction in the place of the magnetic field.

    The world vector of that is ``sun.world``.
    """
    return replace(imu_frame, magnetic_field=np.array(sun.direction, np.float64))


def sensor_to_segment_matrices(suit: WornSuit) -> FloatArray:
    """Return R_bs (n_segments, 3, 3), sensor to segment."""
    return np.stack([quaternion.to_matrix(quaternion.normalise(q)) for q in suit.sensor_to_segment])


@compiled
def by_segment_into(
    observed: SegmentObservations,
    module_of_segment: IntArray,
    R_bs: FloatArray,
    specific_force: FloatArray,
    angular_rate: FloatArray,
    magnetic_field: FloatArray,
    status: StatusArray,
    clipped: StatusArray,
) -> None:
    """Fill ``observed`` with rows of modules, (m, 3) and (m,), turned by R_bs (n, 3, 3).

    Only rows of segments with a module are written; those of the others must be set beforehand.
    """
    for s in range(len(module_of_segment)):
        row = module_of_segment[s]
        if row >= 0:
            rotation_matrix.rotate_into(observed.specific_force[s], R_bs[s], specific_force[row])
            rotation_matrix.rotate_into(observed.angular_rate[s], R_bs[s], angular_rate[row])
            rotation_matrix.rotate_into(observed.magnetic_field[s], R_bs[s], magnetic_field[row])
            is_measured = is_finite(observed.specific_force[s])
            observed.status[s] = status[row] if is_measured else MISSING
            observed.clipped[s] = clipped[row]
