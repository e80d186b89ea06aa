"""Floor forces that nobody measured: standing, stepping over, flight; and which foot a plate belongs to."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("mujoco")

from devices.marker_files.force_plates import ForcePlate, ForcePlates
from gateway.analysis.analysing import MeasuredForces, analyse_motion
from gateway.analysis.contact import ContactSettings, estimated_floor, smooth_split
from gateway.analysis.floor import ForceSource, feet
from gateway.analysis.inverse_dynamics import inverse_dynamics
from gateway.analysis.plates import measured_floor
from gateway.analysis.smooth_motion import smooth_motion
from gateway.body.body_file import load_body
from gateway.body.inertia import body_inertia

GRAVITY = np.array([0.0, 0.0, -9.81])
BODY = load_body("human_17")
INERTIA = body_inertia(BODY, 70.0)
WEIGHT = 9.81 * INERTIA.mass.sum()


def held(root_path, frames=40):
    """The neutral posture, carried along a path (F, 3) m."""
    time_s = np.arange(frames) / 100
    q_wb = np.tile(BODY.neutral, (frames, BODY.n_segments, 1))
    motion = smooth_motion(BODY, time_s, q_wb, root_path, None)
    return motion, inverse_dynamics(motion, INERTIA, GRAVITY)


def standing():
    return held(np.tile([0.0, 0.0, 0.928], (40, 1)))


def test_standing_still_each_foot_takes_half_the_weight():
    motion, free = standing()
    floor = estimated_floor(motion, free)
    assert floor.total()[:, 2] == pytest.approx(WEIGHT, rel=1e-3)
    assert floor.force[:, :, 2] == pytest.approx(WEIGHT / 2, rel=1e-2)
    assert (floor.source == ForceSource.ESTIMATED).all()
    with_floor = inverse_dynamics(motion, INERTIA, GRAVITY, floor)
    assert np.abs(with_floor.residual_force).max() < 1e-3 * WEIGHT
    assert np.abs(with_floor.residual_moment).max() < 0.5


def test_estimated_forces_keep_inside_the_friction_pyramid():
    time_s = np.arange(40) / 100
    path = np.stack(
        [0.5 * 12.0 * time_s**2, 0 * time_s, 0.928 + 0 * time_s], axis=1
    )  # more than friction gives
    motion, free = held(path)
    settings = ContactSettings(friction=0.5, speed_m_s=100.0)
    floor = estimated_floor(motion, free, settings=settings)
    sideways = np.abs(floor.force[..., 0]) + np.abs(floor.force[..., 1])
    assert (sideways <= 0.5 * floor.force[..., 2] + 1e-6).all()
    assert np.abs(inverse_dynamics(motion, INERTIA, GRAVITY, floor).residual_force[:, 0]).max() > 100


def test_in_free_fall_the_floor_gives_nothing():
    time_s = np.arange(40) / 100
    motion, free = held(np.stack([0 * time_s, 0 * time_s, 2.0 - 4.905 * time_s**2], axis=1))
    inner = slice(8, -8)
    assert np.abs(free.residual_force[inner]).max() < 1.0
    assert np.abs(estimated_floor(motion, free).total()[inner]).max() < 1.0


def test_the_load_goes_over_smoothly_from_foot_to_foot():
    time_s = np.arange(60) / 100
    standing = np.zeros((60, 2))
    standing[:35, 0], standing[20:, 1] = 1.0, 1.0
    shares = smooth_split(time_s, standing, np.array([0, 1]), ContactSettings())
    assert shares.sum(axis=1) == pytest.approx(1.0)
    assert (shares[:20, 0] == 1).all()
    assert (shares[35:, 1] == 1).all()
    assert (np.diff(shares[:, 1]) >= 0).all()
    assert np.diff(shares[:, 1]).max() < 0.12


def test_standing_on_both_for_long_asks_for_no_split():
    shares = smooth_split(np.arange(200) / 100, np.ones((200, 2)), np.array([0, 1]), ContactSettings())
    assert np.isnan(shares).all()


def plate_under(place, force, frames=400):
    """One plate of 0.4 m by 0.4 m, sampled at 1000 Hz, loaded at its middle from 0.1 to 0.3 s."""
    x, y = place
    corners = np.array(
        [[x + 0.2, y - 0.2, 0], [x - 0.2, y - 0.2, 0], [x - 0.2, y + 0.2, 0], [x + 0.2, y + 0.2, 0]]
    )
    loads = np.zeros((frames, 3))
    loads[100:300] = force
    return ForcePlate(corners, loads, np.zeros((frames, 3)))


@pytest.mark.parametrize(("foot", "across"), [("left_foot", 0.167), ("right_foot", -0.167)])
def test_a_plate_belongs_to_the_foot_over_it(foot, across):
    motion, free = standing()
    plates = ForcePlates(1000.0, (plate_under((0.05, across), [5.0, 0.0, 400.0]),))
    floor = measured_floor(plates, "z", motion, free, None)
    c = feet(BODY).tolist().index(NAMES.index(foot))
    assert floor.force[20, c] == pytest.approx([5, 0, 400])
    assert floor.source[20, c] == ForceSource.MEASURED
    assert not floor.source[:, 1 - c].any()
    assert floor.centre_of_pressure()[20, c] == pytest.approx([0.05, across, 0.0], abs=1e-9)
    assert not floor.notes


def test_a_load_far_from_all_feet_is_nobodys():
    motion, free = standing()
    plates = ForcePlates(1000.0, (plate_under((1.5, 0.0), [0.0, 0.0, 400.0]),))
    floor = measured_floor(plates, "z", motion, free, None)
    assert not floor.source.any()
    assert "plate 1 at 0.10" in floor.notes[0]
    assert "m from the next sole and counts as nobody's" in floor.notes[0]


def test_what_an_empty_plate_shows_is_taken_off():
    motion, free = standing()
    plate = plate_under((0.05, 0.167), [0.0, 0.0, 400.0])
    noise = np.random.default_rng(3).normal(0.0, 3.0, (400, 3))
    offset = np.array([2.0, -1.0, 14.0])
    plates = ForcePlates(1000.0, (replace(plate, force=plate.force + offset + noise),))
    floor = measured_floor(plates, "z", motion, free, None)
    assert floor.force[15:25].sum(axis=1).mean(axis=0) == pytest.approx([0.0, 0.0, 400.0], abs=3.0)
    assert np.abs(floor.force[:8].sum(axis=1).mean(axis=0)).max() < 4.0


def test_plates_of_a_stair_have_their_own_heights_and_nothing_is_estimated_beside_them():
    motion, free = standing()
    low = plate_under((0.05, 0.167), [60.0, 0.0, 400.0])
    high = plate_under((3.0, 0.0), [0.0, 0.0, 0.0])
    raised = replace(low, corners=low.corners + np.array([0.0, 0.0, 0.2]))
    plates = ForcePlates(1000.0, (raised, high))
    floor = measured_floor(plates, "z", motion, free, None)
    c = feet(BODY).tolist().index(NAMES.index("left_foot"))
    assert floor.centre_of_pressure()[20, c] == pytest.approx([0.05, 0.167, 0.2], abs=1e-9)
    assert "different heights" in floor.notes[0]
    found = analyse_motion(motion, "stair", INERTIA, GRAVITY, MeasuredForces(plates, "z"))
    assert not (found.floor.source == ForceSource.ESTIMATED).any()


def test_a_foot_beside_its_plate_is_told():
    motion, free = standing()
    plates = ForcePlates(1000.0, (plate_under((-0.17, 0.167), [0.0, 0.0, 400.0]),))
    assert (
        "left foot stands partly beside plate 1" in measured_floor(plates, "z", motion, free, None).notes[0]
    )


NAMES = list(BODY.segment_names)
