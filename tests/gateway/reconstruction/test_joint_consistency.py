"""Whether ``joint`` knows how wrong it is: its errors over random chains, held against its covariances."""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from devices.emulators.motion.kinematics_truth import MotionState
from devices.emulators.motion.motions import BodyMotion
from devices.emulators.motion.waves import Fade, Waves
from devices.emulators.sensing.ideal_sensors import sense
from gateway.body.skeleton import LocalDevice, Skeleton, WornSuit, field_vector
from gateway.emulation.rig import dress
from gateway.frames import FloatArray, ImuFrame, LocalReading, Quantity
from gateway.reconstruction.inertial.tree.reconstructor import JointReconstructor

CHAINS = 48
RATE_HZ = 100
SECONDS = 7.0
JUDGED_AT_S = (4.0, 5.5, 7.0)
DEVICE = 60
HELD_BY = ("fixed point", "position device", "nothing")
TWO_SIGMA = 1.96
"""Standard deviations within which 95 % of normal errors lie."""
LEAST_COVERAGE, MOST_COVERAGE = 0.93, 0.97
"""95 %, give or take two standard deviations of what so many chains show: 48 of about 3.5 segments with three
components, of which those of one chain go together (measured: 0.06 a chain, 0.01 of the mean)."""
LEAST_NEES, MOST_NEES = (chi2.ppf(share, 3 * CHAINS) / CHAINS for share in (0.025, 0.975))
"""Mean normalised estimation error squared of three components, were each chain a single orientation: what
else a chain tells goes together with that."""


class Judged(NamedTuple):
    """Errors of one chain's orientations at the instants ``JUDGED_AT_S``."""

    whitened: FloatArray
    """(instants, segments, 3) errors in units of their standard deviations: normal, if the claim is true."""
    is_known: FloatArray
    """(instants, segments) whether the heading has been shown: else errors are no small angles."""


@cache
def whitened() -> FloatArray:
    """(k, 3) of all chains, segments and instants at which the heading has been shown."""
    every = [_judged(seed) for seed in range(CHAINS)]
    assert np.mean(np.concatenate([one.is_known.ravel() for one in every])) > 0.9
    return np.concatenate([one.whitened[one.is_known] for one in every])


def coverage() -> float:
    """The share of components within two standard deviations."""
    return float(np.mean(np.abs(whitened()) < TWO_SIGMA))


def mean_nees() -> float:
    """Of three components: 3 where the covariances are true."""
    return float(np.mean(np.sum(whitened() ** 2, axis=1)))


def test_joint_is_not_overconfident() -> None:
    assert coverage() >= LEAST_COVERAGE
    assert mean_nees() <= MOST_NEES


@pytest.mark.xfail(
    strict=True, raises=AssertionError, reason="covariances are several times too large: coverage is 99 %"
)
def test_joint_does_not_claim_to_know_less_than_it_does() -> None:
    assert coverage() <= MOST_COVERAGE
    assert mean_nees() >= LEAST_NEES


def _judged(seed: int) -> Judged:
    rng = np.random.default_rng([seed, 5])
    suit = _chain(rng, HELD_BY[seed % 3])
    motion = _motion(suit, rng, 0.0 if HELD_BY[seed % 3] == "fixed point" else 0.1)
    times = np.arange(round(SECONDS * RATE_HZ) + 1) / RATE_HZ
    state = motion.state(times)
    frames = _frames(suit, state, times, rng)
    covariance = np.empty((len(times), suit.skeleton.n_segments, 2, 3, 3))
    poses = JointReconstructor(suit, 1.0 / RATE_HZ).update_many(frames, None, covariance)
    at = [round(time_s * RATE_HZ) for time_s in JUDGED_AT_S]
    found = Rotation.from_quat(np.concatenate([poses[k].q_wb for k in at]), scalar_first=True)
    true = Rotation.from_matrix(state.R_wb[at].reshape(-1, 3, 3))
    error = (found * true.inv()).as_rotvec().reshape(len(at), -1, 3)  # world axes
    whitened = np.linalg.solve(np.linalg.cholesky(covariance[at, :, 1]), error[..., None])[..., 0]
    sigma = np.stack([poses[k].sigma for k in at])
    return Judged(whitened, sigma < 1.0)


def _frames(
    suit: WornSuit, state: MotionState, times: FloatArray, rng: np.random.Generator
) -> list[ImuFrame]:
    """What imperfect modules on the segments, a centimetre beside their places, make of the motion."""
    n = suit.skeleton.n_segments
    arms = suit.lever_arms + 0.01 * rng.standard_normal((n, 3))
    values = sense(state, arms, np.tile(np.eye(3), (n, 1, 1)), suit.gravity, suit.magnetic_field)
    force = _measured(values.specific_force, rng, 0.03, 0.05, 0.0)
    rate = _measured(values.angular_rate, rng, np.radians(0.1), np.radians(0.3), np.radians(0.005))
    field = _measured(values.magnetic_field, rng, 0.5, 0.0, 0.0)
    none = np.zeros(n, np.int64)
    frames = []
    for k in range(len(times)):
        time_ns = round(times[k] * 1e9)
        local: tuple[LocalReading, ...] = ()
        for device in suit.local_devices:
            if device.quantity is Quantity.POSITION:
                s = device.segment
                place = state.joint_position[k, s] + state.R_wb[k, s] @ device.position
                place += 0.003 * rng.standard_normal(3)
                local = (LocalReading(DEVICE, time_ns, device.quantity, place, np.full(3, 0.003)),)
        frames.append(ImuFrame(k, time_ns, force[k], rate[k], field[k], none.astype(np.uint8), none, local))
    return frames


def _motion(suit: WornSuit, rng: np.random.Generator, travel_m: float) -> BodyMotion:
    """All joints about all axes and the base along all, slow or fast, after a second of rest."""
    tempo = float(np.exp(rng.uniform(np.log(0.5), np.log(2.0))))

    def waves(rows: int, largest: float) -> Waves:
        shape = (rows, 3, 2)
        frequency, phase = tempo * rng.uniform(0.3, 1.2, shape), rng.uniform(0.0, 2.0 * np.pi, shape)
        return Waves(rng.uniform(0.2, 1.0, shape) * largest, frequency, phase)

    fade = Fade(rest_s=1.0, ramp_s=1.0)
    return BodyMotion(dress(suit), waves(suit.skeleton.n_segments, 0.5), waves(1, travel_m), fade)


def _measured(
    true: FloatArray, rng: np.random.Generator, noise: float, bias: float, walk: float
) -> FloatArray:
    shape = true.shape
    drift = walk / np.sqrt(RATE_HZ) * np.cumsum(rng.standard_normal(shape), axis=0)
    scale = 1.0 + 0.002 * rng.standard_normal(shape[1:])
    read: FloatArray = true * scale + bias * rng.standard_normal(shape[1:]) + drift
    return read + noise * rng.standard_normal(shape)


def _chain(rng: np.random.Generator, held_by: str) -> WornSuit:
    n = int(rng.integers(2, 6))
    parents = np.array([-1, *(i - 1 if rng.random() < 0.7 else int(rng.integers(0, i)) for i in range(1, n))])
    lengths = rng.uniform(0.1, 0.5, n)
    offsets, tips, lever_arms = np.zeros((n, 3)), np.zeros((n, 3)), np.zeros((n, 3))
    tips[:, 2], offsets[1:, 2] = lengths, lengths[parents[1:]]
    lever_arms[:, :2] = rng.uniform(-0.05, 0.05, (n, 2))
    lever_arms[:, 2] = lengths * rng.uniform(0.2, 0.8, n)
    devices: tuple[LocalDevice, ...] = ()
    if held_by == "fixed point":
        devices = (LocalDevice(Quantity.FIXED_POINT, 0, np.zeros(3)),)
    elif held_by == "position device":
        devices = (
            LocalDevice(Quantity.POSITION, int(rng.integers(0, n)), np.array([0.0, 0.0, 0.1]), DEVICE),
        )
    return WornSuit(
        skeleton=Skeleton("chain", tuple(f"link_{i}" for i in range(n)), parents, offsets, tips),
        module_ids=tuple(range(n)),
        module_of_segment=np.arange(n),
        sensor_to_segment=np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)),
        lever_arms=lever_arms,
        local_devices=devices,
        gravity=np.array([0.0, 0.0, -9.81]),
        magnetic_field=field_vector(50.0, float(rng.uniform(0.0, 70.0))),
    )
