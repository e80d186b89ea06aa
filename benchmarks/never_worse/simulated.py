"""Kinds of motion that are known to be hard, drawn from seeds, with exact truth.

Each is a set-up that recordings of other people have shown to lose against VQF, rebuilt from its
description.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.random import Generator
from scipy.spatial.transform import Rotation

from benchmarks.never_worse.case import Case
from devices.emulators.motion.motions import BodyMotion, generic_motion, pendulum_motion
from devices.emulators.motion.waves import Fade, Waves
from gateway.body.rig import load_rig
from gateway.body.skeleton import LocalDevice, Skeleton, WornSuit, field_vector
from gateway.emulation.fast_arm import (
    POSITION_DEVICE,
    Switches,
    carried_arm,
    carried_motion,
    fast_arm,
    fast_motion,
    sampled,
)
from gateway.emulation.random_chains import drawn
from gateway.emulation.rig import dress
from gateway.emulation.simulation import ALREADY_MOVING
from gateway.frames import FloatArray, ImuFrame, Quantity

SECONDS = 30.0
RING_HZ = 40.0
RING_HINGES = {2: (1.0, 0.0, 0.0), 3: (0.0, 1.0, 0.0), 4: (0.0, 0.0, 1.0)}
"""Joints of the ring's chain that turn about one axis of the segment."""
GYROSCOPE_LIMIT = float(np.radians(422.0))
"""rad/s at which those of the T-stick are clipped, far below what is taken for the end of their range."""
_DISTURBANCE_MEMORY_S = 8.0


def fast_arm_case(seed: int) -> Case:
    """The simulated fast arm on a fixed base."""
    suit = fast_arm()
    return _case("fast_arm", seed, suit, fast_motion(suit, seed), Switches(), 100.0)


def carried_arm_case(seed: int) -> Case:
    """The same arm, its base carried about."""
    suit = carried_arm()
    return _case("carried_arm", seed, suit, carried_motion(suit, seed), Switches(), 100.0)


def random_chain_case(seed: int) -> Case:
    """A chain of the suite ``chains``."""
    chain = drawn(seed)
    return _case("random_chain", seed, chain.suit, chain.motion, chain.switches, chain.rate_hz)


def ring_moving_case(seed: int) -> Case:
    """The same, swung from the first sample on, and never on a table."""
    return ring_like_case(seed, is_moving=True)


def ring_like_case(seed: int, is_moving: bool = False) -> Case:
    """Five segments, two joints about all axes and three hinges, carried about by hand at 40 Hz.

    They lie on a metal table for five seconds; the field of the room is bent by iron that they move past, and
    wanders. One in two has modules on soft tissue.
    """
    kind = "ring_moving" if is_moving else "ring_like"
    rng = np.random.default_rng([seed, 31])
    suit = replace(load_rig("chain_5"), magnetic_field=field_vector(50.0, 65.0))
    shape = (5, 3, 2)
    amplitude = rng.uniform(0.15, 0.5, shape)
    for segment, axis in RING_HINGES.items():
        amplitude[segment] *= np.array(axis)[:, None]
    angles = Waves(amplitude, rng.uniform(0.2, 0.8, shape), rng.uniform(0.0, 2.0 * np.pi, shape))
    shape = (1, 3, 2)
    path = Waves(np.full(shape, 0.1), rng.uniform(0.2, 0.7, shape), rng.uniform(0.0, 2.0 * np.pi, shape))
    fade = ALREADY_MOVING if is_moving else Fade(rest_s=5.0, ramp_s=1.0)
    motion = BodyMotion(dress(suit), angles, path, fade)
    suit = replace(suit, module_ids=tuple(range(5)))
    case = _case(kind, seed, suit, motion, Switches(has_wobble=seed % 2 == 0), RING_HZ, seconds=45.0)
    frames = _disturbed(case.frames, suit, motion, rng, table_s=0.0 if is_moving else 5.0)
    return replace(case, frames=frames, hinges=RING_HINGES)


def triple_pendulum_case(seed: int) -> Case:
    """Three links on a fixed pivot, nearly planar, 12 s at 50 Hz from mid-swing, in a bent field."""
    rng = np.random.default_rng([seed, 32])
    suit = _links(3, 0.3, (LocalDevice(Quantity.FIXED_POINT, 0, np.zeros(3)),))
    motion = pendulum_motion(dress(suit), seed, ALREADY_MOVING)
    case = _case("triple_pendulum", seed, suit, motion, Switches(), 50.0, seconds=12.0)
    frames = _disturbed(case.frames, suit, motion, rng)
    return replace(case, frames=frames, is_spatial=False)


def slow_arm_case(seed: int) -> Case:
    """Two links that turn slowly in one plane from the first sample on; no field, and nothing aids them."""
    rng = np.random.default_rng([seed, 33])
    suit = _links(2, 0.4, ())
    shape = (2, 3, 2)
    amplitude = np.zeros(shape)
    amplitude[:, 1] = rng.uniform(0.3, 0.7, (2, 2))
    angles = Waves(amplitude, rng.uniform(0.05, 0.25, shape), rng.uniform(0.0, 2.0 * np.pi, shape))
    motion = BodyMotion(dress(suit), angles, fade=ALREADY_MOVING)
    case = _case("slow_arm", seed, suit, motion, Switches(), 100.0)
    frames = [replace(f, magnetic_field=np.full_like(f.magnetic_field, np.nan)) for f in case.frames]
    return replace(case, frames=frames, is_spatial=False)


def slow_soft_case(seed: int) -> Case:
    """Four to six links on a fixed point that move slowly, modules on soft tissue, 200 Hz."""
    rng = np.random.default_rng([seed, 34])
    suit = _links(int(rng.integers(4, 7)), 0.3, (LocalDevice(Quantity.FIXED_POINT, 0, np.zeros(3)),))
    peak = float(rng.uniform(2.0, 3.5))
    fade = None if rng.random() < 0.5 else ALREADY_MOVING
    motion = generic_motion(
        dress(suit), seed, peak_angular_rate=peak, peak_angular_acceleration=6.0 * peak, fade=fade
    )
    return _case("slow_soft", seed, suit, motion, Switches(lever_arm_m=0.02, has_wobble=True), 200.0)


def long_rest_case(seed: int) -> Case:
    """One module that lies still for 36 s and is then turned slowly for 40 s, its position known to 1 mm.

    The field of the room is off by some degrees and wanders.
    """
    rng = np.random.default_rng([seed, 35])
    suit = _links(1, 0.2, (LocalDevice(Quantity.POSITION, 0, np.zeros(3), POSITION_DEVICE),))
    shape, path_shape = (1, 3, 3), (1, 3, 2)
    angles = Waves(rng.uniform(0.15, 0.4, shape), rng.uniform(0.1, 0.3, shape), rng.uniform(0.0, 6.3, shape))
    frequency, phase = rng.uniform(0.1, 0.5, path_shape), rng.uniform(0.0, 6.3, path_shape)
    path = Waves(np.full(path_shape, 0.1), frequency, phase)
    motion = BodyMotion(dress(suit), angles, path, Fade(rest_s=36.0, ramp_s=2.0))
    case = _case("long_rest", seed, suit, motion, Switches(), 100.0, seconds=76.0)
    frames = _disturbed(case.frames, suit, motion, rng)
    return replace(case, frames=frames)


def clipped_case(seed: int) -> Case:
    """One module whose gyroscope is clipped flat at 422 °/s, which it does not tell, while swung faster."""
    rng = np.random.default_rng([seed, 36])
    suit = _links(1, 0.2, ())
    peak = float(rng.uniform(11.0, 14.0))
    motion = generic_motion(
        dress(suit), seed, peak_angular_rate=peak, peak_angular_acceleration=6.0 * peak, root_travel_m=0.1
    )
    case = _case("clipped", seed, suit, motion, Switches(), 100.0)
    frames = [
        replace(f, angular_rate=np.clip(f.angular_rate, -GYROSCOPE_LIMIT, GYROSCOPE_LIMIT))
        for f in case.frames
    ]
    return replace(case, frames=frames)


KINDS: dict[str, Callable[[int], Case]] = {
    "fast_arm": fast_arm_case,
    "carried_arm": carried_arm_case,
    "random_chain": random_chain_case,
    "ring_like": ring_like_case,
    "ring_moving": ring_moving_case,
    "triple_pendulum": triple_pendulum_case,
    "slow_arm": slow_arm_case,
    "slow_soft": slow_soft_case,
    "long_rest": long_rest_case,
    "clipped": clipped_case,
}
"""Name in the split to the case of a seed."""


def _case(
    kind: str,
    seed: int,
    suit: WornSuit,
    motion: BodyMotion,
    switches: Switches,
    rate_hz: float,
    seconds: float = SECONDS,
) -> Case:
    frames = sampled(suit, motion, switches, seed, rate_hz, seconds)
    times = np.array([frame.time_ns for frame in frames]) * 1e-9
    truth, later = (motion.state(times + shift).q_wb for shift in (0.0, 0.5 / rate_hz))
    return Case(f"{kind}_{seed}", kind, suit, 1.0 / rate_hz, frames, truth, later, is_world_known=True)


def _links(n: int, length: float, devices: tuple[LocalDevice, ...]) -> WornSuit:
    """n links in a row, a module beside the middle of each, a field that dips by 65°."""
    offsets, tips, lever_arms = np.zeros((n, 3)), np.zeros((n, 3)), np.zeros((n, 3))
    offsets[1:, 2], tips[:, 2] = length, length
    lever_arms[:, 0], lever_arms[:, 2] = 0.03, 0.5 * length
    return WornSuit(
        skeleton=Skeleton("links", tuple(f"link_{i + 1}" for i in range(n)), np.arange(n) - 1, offsets, tips),
        module_ids=tuple(range(n)),
        module_of_segment=np.arange(n),
        sensor_to_segment=np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)),
        lever_arms=lever_arms,
        local_devices=devices,
        gravity=np.array([0.0, 0.0, -9.81]),
        magnetic_field=field_vector(50.0, 65.0),
    )


def _disturbed(
    frames: list[ImuFrame], suit: WornSuit, motion: BodyMotion, rng: Generator, table_s: float = 0.0
) -> list[ImuFrame]:
    """The frames in the field of a building: iron at three places, and what wanders along the chain.

    table_s: until when they also lie on a metal table, whose field differs from module to module.
    """
    times = np.array([frame.time_ns for frame in frames]) * 1e-9
    state = motion.state(times)
    place = state.joint_position + np.einsum("tsij,sj->tsi", state.R_wb, suit.lever_arms)
    extra = iron(place, rng, place.reshape(-1, 3).mean(axis=0))
    extra += _wandering(len(times), place.shape[1], float(times[1] - times[0]), rng)
    on_table = np.where(times < table_s, 1.0, np.exp(-np.maximum(times - table_s, 0.0) / 0.5))
    if table_s:
        extra += on_table[:, None, None] * rng.normal(0.0, 15.0, place.shape[1:])
    return added(frames, np.einsum("tsji,tsj->tsi", state.R_wb, extra))


def iron(place: FloatArray, rng: Generator, centre: FloatArray) -> FloatArray:
    """Field at places (..., 3) of three dipoles between 1 and 2 m from a centre, µT."""
    extra = np.zeros_like(place)
    for _ in range(3):
        way = rng.standard_normal(3)
        away = place - (centre + rng.uniform(1.0, 2.0) * way / np.linalg.norm(way))
        distance = np.maximum(np.linalg.norm(away, axis=-1, keepdims=True), 0.3)
        unit, moment = away / distance, rng.normal(0.0, 12.0, 3)
        extra += (3.0 * unit * (unit @ moment)[..., None] - moment) / distance**3
    return extra


def added(frames: list[ImuFrame], extra: FloatArray) -> list[ImuFrame]:
    """The frames with (T, S, 3) µT more in each module's field, axes of the modules."""
    return [replace(f, magnetic_field=f.magnetic_field + e) for f, e in zip(frames, extra, strict=True)]


def _wandering(n_frames: int, n: int, dt: float, rng: Generator) -> FloatArray:
    """(T, n, 3) Gauss–Markov, 3 µT, world axes; what neighbours feel is alike."""
    along = 0.7 ** np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    root = np.linalg.cholesky(along)
    keep = np.exp(-dt / _DISTURBANCE_MEMORY_S)
    value = root @ rng.normal(0.0, 3.0, (n, 3))
    values = []
    for _ in range(n_frames):
        values.append(value)
        value = keep * value + np.sqrt(1.0 - keep**2) * (root @ rng.normal(0.0, 3.0, (n, 3)))
    return np.array(values)


def turned(q: FloatArray, vectors: FloatArray) -> FloatArray:
    """World vectors (N, 3) in the axes of orientations (N, 4); NaN orientations give zeros."""
    known = np.isfinite(q).all(axis=1)
    result = np.zeros_like(vectors)
    result[known] = Rotation.from_quat(q[known], scalar_first=True).apply(vectors[known], inverse=True)
    return result
