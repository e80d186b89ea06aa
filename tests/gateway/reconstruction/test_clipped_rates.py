"""What a gyroscope misses at the end of its range is made up for, and claimed while it is not."""

import itertools
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gateway.body.rig import load_rig
from gateway.frames import Clipped, ImuFrame
from gateway.reconstruction.inertial.independent import IndependentReconstructor
from gateway.reconstruction.inertial.tree.reconstructor import ChainSettings, JointReconstructor

RATE_HZ, PEAK = 100, 12.0
"""Of samples and of the swing, rad/s."""


def swinging(axis, hertz, limit):
    """A module that swings about a vertical axis (3,), module axes, and its headings, rad: every half swing
    goes on to the same side."""
    times = np.arange(-RATE_HZ, 4 * RATE_HZ) / RATE_HZ
    phase = 2.0 * np.pi * hertz * np.maximum(times, 0.0)
    rate = PEAK * 0.5 * (1.0 - np.cos(phase))[:, None] * axis
    heading = PEAK * 0.5 * (np.maximum(times, 0.0) - np.sin(phase) / (2.0 * np.pi * hertz))
    shown = np.clip(rate, -limit, limit)
    frames = [
        ImuFrame(
            sequence=k, time_ns=10**10 + 10**7 * k, specific_force=9.81 * axis[None], angular_rate=shown[[k]],
            magnetic_field=np.full((1, 3), np.nan), status=np.zeros(1, np.uint8),
            gap_ns=np.zeros(1, np.int64),
            clipped=np.array([Clipped.ANGULAR_RATE if (shown[k] != rate[k]).any() else 0], np.uint8),
        )
        for k in range(len(times))
    ]  # fmt: skip
    return frames, heading


WITHOUT_FIELD = partial(JointReconstructor, settings=ChainSettings(uses_field=False))


def solved(frames, method=WITHOUT_FIELD):
    """Headings turned by since the first frame, and standard deviations, rad (T,) each."""
    suit = load_rig("single_placed")
    suit = replace(suit, local_devices=(), sensor_to_segment=np.array([[1.0, 0.0, 0.0, 0.0]]))
    reconstructor = method(suit, 1.0 / RATE_HZ)
    poses = [reconstructor.update(frame) for frame in frames]
    turns = Rotation.from_quat(np.stack([pose.q_wb[0] for pose in poses]), scalar_first=True)
    steps = np.array([0.0, *(turns[1:] * turns[:-1].inv()).as_rotvec()[:, 2]])
    return np.cumsum(steps), np.array([pose.sigma[0] for pose in poses])


@pytest.mark.parametrize("side", [-1.0, 1.0])
@pytest.mark.parametrize("axis", np.eye(3))
@pytest.mark.parametrize("cut", [0.6, 0.75, 0.9])
def test_a_peak_that_is_cut_is_made_up_for(axis, side, cut):
    """As far as the cubic through values and slopes where a cosine is cut has its area, in closed form."""
    frames, heading = swinging(axis, 1.5, cut * PEAK)
    frames = [replace(frame, angular_rate=side * frame.angular_rate) for frame in frames]
    missed = heading[-1] - np.trapezoid([abs(frame.angular_rate).max() for frame in frames], dx=1.0 / RATE_HZ)
    half = np.arccos(2.0 * cut - 1.0)  # of the stretch, as an angle
    share = half**2 * np.sin(half) / 3.0 / (np.sin(half) - half * np.cos(half))
    found, _ = solved(frames)
    assert missed > 0.1
    assert side * found[-1] == pytest.approx(heading[-1] - (1.0 - share) * missed, abs=0.08 * missed)


@pytest.mark.parametrize("cut", [0.85, 0.92])
def test_a_module_for_itself_makes_up_for_as_much(cut):
    frames, _ = swinging(np.array([0.0, 0.0, 1.0]), 1.5, cut * PEAK)
    headings = [solved(frames, method)[0][-1] for method in (IndependentReconstructor, JointReconstructor)]
    bare = [replace(frame, clipped=None) for frame in frames]
    without = solved(bare, IndependentReconstructor)[0][-1]
    assert headings[1] - without > 0.1
    assert headings[0] - without == pytest.approx(headings[1] - without, rel=0.1)


def test_axes_come_to_their_ends_and_back_one_by_one():
    """A turn about one axis is cut until another about the next one is, and no instant between is whole."""
    times = np.arange(0, 2 * RATE_HZ) / RATE_HZ
    rate = np.stack(
        [PEAK * np.exp(-(((times - middle) / 0.25) ** 2)) for middle in (0.8, 1.05)] + [0.0 * times], axis=1
    )
    q, truth = Rotation.identity(), []
    for before, after in itertools.pairwise(rate):
        truth.append(q)
        q = q * Rotation.from_rotvec(0.5 * (before + after) / RATE_HZ + np.cross(before, after) / 12e4)
    shown = np.minimum(rate, 0.7 * PEAK)
    ends = (shown < rate).any(axis=1)
    assert np.count_nonzero(np.diff(ends.astype(int))) == 2
    errors = []
    for given in (rate, shown):
        suit = load_rig("single_placed")
        suit = replace(suit, local_devices=(), sensor_to_segment=np.array([[1.0, 0.0, 0.0, 0.0]]))
        reconstructor = WITHOUT_FIELD(suit, 1.0 / RATE_HZ)
        for k, turned in enumerate(truth):
            pose = reconstructor.update(
                ImuFrame(
                    sequence=k, time_ns=10**10 + 10**7 * k, angular_rate=given[[k]],
                    specific_force=turned.inv().apply([[0.0, 0.0, 9.81]]),
                    magnetic_field=np.full((1, 3), np.nan), status=np.zeros(1, np.uint8),
                    gap_ns=np.zeros(1, np.int64),
                    clipped=np.array([Clipped.ANGULAR_RATE if given is shown and ends[k] else 0], np.uint8),
                )
            )  # fmt: skip
        errors.append(Rotation.from_quat(pose.q_wb[0], scalar_first=True))
    missed = np.trapezoid(np.linalg.norm(rate - shown, axis=1), dx=1.0 / RATE_HZ)
    assert missed > 0.8
    assert (errors[0].inv() * errors[1]).magnitude() < 0.15 * missed


def test_what_is_missed_is_claimed_at_once_and_given_back_when_it_is_made_up_for():
    frames, heading = swinging(np.array([0.0, 0.0, 1.0]), 1.0, 0.75 * PEAK)
    found, sigma = solved(frames)
    clipped = np.flatnonzero([frame.clipped[0] for frame in frames])
    first = clipped[: np.argmax(np.diff(clipped) > 1) + 1]
    error, before = np.abs(found - heading), sigma[first[0] - 1]
    assert error[first].max() > 0.2
    grown = np.sqrt(np.maximum(sigma[first] ** 2 - before**2, 0.0))
    assert (error[first] <= 2.0 * grown + 0.02).all()
    after = first[-1] + 3
    assert error[after] < 0.15 * error[first].max()
    assert sigma[after] ** 2 - before**2 < 0.1 * grown.max() ** 2


def test_a_gyroscope_that_stays_at_its_end_is_not_made_up_for():
    frames, _ = swinging(np.array([0.0, 0.0, 1.0]), 0.8, 0.4 * PEAK)
    clipped = np.flatnonzero([frame.clipped[0] for frame in frames])
    found, sigma = solved(frames)
    shown = np.cumsum([frame.angular_rate[0, 2] for frame in frames]) / RATE_HZ
    assert len(clipped) > 0.4 * RATE_HZ
    assert abs(found[-1] - shown[-1]) < 0.2
    assert sigma[clipped[-1]] > 1.0
