"""Samples that a radio loses: gaps of some frames, each module by itself, all the time."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gateway.emulation.fast_arm import Switches, fast_arm, fast_motion, sampled
from gateway.frames import ImuFrame, Status
from gateway.geometry.comparison import orientation_error
from gateway.reconstruction.inertial.tree.reconstructor import ChainSettings, JointReconstructor
from gateway.reconstruction.inertial.tree.start import give_of, turn_beyond
from gateway.reconstruction.inertial.tree.state import Heading, chain_body, initial_state, work_space
from gateway.reconstruction.inertial.tree.tuning import tuning

SUIT, SEED, FROM_S = fast_arm(), 3, 5.0


@pytest.fixture(scope="module")
def frames() -> list[ImuFrame]:
    """Fifteen seconds of an arm in full swing."""
    return sampled(SUIT, fast_motion(SUIT, SEED), Switches(), SEED, seconds=15.0)


def losing(frames: list[ImuFrame], share: float, longest: int) -> list[ImuFrame]:
    """Return them with a share of each module's samples lost, up to so many in a row."""
    rng = np.random.default_rng(1)
    left, found = np.zeros(len(frames[0].status), int), []
    for frame in frames:
        begins = rng.random(len(left)) < share / (0.5 * (longest + 1))
        left = np.where(
            (left == 0) & begins, rng.integers(1, longest + 1, len(left)), np.maximum(left - 1, 0)
        )
        is_lost = left > 0
        status = np.where(is_lost, Status.MISSING.value, frame.status).astype(np.uint8)
        force, rate = (
            np.where(is_lost[:, np.newaxis], np.nan, values)
            for values in (frame.specific_force, frame.angular_rate)
        )
        found.append(replace(frame, status=status, specific_force=force, angular_rate=rate))
    return found


def tilt_deg(frames: list[ImuFrame]) -> float:
    """RMS of all segments' inclinations."""
    poses = JointReconstructor(SUIT, 0.01, ChainSettings(uses_field=False)).update_many(frames)
    times_s = np.array([pose.time_ns for pose in poses]) * 1e-9
    late = times_s > FROM_S
    error = orientation_error(
        np.stack([pose.q_wb for pose in poses])[late], fast_motion(SUIT, SEED).state(times_s[late]).q_wb
    )
    return float(np.degrees(np.sqrt(np.mean(error.inclination**2))))


def test_single_losses_cost_hardly_anything(frames):
    """They were taken for 0.1 s of a motion that nobody knows, and made the joints wait."""
    assert tilt_deg(losing(frames, 0.05, 1)) < 1.3 * tilt_deg(frames)


def test_a_tenth_lost_up_to_four_in_a_row_leaves_the_arm_where_it_is(frames):
    assert tilt_deg(losing(frames, 0.1, 4)) < 3.0


def test_a_segment_that_came_back_amid_a_body_does_not_turn_the_body():
    """The fourth's heading is shown against the third, which has lost its own; the first two know theirs."""
    numbers, n = tuning(), len(SUIT.skeleton.parents)
    body, state, work = chain_body(SUIT, uses_field=False), initial_state(n, 0), work_space(n)
    segments, lost = state.segments, numbers.unknown_heading**2
    for s, variance in enumerate((1e-3, 1e-3, lost, 0.1, 0.1)):
        segments[s].P[2, 2], segments[s].started = variance, 1
        segments[s].heading = Heading.UNOBSERVED.value if s == 2 else Heading.OBSERVED.value
    turn_beyond(body, state, numbers, work, 3, 1.0)
    turns = np.array([now.turn[2] for now in work.segments])
    gives, above_gives = give_of(segments[3], numbers), give_of(segments[0], numbers)
    beyond = gives / (gives + above_gives)
    np.testing.assert_allclose(turns, [beyond - 1.0] * 3 + [beyond] * 2)
    assert abs(turns[0]) < 0.01


@pytest.mark.parametrize(
    ("lost", "joint", "is_anew"),
    [(-1, -1, False), (0, 1, False), (None, -1, True)],
    ids=["the last", "the root", "none"],
)
def test_a_body_is_to_turn_to_its_compasses_only_where_its_own_heading_was_found_anew(lost, joint, is_anew):
    """A module that came back turned whole bodies after compasses that were wrong."""
    numbers, n = tuning(), len(SUIT.skeleton.parents)
    body, state, work = chain_body(SUIT, uses_field=True), initial_state(n, 0), work_space(n)
    segments = state.segments
    for s in range(n):
        segments[s].P[2, 2], segments[s].started = 1e-3, 1
        segments[s].heading = Heading.OBSERVED.value
    if lost is not None:
        segments[lost % n].P[2, 2] = numbers.unknown_heading**2
    segments[0].compass.settled_s = 100.0
    turn_beyond(body, state, numbers, work, joint % n, 1.0)
    assert (segments[0].compass.settled_s == 0.0) == is_anew


def silent(frames: list[ImuFrame], segment: int, first: int, n_frames: int) -> list[ImuFrame]:
    """Return them without the samples of one module in ``n_frames`` from ``first`` on."""
    held = list(frames)
    for k in range(first, first + n_frames):
        status, lost = held[k].status.copy(), np.zeros((len(held[k].status), 1))
        status[segment], lost[segment] = Status.MISSING.value, np.nan
        force, rate = held[k].specific_force + lost, held[k].angular_rate + lost
        held[k] = replace(held[k], status=status, specific_force=force, angular_rate=rate)
    return held


def test_a_module_that_was_silent_in_full_swing_finds_back_to_its_neighbours(frames):
    """Half of them were more than 12° off 0.6 s later, between neighbours that knew better."""
    found = []
    for first in (800, 900, 1000, 1100):
        for segment in (1, 2, 3):
            filter_ = JointReconstructor(SUIT, 0.01, ChainSettings(uses_field=False))
            pose = filter_.update_many(silent(frames, segment, first, 40)[: first + 101])[-1]
            truth = fast_motion(SUIT, SEED).state(np.array([pose.time_ns * 1e-9])).q_wb
            found.append(orientation_error(pose.q_wb[np.newaxis], truth).inclination.max())
    assert np.degrees(np.median(found)) < 9.0


def alone(
    times_s: np.ndarray, forces: np.ndarray, rates: np.ndarray, fields: np.ndarray, is_lost: np.ndarray
) -> list[ImuFrame]:
    """Return frames in which only the first module measures, (T, 3) each, and not where it is lost (T,)."""
    n, frames = len(SUIT.module_ids), []
    for k, t in enumerate(times_s):
        is_silent = (np.arange(n) != 0) | is_lost[k]
        force, rate, field = (
            np.where(is_silent[:, np.newaxis], np.nan, values[k]) for values in (forces, rates, fields)
        )
        status = np.where(is_silent, Status.MISSING.value, Status.MEASURED.value).astype(np.uint8)
        frames.append(ImuFrame(k, round(t * 1e9), force, rate, field, status, np.zeros(n)))
    return frames


def rocking(seed: int, noise: float, bias: float = 0.0) -> tuple[list[ImuFrame], Rotation]:
    """Half a minute of one module that lies still for 10 s and is then rocked by hand, and how it was turned.

    noise: of a sample of the rate, rad/s, and ten times that of the specific force, m/s². bias: rad/s.
    """
    rng, times_s = np.random.default_rng(seed), np.arange(0.0, 30.0, 0.01)
    moves = np.clip((times_s - 10.0) / 2.0, 0.0, 1.0)
    angles = moves[:, np.newaxis] * np.stack([0.3 * np.sin(1.9 * times_s), 0.4 * np.sin(1.3 * times_s)], 1)
    truth = Rotation.from_euler("xy", angles)
    steps = (truth[:-1].inv() * truth[1:]).as_rotvec() / 0.01
    rates = np.vstack([steps[:1], 0.5 * (steps[:-1] + steps[1:]), steps[-1:]])
    rates = rates + bias + rng.normal(0.0, noise, rates.shape)
    forces = truth.inv().apply(-SUIT.gravity) + rng.normal(0.0, 10.0 * noise, rates.shape)
    no_field, is_lost = np.full(rates.shape, np.nan), np.zeros(len(times_s), bool)
    return alone(times_s, forces, rates, no_field, is_lost), truth


def off_deg(frames: list[ImuFrame], truth: Rotation, from_s: float) -> float:
    """RMS of the angle by which the first segment is off, its heading at ``from_s`` taken out."""
    settings = ChainSettings(uses_field=False)
    poses = JointReconstructor(SUIT, 0.01, settings).update_many(frames)
    found = Rotation.from_quat(np.stack([pose.q_wb[0] for pose in poses]), scalar_first=True)
    error, first = found * truth.inv(), round(from_s / 0.01)
    z = error[first].as_quat()
    turned = Rotation.from_rotvec([0.0, 0.0, 2.0 * np.arctan2(z[2], z[3])])
    return float(np.degrees(np.sqrt(np.mean((error * turned.inv())[first:].magnitude() ** 2))))


def test_a_slow_module_that_loses_samples_is_nearly_as_good_as_one_that_does_not():
    """It was taken to turn by 2 rad/s in each gap, and was off three and a half times as much."""
    whole, lossy = [], []
    for seed in range(4):
        frames, truth = rocking(seed, noise=0.002)
        whole.append(off_deg(frames, truth, 12.0))
        lossy.append(off_deg(losing(frames, 0.1, 7), truth, 12.0))
    assert np.mean(lossy) < 2.0 * np.mean(whole)


@pytest.mark.parametrize(("noise", "most"), [(0.001, 0.5), (0.03, 1.2)])
def test_a_bias_is_found_at_rest_whatever_the_noise(noise, most):
    """With noise of 0.3 m/s² rest was never found: 2.6° twenty seconds later."""
    frames, truth = rocking(5, noise, bias=0.01)
    assert off_deg(frames, truth, 10.0) < most


def test_a_lone_module_that_turned_unseen_turns_back_to_the_field_at_once():
    """Only as fast as gyroscopes drift it took a minute."""
    rate, times_s = np.array([0.0, 0.0, 2.0]), np.arange(0.0, 14.0, 0.01)
    back = Rotation.from_rotvec(-np.outer(times_s, rate))
    forces, fields = back.apply(-SUIT.gravity), back.apply(SUIT.magnetic_field)
    rates, is_lost = np.tile(rate, (len(times_s), 1)), (times_s > 8.0) & (times_s < 8.7)
    frames = alone(times_s, forces, rates, fields, is_lost)
    poses = JointReconstructor(SUIT, 0.01).update_many(frames)
    found = Rotation.from_quat(np.stack([pose.q_wb[0] for pose in poses]), scalar_first=True)
    error_deg = np.degrees((found * back).magnitude())
    assert error_deg[(times_s > 7.0) & (times_s < 8.0)].max() < 1.0
    assert error_deg[times_s > 12.0].max() < 10.0


@pytest.mark.parametrize("hours", [0.01, 6.0, 1200.0])
def test_modules_that_come_back_one_after_another_after_hours_have_poses(frames, hours):
    """What a segment had in common with one that had begun anew was kept: poses became NaN, for ever."""
    pause_ns = round(hours * 3600e9)
    later = [replace(frame, time_ns=frame.time_ns + pause_ns) for frame in frames[500:900]]
    for s in range(len(frames[0].status)):
        later = silent(later, s, 0, 5 * s)
    poses = JointReconstructor(SUIT, 0.01, ChainSettings(uses_field=False)).update_many(frames[:500] + later)
    assert all(np.isfinite(pose.q_wb).all() for pose in poses[-300:])
