"""Modules worn otherwise than the rig says are told within ten seconds of motion; others never are."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

from devices.emulators.data_sets import read_repoimu_pendulum, read_ring_chain5
from devices.emulators.imperfections import PRESETS
from gateway.body.rig import load_rig
from gateway.emulation.recordings import imu_frames
from gateway.emulation.rig import dress, move
from gateway.emulation.simulation import assembled
from gateway.frames import Status
from gateway.reconstruction import create_reconstructor, mounting
from gateway.reconstruction.mounting import UNKNOWN, Arrangement, Found

SECONDS = 14.0
"""The walk sets off at 2.75 s."""
UPSIDE_DOWN = np.diag([1.0, -1.0, -1.0])


@pytest.fixture(scope="module")
def suit():
    return load_rig("suit_lower_7")


@pytest.fixture(scope="module")
def walk(suit):
    """Frames of a walking person whose modules are worn right."""
    return assembled(suit, move(dress(suit), suit.skeleton.name, 1), PRESETS["typical"], SECONDS, 1)


def upside_down(frames, suit, segment):
    """The same with the segment's module turned by 180° about x, along which this rig has them."""
    row = suit.module_of_segment[suit.skeleton.index(segment)]
    turn = np.tile(np.eye(3), (len(suit.module_ids), 1, 1))
    turn[row] = UPSIDE_DOWN

    def turned(values):
        return np.einsum("mij,mj->mi", turn, values)

    return [
        replace(
            frame,
            specific_force=turned(frame.specific_force),
            angular_rate=turned(frame.angular_rate),
            magnetic_field=turned(frame.magnetic_field),
        )
        for frame in frames
    ]


def exchanged(frames, suit, *segments):
    """The same with two modules exchanged."""
    a, b = (suit.module_of_segment[suit.skeleton.index(segment)] for segment in segments)
    order = np.arange(len(suit.module_ids))
    order[[a, b]] = order[[b, a]]
    return [
        replace(
            frame,
            specific_force=frame.specific_force[order],
            angular_rate=frame.angular_rate[order],
            magnetic_field=frame.magnetic_field[order],
            status=frame.status[order],
            gap_ns=frame.gap_ns[order],
        )
        for frame in frames
    ]


def solved(frames, suit, interval_s=0.01):
    """The reconstructor after the frames, and their poses."""
    reconstructor = create_reconstructor("joint", suit, interval_s)
    return reconstructor, reconstructor.update_many(frames)


def doubtful(poses, suit):
    """Names of segments that were ever doubtful."""
    ever = np.any([pose.status == Status.DOUBTFUL for pose in poses], axis=0)
    return {suit.skeleton.segment_names[s] for s in np.flatnonzero(ever)}


def test_modules_worn_right_are_never_doubted(suit, walk):
    reconstructor, poses = solved(walk, suit)
    assert doubtful(poses, suit) == set()
    assert reconstructor.doubts() == {}


@pytest.mark.parametrize("segment", ["left_shank", "right_thigh"])
def test_a_module_upside_down_is_told(suit, walk, segment):
    reconstructor, poses = solved(upside_down(walk, suit, segment), suit)
    last, s = poses[-1], suit.skeleton.index(segment)
    assert last.status[s] == Status.DOUBTFUL
    assert last.sigma[s] == UNKNOWN
    assert doubtful(poses, suit) == {segment}
    ((module, reason),) = reconstructor.doubts().items()
    assert module == suit.module_ids[suit.module_of_segment[s]]
    assert "turned by 180°" in reason
    assert "worn as the rig says" in reason


@pytest.mark.parametrize(
    "segments", [("left_shank", "left_thigh"), ("left_shank", "right_shank"), ("left_foot", "right_foot")]
)
def test_exchanged_modules_are_told(suit, walk, segments):
    reconstructor, poses = solved(exchanged(walk, suit, *segments), suit)
    at = [suit.skeleton.index(segment) for segment in segments]
    assert (poses[-1].status[at] == Status.DOUBTFUL).all()
    assert (poses[-1].sigma[at] == UNKNOWN).all()
    reasons = reconstructor.doubts()
    assert set(reasons) == {suit.module_ids[suit.module_of_segment[s]] for s in at}
    assert all("changed places" in reason for reason in reasons.values())


def test_a_doubt_goes_when_the_module_is_put_right_and_stays_while_nothing_moves(suit, walk):
    """The reconstructor goes on with frames of a module worn right: orientations known to both."""
    reconstructor, _ = solved(upside_down(walk, suit, "left_shank"), suit)
    end_ns, rest = walk[-1].time_ns, walk[100]
    still = [replace(rest, sequence=k, time_ns=end_ns + (k + 1) * 10_000_000) for k in range(1500)]
    noise = np.random.default_rng(1).normal(0.0, 0.01, (1500, *rest.specific_force.shape))
    still = [replace(frame, specific_force=frame.specific_force + noise[k]) for k, frame in enumerate(still)]
    reconstructor.update_many(upside_down(still, suit, "left_shank"))
    assert len(reconstructor.doubts()) == 1
    begin_ns = still[-1].time_ns - walk[200].time_ns
    moving = [replace(frame, time_ns=frame.time_ns + begin_ns) for frame in walk[201:]]
    reconstructor.update_many(moving)
    begin_ns += moving[-1].time_ns - begin_ns - walk[200].time_ns
    reconstructor.update_many([replace(frame, time_ns=frame.time_ns + begin_ns) for frame in walk[400:]])
    assert reconstructor.doubts() == {}


@pytest.mark.parametrize("kind", ["rigid", "nonrigid"])
def test_no_false_alarm_on_a_real_chain(recording_set, kind):
    recording, chain = read_ring_chain5(recording_set("ring_chain5") / "trial1", kind), load_rig("chain_5")
    _, poses = solved(imu_frames(recording, chain), chain, 1.0 / recording.sampling_rate_hz)
    assert doubtful(poses, chain) == set()


def test_no_false_alarm_on_a_real_pendulum(recording_set):
    recording, rig = read_repoimu_pendulum(recording_set("repoimu_pendulum")), load_rig("pendulum_3")
    _, poses = solved(imu_frames(recording, rig), rig, 1.0 / recording.sampling_rate_hz)
    assert doubtful(poses, rig) == set()


@pytest.mark.parametrize(
    "worn_wrong",
    [
        lambda frames, suit: upside_down(frames, suit, "left_shank"),
        lambda frames, suit: exchanged(frames, suit, "left_shank", "right_thigh"),
    ],
    ids=["turned", "exchanged"],
)
def test_the_best_explanation_is_that_of_trying_all_one_by_one(suit, walk, worn_wrong):
    reconstructor, _ = solved(worn_wrong(walk, suit)[:900], suit)
    memory, rig = reconstructor._memory, reconstructor._mounting
    measured = mounting.JointProducts(reconstructor._joints.sides, memory.agreement.pairs)
    judgement = mounting._Judgement(measured, rig, memory.mounting)
    best = Found(0.0, mounting.NOBODY, mounting.NOBODY, 0)
    for s, o in itertools.combinations_with_replacement(np.flatnonzero(rig.is_known).tolist(), 2):
        for turn in range(len(rig.turns) if s == o else 1):
            other = Arrangement(judgement._now.place.copy(), judgement._now.turn.copy())
            mounting._apply(rig, other, Found(0.0, s, o, turn))
            gain = judgement._gain(other, s, o)
            if gain > best.gain:
                best = Found(gain, s, o, turn)
    found = judgement.best()
    assert found.gain == pytest.approx(best.gain, rel=1e-9)
    assert found[1:] == best[1:]
    assert found.gain > mounting.GAIN
