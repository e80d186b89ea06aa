"""What surrounds every reconstructor: rest, place in the world, segments without module, faults, agreement.

The orientations come from the emulator's truth, so that only this is tested.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from devices.emulators.motion.gait import RUN, WALK
from devices.emulators.motion.motions import gait_motion, generic_motion
from devices.emulators.sensing.ideal_sensors import sense
from gateway.body.rig import load_rig
from gateway.emulation.rig import dress
from gateway.frames import Clipped, ImuFrame, Quantity, SkeletonFrame, Status
from gateway.reconstruction.whole_body import RootMode, RootSettings, WholeBodyReconstructor

RATE_HZ = 100


class KnownOrientations:
    """Stands in for a reconstructor."""

    def __init__(self, state):
        self.q_wb, self.rate = state.q_wb, state.angular_rate

    def reset(self):
        pass

    def state(self):
        return {}

    def set_state(self, state):
        pass

    def update(self, observation, stood_s=None):
        k, n = observation.sequence, self.q_wb.shape[1]
        zeros = np.zeros((n, 3))
        status = np.zeros(n, np.uint8)
        return SkeletonFrame(
            k, observation.time_ns, self.q_wb[k], self.rate[k], zeros, zeros, np.full(n, 0.02), status, 0
        )


def observed(suit, state, seed=1):
    """What slightly noisy modules measure."""
    rng = np.random.default_rng(seed)
    segments = [int(np.flatnonzero(suit.module_of_segment == m)[0]) for m in range(len(suit.module_ids))]
    unturned = np.tile(np.eye(3), (suit.skeleton.n_segments, 1, 1))
    values = sense(state, suit.lever_arms, unturned, suit.gravity, suit.magnetic_field)
    noise = rng.normal(0.0, 1.0, (2, len(state.R_wb), len(segments), 3))
    m = len(segments)
    return [
        ImuFrame(
            k,
            round(k * 1e9 / RATE_HZ),
            values.specific_force[k, segments] + 0.05 * noise[0, k],
            values.angular_rate[k, segments] + 0.005 * noise[1, k],
            values.magnetic_field[k, segments],
            np.zeros(m, np.uint8),
            np.zeros(m, np.int64),
        )
        for k in range(len(state.R_wb))
    ]


@pytest.fixture(scope="module")
def suit():
    return replace(load_rig("suit_17"), local_devices=())


def walk(suit, gait, seconds=15.0):
    """Truth and frames of a walk that sets off after 2 s."""
    state = gait_motion(dress(suit), 1, gait=gait).state(np.arange(round(seconds * RATE_HZ)) / RATE_HZ)
    return state, observed(suit, state)


@pytest.fixture(scope="module")
def walked(suit):
    return walk(suit, WALK)


@pytest.fixture(scope="module")
def placed(suit, walked):
    state, frames = walked
    reconstructor = WholeBodyReconstructor(suit, KnownOrientations(state))
    return state, [reconstructor.update(frame) for frame in frames]


def test_the_body_goes_where_it_went(placed):
    state, frames = placed
    place = np.array([frame.p_w[0] for frame in frames])
    truth = state.joint_position[:, 0]
    off = (place - place[0]) - (truth - truth[0])
    assert np.linalg.norm(truth[-1] - truth[0]) > 11.0
    assert np.abs(off[-1, :2]).max() < 0.003 * 12.0
    assert np.abs(off[:, 2]).max() < 0.03


def test_the_body_starts_over_the_origin_with_its_feet_on_the_floor(placed, suit):
    first = placed[1][0]
    np.testing.assert_allclose(first.p_w[0, :2], 0.0, atol=1e-3)
    foot = suit.skeleton.index("left_foot")
    assert first.p_w[foot, 2] == pytest.approx(0.068, abs=2e-3)


def test_nothing_jumps_where_the_feet_take_over(placed):
    state, frames = placed
    place = np.array([frame.p_w[0] for frame in frames])
    step = np.linalg.norm(np.diff(place, axis=0), axis=1)
    true_step = np.linalg.norm(np.diff(state.joint_position[:, 0], axis=0), axis=1)
    assert np.abs(step - true_step).max() < 0.006


def test_the_feet_alternate_as_the_root(placed, suit):
    roots = np.array([frame.root for frame in placed[1]])[400:]
    feet = [suit.skeleton.index(f"{side}_foot") for side in ("left", "right")]
    assert set(roots) == set(feet)
    steps = 2 * WALK.stride_hz * len(roots) / RATE_HZ
    assert np.count_nonzero(np.diff(roots)) == pytest.approx(steps, abs=1.5)


def test_the_standing_foot_is_held(placed, suit):
    state, frames = placed
    foot = suit.skeleton.index("left_foot")
    still = np.linalg.norm(state.joint_velocity[:, foot], axis=1) < 1e-3
    still[:500] = False
    speed = np.linalg.norm(np.diff([frame.p_w[foot] for frame in frames], axis=0), axis=1) * RATE_HZ
    assert np.median(speed[still[1:]]) < 0.03


def test_running_is_followed_through_its_flights(suit):
    state, frames = walk(suit, RUN, 12.0)
    reconstructor = WholeBodyReconstructor(suit, KnownOrientations(state))
    place = np.array([reconstructor.update(frame).p_w[0] for frame in frames])
    truth = state.joint_position[:, 0] - state.joint_position[0, 0]
    off = place - place[0] - truth
    assert truth[-1, 0] > 19.0
    assert np.linalg.norm(off[-1, :2]) < 0.01 * truth[-1, 0]


def test_resuming_equals_one_run_bit_for_bit(suit, walked):
    state, frames = walked
    whole, second = (WholeBodyReconstructor(suit, KnownOrientations(state)) for _ in range(2))
    for frame in frames[:450]:
        whole.update(frame)
    second.set_state(whole.state())
    for frame in frames[450:600]:
        a, b = whole.update(frame), second.update(frame)
        np.testing.assert_array_equal(a.p_w, b.p_w)
        assert a.root == b.root


def test_a_state_of_another_body_is_refused(suit, walked):
    reconstructor = WholeBodyReconstructor(suit, KnownOrientations(walked[0]))
    state = reconstructor.state() | {"stance.segments": np.zeros(3)}
    with pytest.raises(ValueError, match=r"'stance.segments' does not fit"):
        reconstructor.set_state(state)


def test_a_fixed_root_stays(suit, walked):
    state, frames = walked
    reconstructor = WholeBodyReconstructor(suit, KnownOrientations(state), RootSettings(RootMode.FIXED))
    for frame in frames[:500]:
        seen = reconstructor.update(frame)
    np.testing.assert_array_equal(seen.p_w[0], 0.0)
    assert seen.root == 0


def test_a_measured_place_is_left_alone(suit, walked):
    state, frames = walked
    device = replace(load_rig("suit_17").local_devices[0], quantity=Quantity.POSITION)
    reconstructor = WholeBodyReconstructor(replace(suit, local_devices=(device,)), KnownOrientations(state))
    for frame in frames[:500]:
        seen = reconstructor.update(frame)
    np.testing.assert_array_equal(seen.p_w[0], 0.0)


def test_a_body_without_feet_cannot_be_made_to_walk():
    with pytest.raises(ValueError, match="'robot_arm_4' has no contacts"):
        WholeBodyReconstructor(load_rig("robot_arm_4"), KnownOrientations, RootSettings(RootMode.WALKING))


def test_an_open_floor_keeps_heights_that_a_level_floor_takes_away(suit, walked):
    """Orientations tilted by 2° let the feet seem to climb."""
    state, frames = walked
    heights = {}
    for has_floor in (True, False):
        finder = KnownOrientations(state)
        tilt = np.array([np.cos(0.02), 0.0, -np.sin(0.02), 0.0])
        w, x, y, z = np.moveaxis(finder.q_wb, -1, 0)
        a, c = tilt[0], tilt[2]
        finder.q_wb = np.stack([a * w - c * y, a * x + c * z, a * y + c * w, a * z - c * x], axis=-1)
        reconstructor = WholeBodyReconstructor(suit, finder, RootSettings(has_floor=has_floor))
        z_w = [reconstructor.update(frame).p_w[0, 2] for frame in frames]
        heights[has_floor] = abs(z_w[-1] - z_w[0])
    assert heights[False] > 0.2
    assert heights[True] < 0.08


@pytest.mark.parametrize("fault", ["dead", "stuck"])
def test_a_walk_goes_on_over_one_foot(suit, walked, fault):
    """The left foot's module fails at 5 s, in mid-swing; the right one's and the pelvis' carry on."""
    state, frames = walked
    reconstructor = WholeBodyReconstructor(suit, KnownOrientations(state))
    foot = suit.module_of_segment[suit.skeleton.index("left_foot")]
    swing = 500 + int(np.argmax(state.joint_velocity[500:620, suit.skeleton.index("left_foot"), 0]))
    held = frames[swing]
    for k, frame in enumerate(frames[:1200]):
        shown = frame
        if k > swing:
            force, rate = frame.specific_force.copy(), frame.angular_rate.copy()
            force[foot] = held.specific_force[foot] if fault == "stuck" else np.nan
            rate[foot] = held.angular_rate[foot] if fault == "stuck" else np.nan
            shown = replace(frame, specific_force=force, angular_rate=rate)
        seen = reconstructor.update(shown)
        assert np.isfinite(seen.p_w).all()
    walked_m = state.joint_position[1199, 0] - state.joint_position[0, 0]
    assert np.linalg.norm(seen.p_w[0, :2] - walked_m[:2]) < 0.05 * walked_m[0]


@pytest.mark.parametrize("first", [560, 600, 650])
def test_both_feet_stuck_neither_carry_the_body_away_nor_hold_it_for_ever(suit, walked, first):
    """For 4 s both feet repeat what they said somewhere in a stride; then the walk goes on."""
    state, frames = walked
    reconstructor = WholeBodyReconstructor(suit, KnownOrientations(state))
    feet = [suit.module_of_segment[suit.skeleton.index(f"{side}_foot")] for side in ("left", "right")]
    place = []
    for k, frame in enumerate(frames[: first + 700]):
        shown = frame
        if first <= k < first + 400:
            force, rate = frame.specific_force.copy(), frame.angular_rate.copy()
            force[feet], rate[feet] = frames[first].specific_force[feet], frames[first].angular_rate[feet]
            shown = replace(frame, specific_force=force, angular_rate=rate)
        place.append(reconstructor.update(shown).p_w[0])
    place = np.array(place)
    off = place - state.joint_position[: len(place), 0]
    # as long as a flight may last, the body goes on as its own module says
    assert np.linalg.norm(off[first : first + 140] - off[first - 1], axis=1).max() < 0.25
    # no foot has told anything for two seconds, and for three
    assert np.ptp(place[first + 250 : first + 400, :2], axis=0).max() < 0.2
    assert np.ptp(place[first + 350 : first + 400, :2], axis=0).max() < 0.05
    assert np.linalg.norm((off[first + 699] - off[first + 450])[:2]) < 0.05  # and it walks on


def test_a_sensor_at_the_end_of_its_range_is_told_whatever_finds_the_orientations(suit, walked):
    state, frames = walked
    reconstructor = WholeBodyReconstructor(suit, KnownOrientations(state))
    clipped = np.zeros(len(suit.module_ids), np.uint8)
    pelvis, foot = (suit.module_of_segment[suit.skeleton.index(s)] for s in ("pelvis", "left_foot"))
    clipped[pelvis], clipped[foot] = Clipped.SPECIFIC_FORCE, Clipped.SPECIFIC_FORCE | Clipped.ANGULAR_RATE
    seen = reconstructor.update(replace(frames[0], clipped=clipped))
    told = {suit.skeleton.segment_names[s]: Status(seen.status[s]) for s in np.flatnonzero(seen.status)}
    assert told == {"pelvis": Status.UNAIDED, "left_foot": Status.PREDICTED}


class Seen(KnownOrientations):
    """Keeps the last observation."""

    def update(self, observation, stood_s=None):
        self.observation = observation
        return super().update(observation, stood_s)


def test_a_stuck_module_counts_as_silent_and_comes_back(suit, walked):
    state, frames = walked
    finder = Seen(state)
    reconstructor = WholeBodyReconstructor(suit, finder)
    silent = []
    for k, frame in enumerate(frames[300:520]):
        force, rate = frame.specific_force.copy(), frame.angular_rate.copy()
        if 20 <= k < 120:
            force[4], rate[4] = frames[320].specific_force[4], frames[320].angular_rate[4]
        reconstructor.update(replace(frame, specific_force=force, angular_rate=rate))
        silent.append(finder.observation.status[4] == Status.MISSING)
    assert np.flatnonzero(silent)[[0, -1]] == pytest.approx([70, 119], abs=1)


def test_modules_that_all_repeat_themselves_are_not_called_stuck(suit, walked):
    state, frames = walked
    finder = Seen(state)
    reconstructor = WholeBodyReconstructor(suit, finder)
    for k in range(150):
        reconstructor.update(replace(frames[0], time_ns=k * 10_000_000))
    assert finder.observation.status.max() == Status.MEASURED


def rows_exchanged(frame, a, b):
    """The frame with two modules swapped."""
    order = np.arange(len(frame.status))
    order[[a, b]] = order[[b, a]]
    return replace(frame, specific_force=frame.specific_force[order], angular_rate=frame.angular_rate[order])


def test_modules_worn_wrong_agree_with_no_neighbour():
    suit = replace(load_rig("suit_17"), local_devices=())
    motion = generic_motion(dress(suit), 3, peak_angular_rate=6.0, peak_angular_acceleration=60.0)
    state = motion.state(np.arange(900) / RATE_HZ)
    frames = observed(suit, state)
    left, right = (suit.skeleton.index(f"{side}_forearm") for side in ("left", "right"))
    modules = suit.module_of_segment[[left, right]]
    scores = []
    for worn in (lambda frame: frame, lambda frame: rows_exchanged(frame, *modules)):
        finder = KnownOrientations(state)
        reconstructor = WholeBodyReconstructor(suit, finder)
        for frame in frames:
            reconstructor.update(worn(frame))
        scores.append(reconstructor.joint_agreement())
    right_way, swapped = scores
    assert len(right_way) >= suit.skeleton.n_segments - 1  # the pelvis hardly moves
    assert max(right_way.values()) < 0.3
    assert min(swapped["left_forearm"], swapped["right_forearm"]) > 0.8
    others = [v for name, v in swapped.items() if "arm" not in name and "hand" not in name]
    assert max(others) < 0.3


def test_who_does_not_move_gets_no_score(suit):
    state = gait_motion(dress(suit), 1).state(np.zeros(600))
    reconstructor = WholeBodyReconstructor(suit, KnownOrientations(state))
    for frame in observed(suit, state):
        reconstructor.update(frame)
    assert reconstructor.joint_agreement() == {}


def test_stuck_gyroscopes_make_their_module_silent_in_motion(suit, walked):
    state, frames = walked
    finder = Seen(state)
    reconstructor = WholeBodyReconstructor(suit, finder)
    silent, rng = [], np.random.default_rng(1)
    for k, frame in enumerate(frames[300:420]):
        rate = frame.angular_rate.copy()
        if 20 <= k < 100:
            rate[4] = frames[320].angular_rate[4] * (1.0 + 1e-15 * rng.standard_normal())  # as interpolated
        reconstructor.update(replace(frame, angular_rate=rate))
        silent.append((finder.observation.status == Status.MISSING).copy())
    silent = np.array(silent)
    assert not np.delete(silent, 4, axis=1).any()
    assert np.flatnonzero(silent[:, 4])[0] == pytest.approx(35, abs=3)
    assert silent[40:100, 4].all()  # also at moments at which it hardly moves
    assert not silent[100:, 4].any()


def test_modules_without_gyroscopes_are_not_called_stuck(suit, walked):
    state, frames = walked
    finder = Seen(state)
    reconstructor = WholeBodyReconstructor(suit, finder)
    for frame in frames[300:360]:
        reconstructor.update(replace(frame, angular_rate=np.full_like(frame.angular_rate, np.nan)))
    assert finder.observation.status.max() == Status.MEASURED


def test_a_magnetometer_that_repeats_itself_in_a_turn_is_left_out_and_named(suit, walked):
    state, frames = walked
    finder = Seen(state)
    reconstructor = WholeBodyReconstructor(suit, finder)
    used, named = [], []
    for k, frame in enumerate(frames[300:800]):
        field = frame.magnetic_field.copy()
        if k < 400:
            field[4] = (10.0, 20.0, 30.0)
        reconstructor.update(replace(frame, magnetic_field=field))
        used.append(np.isfinite(finder.observation.magnetic_field).all(axis=1))
        named.append(set(reconstructor.doubts()))
        assert finder.observation.status[4] == Status.MEASURED
    used = np.array(used)
    assert np.delete(used, 4, axis=1).all()
    assert used[:200, 4].all()  # no slow magnetometer is taken for it
    assert not used[300:400, 4].any()
    assert used[401:, 4].all()
    assert suit.module_ids[4] in named[399]
    assert suit.module_ids[4] not in named[-1]


def test_a_stuck_magnetometer_that_is_read_seldom_is_named_in_every_frame(suit, walked):
    state, frames = walked
    reconstructor = WholeBodyReconstructor(suit, Seen(state))
    named = []
    for k, frame in enumerate(frames[300:700]):
        field = np.full_like(frame.magnetic_field, np.nan)
        if k % 5 == 0:
            field = frame.magnetic_field.copy()
            field[4] = (10.0, 20.0, 30.0)
        reconstructor.update(replace(frame, magnetic_field=field))
        named.append(set(reconstructor.doubts()))
    assert named[300:] == [{suit.module_ids[4]}] * 100


def test_a_magnetometer_at_rest_may_repeat_itself(suit, walked):
    state, frames = walked
    finder = Seen(state)
    reconstructor = WholeBodyReconstructor(suit, finder)
    rng = np.random.default_rng(2)
    for k in range(600):
        noise = rng.normal(scale=0.01, size=frames[0].angular_rate.shape)
        reconstructor.update(replace(frames[0], time_ns=k * 10_000_000, angular_rate=noise))
    assert np.isfinite(finder.observation.magnetic_field).all()
