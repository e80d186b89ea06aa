"""From rows of modules to segments and their axes."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation
from simulated_body import arm, imu_frames, instants, simulate

from gateway.frames import Status
from gateway.reconstruction.inertial.observations import SegmentObserver


def one_frame(body):
    return imu_frames(body, simulate(body, instants(100, 0.01)), gyroscopes=True)[0]


def test_rows_are_turned_into_segment_axes():
    rng = np.random.default_rng(2)
    mounting = Rotation.random(4, rng=rng)  # q_bs
    body = arm(on_joint=False, module_of_segment=(2, 0, 3, 1))
    suit = replace(body.suit(), sensor_to_segment=mounting.as_quat()[:, [3, 0, 1, 2]])
    imu_frame = one_frame(body)
    observed = SegmentObserver(suit).observe(imu_frame)
    for segment, row in enumerate((2, 0, 3, 1)):
        for found, sensed in (
            (observed.specific_force, imu_frame.specific_force),
            (observed.angular_rate, imu_frame.angular_rate),
            (observed.magnetic_field, imu_frame.magnetic_field),
        ):
            np.testing.assert_allclose(found[segment], mounting[segment].apply(sensed[row]), atol=1e-13)
    np.testing.assert_array_equal(observed.status, np.full(4, Status.MEASURED))


def test_identity_mounting_changes_no_bit():
    body = arm(on_joint=False)
    imu_frame = one_frame(body)
    observed = SegmentObserver(body.suit()).observe(imu_frame)
    np.testing.assert_array_equal(observed.specific_force, imu_frame.specific_force)


def test_no_module_and_no_value_are_missing():
    body = arm(on_joint=False, module_of_segment=(0, -1, 1, 2))
    imu_frame = one_frame(body)
    imu_frame.specific_force[2] = np.nan
    imu_frame.magnetic_field[1] = np.nan
    imu_frame.status[1] = Status.INTERPOLATED
    observed = SegmentObserver(body.suit()).observe(imu_frame)
    expected = [Status.MEASURED, Status.MISSING, Status.INTERPOLATED, Status.MISSING]
    np.testing.assert_array_equal(observed.status, expected)
    np.testing.assert_array_equal(np.isnan(observed.specific_force).all(axis=1), [False, True, False, True])
    np.testing.assert_array_equal(np.isnan(observed.magnetic_field).all(axis=1), [False, True, True, False])


def test_read_only_and_strided_rows_are_taken():
    body = arm(on_joint=False)
    imu_frame = one_frame(body)
    wide = np.repeat(imu_frame.specific_force, 2, axis=1)[:, ::2]
    wide.flags.writeable = False
    observed = SegmentObserver(body.suit()).observe(replace(imu_frame, specific_force=wide))
    np.testing.assert_array_equal(observed.specific_force, imu_frame.specific_force)
