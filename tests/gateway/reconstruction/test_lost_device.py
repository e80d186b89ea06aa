"""Local devices that fall silent and come back, and pressure tubes, in the tree filter."""

from dataclasses import replace

import numpy as np
import pytest

from devices.emulators.motion.motions import generic_motion
from devices.emulators.sensing.ideal_sensors import measure_point
from firmware_protocol.samples import POSITION, VELOCITY
from gateway.body.rig import load_rig
from gateway.body.skeleton import LocalDevice
from gateway.emulation.rig import dress
from gateway.emulation.simulation import ideal_frames
from gateway.frames import LocalReading, Quantity, Status
from gateway.geometry import quaternion
from gateway.geometry.comparison import orientation_error
from gateway.reconstruction import create_reconstructor, update_many

N, DEVICE, POINT = 1000, 60, np.array([0.0, 0.02, 0.05])
TUBES = np.array([0.0, 0.6, 0.0, 0.8])  # tubes' axes to segment axes


def worn(quantity):
    device = LocalDevice(quantity, 0, POINT, DEVICE, TUBES)
    return replace(load_rig("robot_arm_4"), local_devices=(device,))


@pytest.fixture(scope="module")
def moved():
    """An arm whose base is carried about, 10 s at 100 Hz: its motion's state and noise-free frames."""
    body = dress(worn(Quantity.POSITION))
    motion = generic_motion(body, 5, root_travel_m=1.2)
    times_ns = np.arange(N) * 10_000_000
    frames = list(ideal_frames(worn(Quantity.POSITION), body, motion, times_ns, True))
    rng = np.random.default_rng(5)
    noisy = [
        replace(
            frame,
            specific_force=frame.specific_force + 0.03 * rng.standard_normal((4, 3)),
            angular_rate=frame.angular_rate + 0.002 * rng.standard_normal((4, 3)),
        )
        for frame in frames
    ]
    return motion.state(times_ns * 1e-9), noisy


def with_readings(moved, quantity, silent=range(0)):
    """The frames with a reading of the device each, but not in the silent ones."""
    state, frames = moved
    wire = POSITION if quantity is Quantity.POSITION else VELOCITY
    values = measure_point(state, np.tile(POINT, (4, 1)), wire)[:, 0]
    if quantity is Quantity.AIR_VELOCITY:
        R_bd = quaternion.to_matrix(TUBES)
        values = np.einsum("tji,tj->ti", state.R_wb[:, 0] @ R_bd, values)
    return [
        frame
        if k in silent
        else replace(frame, local=(LocalReading(DEVICE, frame.time_ns, quantity, v, np.full(3, 0.01)),))
        for k, (frame, v) in enumerate(zip(frames, values, strict=True))
    ]


def solved(suit, frames):
    return update_many(create_reconstructor("joint", suit, 0.01), frames)


def test_a_lost_device_is_told_and_taken_up_again_without_a_jump(moved):
    lost, back = 500, 700
    suit = worn(Quantity.POSITION)
    found = solved(suit, with_readings(moved, Quantity.POSITION, range(lost, back)))
    is_unaided = np.array([(frame.status == Status.UNAIDED).all() for frame in found])
    assert not is_unaided[:lost].any()
    # after half a second; of such coarse readings every fifth is taken
    assert np.flatnonzero(is_unaided)[0] - lost == pytest.approx(50, abs=5)
    assert np.flatnonzero(is_unaided)[-1] - back < 20
    q_wb = np.stack([frame.q_wb for frame in found])
    assert np.isfinite(q_wb).all()
    tilt = np.degrees(orientation_error(q_wb, moved[0].q_wb).inclination)
    assert np.abs(np.diff(tilt[back - 5 : back + 100], axis=0)).max() < 0.5
    place = np.stack([frame.p_w[0] for frame in found])
    assert np.isfinite(place[1:]).all()  # the first frame has one reading, which is not yet interpolated
    assert np.ptp(place[lost + 60 : back], axis=0).max() < 0.1  # stands still; the arm below the device turns
    true = moved[0].joint_position[:, 0]
    assert np.linalg.norm(place[-1] - true[-1]) < 0.05
    step = np.linalg.norm(np.diff(place[back - 5 :], axis=0), axis=1)
    assert step.max() < 0.2 * np.linalg.norm(place[back - 1] - true[back])


def test_sigma_tells_a_lost_device_and_covers_the_inclination_without_it(moved):
    suit, lost = worn(Quantity.POSITION), 500
    sigmas, tilt_sigmas, own_tilt_sigmas, tilts = [], [], [], []
    for silent in (range(0), range(lost, N)):
        covariance = np.zeros((N, 4, 2, 3, 3))
        finder = create_reconstructor("joint", suit, 0.01).finder
        found = finder.update_many(with_readings(moved, Quantity.POSITION, silent), None, covariance)
        sigmas.append(np.stack([frame.sigma for frame in found])[lost + 200 :])
        of_tilt = np.sqrt(covariance[..., 0, 0] + covariance[..., 1, 1])[lost + 200 :]
        own_tilt_sigmas.append(of_tilt[:, :, 0])
        tilt_sigmas.append(of_tilt[:, :, 1])
        q_wb = np.stack([frame.q_wb for frame in found])
        tilts.append(orientation_error(q_wb, moved[0].q_wb).inclination[lost + 200 :])
    # bounded speeds say most of what the device says of tilts. What is published has the tilt of the
    # accelerometers' lasting errors, too, which a device does not show
    assert own_tilt_sigmas[1].mean() > 1.05 * own_tilt_sigmas[0].mean()
    assert tilt_sigmas[1].mean() > 1.05 * tilt_sigmas[0].mean()
    lost_tilt = (tilt_sigmas[1] ** 2).mean() - (tilt_sigmas[0] ** 2).mean()
    told = (sigmas[1] ** 2).mean() - (sigmas[0] ** 2).mean()
    assert told > lost_tilt  # the rest of it is heading
    assert (tilts[1] < 2.0 * tilt_sigmas[1]).mean() > 0.95


@pytest.mark.parametrize("quantity", [Quantity.POSITION, Quantity.VELOCITY])
def test_without_any_field_a_device_finds_the_heading_of_the_whole_tree(quantity, moved):
    """Until then only tilts may be taken from it: its rows are in a heading that is not known."""
    frames = [
        replace(frame, magnetic_field=np.full((4, 3), np.nan)) for frame in with_readings(moved, quantity)
    ]
    found = np.stack([frame.q_wb for frame in solved(worn(quantity), frames)])
    error = orientation_error(found, moved[0].q_wb)
    assert np.degrees(error.inclination).max() < 2.0
    assert np.degrees(np.abs(error.heading[300:]).mean(axis=0)).max() < 0.5


def test_without_the_device_from_the_start_it_is_told_too(moved):
    suit = worn(Quantity.POSITION)
    found = solved(suit, with_readings(moved, Quantity.POSITION, range(N)))
    assert (found[100].status == Status.MEASURED).all()
    assert (found[-1].status == Status.UNAIDED).all()


def test_tubes_tell_inclination(moved):
    tubes = solved(worn(Quantity.AIR_VELOCITY), with_readings(moved, Quantity.AIR_VELOCITY))
    silent = solved(worn(Quantity.AIR_VELOCITY), with_readings(moved, Quantity.AIR_VELOCITY, range(N)))
    errors = [
        np.degrees(
            orientation_error(np.stack([f.q_wb for f in frames]), moved[0].q_wb).inclination[400:]
        ).mean()
        for frames in (tubes, silent)
    ]
    assert errors[0] < 1.0
    assert errors[0] < 0.6 * errors[1]
    assert (tubes[-1].status == Status.MEASURED).all()


@pytest.mark.parametrize("quantity", [Quantity.POSITION, Quantity.VELOCITY])
def test_where_a_device_sits_is_found(quantity, moved):
    """Measured 4 cm wrong; its readings are good to a millimetre, or a millimetre a second."""
    rig, error = worn(quantity), np.array([0.03, -0.02, 0.015])
    wrong = replace(rig.local_devices[0], position=POINT - error)
    frames = [
        replace(frame, local=tuple(replace(r, sigma=np.full(3, 0.001)) for r in frame.local))
        for frame in with_readings(moved, quantity)
    ]
    body = create_reconstructor("joint", replace(rig, local_devices=(wrong,)), 0.01)
    found = update_many(body, frames)
    left = body.finder.state()["devices"]["shift"][0] - error
    assert np.linalg.norm(left) < 0.25 * np.linalg.norm(error)
    right = update_many(create_reconstructor("joint", rig, 0.01), frames)
    errors = [
        np.degrees(orientation_error(np.stack([f.q_wb for f in q]), moved[0].q_wb).total[600:]).mean()
        for q in (found, right)
    ]
    assert errors[0] < 1.5 * errors[1] + 0.1


@pytest.mark.parametrize("method", ["joint", "independent"])
def test_a_module_that_nobody_promised_a_device_for_is_measured(method):
    """The shipped rig of one module."""
    suit = load_rig("single")
    body = dress(suit)
    times_ns = np.arange(600) * 10_000_000
    frames = list(ideal_frames(suit, body, generic_motion(body, 5), times_ns, True))
    alone = [replace(frame, local=()) for frame in frames]
    found = update_many(create_reconstructor(method, suit, 0.01), alone)
    assert {int(frame.status[0]) for frame in found[1:]} == {Status.MEASURED}
