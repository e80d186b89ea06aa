"""Seeded motions of an articulated body with exact derivatives; any instant can be asked for.

``BodyMotion.state(t)`` gives the whole body; ``BodyMotion.module_state`` gives every module's
segment at that module's own instants. The kinds of motion are the functions below it: each chooses
the waves of the joint angles and of the root's path.

Joint angles of a walking-like motion come first, as data. ISB axes (x anterior, y up, z right). About z a
positive angle moves what hangs down forward: flexion of hip, shoulder and elbow and dorsiflexion are
positive, flexion of knee and trunk negative. Harmonics are of the stride (two steps); the right leg swings
with phase 0, the left with phase π. Amplitudes stay within a quiet walker's ranges.
"""

from __future__ import annotations

from collections.abc import Callable
from math import pi, radians

import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike

from devices.deferred import Rotation
from devices.emulators.bodies import NO_PARENT, EmulatedBody, FloatArray, IntArray
from devices.emulators.motion.everyday import Lap, planned_lap
from devices.emulators.motion.gait import WALK, Gait, planned_motion
from devices.emulators.motion.kinematics_truth import JointAngles, MotionState, RootPath, TreeKinematics
from devices.emulators.motion.legs import has_legs
from devices.emulators.motion.stride import STRIDE
from devices.emulators.motion.waves import Fade, Waves, waves

Term = tuple[int, float, int, float]
"""Axis (0 x, 1 y, 2 z), amplitude in rad, harmonic of the stride or 0 for a mean, phase in rad."""

_MEAN = pi / 2  # of a term of harmonic 0: sin(π/2)


def _turn(axis: int, degrees: float, harmonic: int, phase: float = 0.0) -> Term:
    return (axis, radians(degrees), harmonic, phase)


_LEG: dict[str, list[Term]] = {
    "thigh": [
        _turn(2, 12, 0, _MEAN),
        _turn(2, 20, 1),
        _turn(2, 3, 2, 0.9),
        _turn(0, 4, 1, 0.5),
        _turn(1, 5, 1, 1.1),
    ],
    "shank": [_turn(2, -26, 0, _MEAN), _turn(2, 20, 1, 0.9), _turn(2, 12, 2, 2.2), _turn(1, 4, 1, 0.3)],
    "foot": [_turn(2, 3, 0, _MEAN), _turn(2, 10, 1, 2.4), _turn(2, 6, 2, 0.4), _turn(0, 4, 1, 1.7)],
    "toes": [_turn(2, 8, 0, _MEAN), _turn(2, 8, 1, 2.9)],
}
_ARM: dict[str, list[Term]] = {
    "shoulder_girdle": [_turn(1, 4, 1, 0.2), _turn(0, 3, 2, 0.6)],
    "upper_arm": [_turn(2, 18, 1), _turn(0, 4, 2, 0.3), _turn(1, 6, 1, 0.8), _turn(2, 4, 0, _MEAN)],
    "forearm": [_turn(2, 28, 0, _MEAN), _turn(2, 14, 1, -0.4), _turn(1, 15, 1, 0.7)],
    "hand": [_turn(2, 6, 1, 0.9), _turn(0, 5, 2, 1.2), _turn(2, 5, 0, _MEAN)],
}
_TRUNK: dict[str, list[Term]] = {
    "pelvis": [_turn(2, -3, 0, _MEAN), _turn(2, 2, 2, 0.3), _turn(0, 4, 1, 1.4), _turn(1, 6, 1, 0.1)],
    "lumbar": [_turn(1, 3, 1, 3.2), _turn(0, 3, 1, 4.4)],
    "thorax": [_turn(2, -3, 0, _MEAN), _turn(1, 9, 1, 3.3), _turn(0, 4, 1, 4.5), _turn(2, 2, 2, 1.0)],
    "neck": [_turn(1, 2, 1, 0.4)],
    "head": [_turn(2, 3, 2, 2.0), _turn(1, 4, 1, 0.2), _turn(0, 2, 1, 0.7)],
}
_OTHER: list[Term] = [_turn(2, 2, 1, 0.5), _turn(0, 1, 2, 1.5)]

WALKING_ROOT: list[tuple[int, float, float, float]] = [
    (0, 1.2, 0.09, 0.0),  # to and fro along the heading, 0.6 m/s at most
    (0, 0.02, 2, 0.8),  # speed varies within each step
    (1, 0.025, 2, 2.3),  # bobs with every step
    (2, 0.025, 1, 0.6),  # sways with every stride
]
"""Axis of the root segment, amplitude in m, frequency as a multiple of the stride's, phase in rad."""


def walking_terms(segment: str) -> list[Term]:
    """Return the terms of a segment's rotation against its parent, in its own axes."""
    side, _, part = segment.partition("_")
    if side not in ("left", "right"):
        return _TRUNK.get(segment, _OTHER)
    terms = {**_LEG, **_ARM}.get(part, _OTHER)
    # Arms swing against the leg of their side.
    is_late = (side == "left") != (part in _ARM)
    delay = pi if is_late else 0.0
    # What is not flexion is mirrored at the sagittal plane.
    mirrored = (1.0, 1.0, 1.0) if side == "right" else (-1.0, -1.0, 1.0)
    return [
        (axis, amplitude * mirrored[axis], harmonic, phase + delay * harmonic)
        for axis, amplitude, harmonic, phase in terms
    ]


ISB_ORDER = (2, 0, 1)
"""Rotations about z, x', y'': flexion, adduction, axial rotation of ISB axes."""

_FITTING_SPAN_S = 25.0
_FITTING_ROUNDS = 8


class BodyMotion:
    """A body with its motion. World ENU, SI; times in seconds, motion time 0 is the start of the rest."""

    def __init__(
        self,
        body: EmulatedBody,
        joint_angles: JointAngles,
        root_path: RootPath | None = None,
        fade: Fade | None = None,
    ) -> None:
        """Move a body.

        joint_angles: S rows, rotations of each segment against its parent about x, y, z of its own axes, rad.
        root_path: one row, the root's joint in the world, m. Default: it stays at the origin.
        fade: how long the body rests in its reference posture and how it sets off.
        """
        self.body = body
        path = waves(1, []) if root_path is None else root_path
        self._kinematics = TreeKinematics(body, joint_angles, path, fade or Fade(), ISB_ORDER)

    def state(self, t: ArrayLike) -> MotionState:
        """Return all segments at the times t (T,), s: arrays (T, S, …).

        Times of type ``longdouble`` give all of it in that precision (the quaternions excepted).
        """
        times = np.atleast_1d(np.asarray(t))
        times = times.astype(np.result_type(times, np.float64), copy=False)
        n = self.body.n_segments
        return self._kinematics.state(np.arange(n), np.broadcast_to(times[:, None], (len(times), n)))

    def module_state(self, segments: IntArray, times: FloatArray) -> MotionState:
        """Return the given segments (M,), each at its own times (T, M), s: arrays (T, M, …)."""
        return self._kinematics.state(segments, times)


def peak_rates(motion: BodyMotion) -> tuple[float, float]:
    """Return the largest |ω| (rad/s) and |ω̇| (rad/s²) of any segment within ``_FITTING_SPAN_S``."""
    state = motion.state(np.arange(0.0, _FITTING_SPAN_S, 0.02))
    return (
        float(np.linalg.norm(state.angular_rate, axis=2).max()),
        float(np.linalg.norm(state.angular_acceleration, axis=2).max()),
    )


def generic_motion(
    body: EmulatedBody,
    seed: int,
    *,
    peak_angular_rate: float = 3.0,
    peak_angular_acceleration: float = 20.0,
    root_travel_m: float = 0.0,
    fade: Fade | None = None,
) -> BodyMotion:
    """Move every joint about all its axes at random, to the peaks asked for (of any segment, absolute).

    peak_angular_rate: rad/s. peak_angular_acceleration: rad/s²; their ratio sets the frequencies.
    root_travel_m: amplitude of the root's path along each world axis (0: the root's joint is fixed).
    """
    rng = np.random.default_rng([seed, 1])
    shape = (body.n_segments, 3, 3)
    joint_angles = Waves(rng.uniform(0.3, 1.0, shape), rng.uniform(0.25, 1.2, shape), _phases(rng, shape))
    still_root = (body.parents == NO_PARENT) & (root_travel_m == 0.0)
    joint_angles.amplitude[still_root] *= 0.6  # all others ride on it
    path_shape = (1, 3, 2)
    path_frequency = rng.uniform(0.1, 0.6, path_shape)
    path = Waves(np.full(path_shape, root_travel_m / 2), path_frequency, _phases(rng, path_shape))

    def build(angles: Waves) -> BodyMotion:
        return BodyMotion(body, angles, path, fade)

    return build(_fitted_to_peaks(joint_angles, build, peak_angular_rate, peak_angular_acceleration))


def robot_arm_motion(body: EmulatedBody, seed: int, fade: Fade | None = None) -> BodyMotion:
    """Return a fixed base and all joints at work: peaks of 3 rad/s and 20 rad/s²."""
    return generic_motion(body, seed, peak_angular_rate=3.0, peak_angular_acceleration=20.0, fade=fade)


def pendulum_motion(body: EmulatedBody, seed: int, fade: Fade | None = None) -> BodyMotion:
    """Return a chain that swings about a fixed pivot as gravity would have it, mostly in the plane east-up.

    The first two modes of a hanging chain: all links together, slow and wide; and link against
    link, faster and narrow. Whatever the segments' axes are, the swing is about world axes.
    """
    rng = np.random.default_rng([seed, 2])
    axes = Rotation.from_quat(body.reference_posture, scalar_first=True).as_matrix()
    about_east, about_north = axes[:, 0, :], axes[:, 1, :]  # (S, 3): shares of the segment's own axes
    slow, fast = rng.uniform(0.6, 0.75), rng.uniform(1.6, 2.0)
    slow_phase, fast_phase = _phases(rng, (2,))
    width = np.where(body.parents == NO_PARENT, 0.6, 0.2) * rng.uniform(0.9, 1.1, body.n_segments)
    against = np.where(np.arange(body.n_segments) % 2, 0.12, -0.12)
    swing, sway = width[:, None] * about_north, 0.15 * width[:, None] * about_east
    # (S, 3, 3 terms): swing, sway a little out of step with it, link against link
    amplitude = np.stack([swing, sway, against[:, None] * about_north], axis=2)
    frequency = np.broadcast_to([slow, slow, fast], amplitude.shape)
    phase = np.broadcast_to([slow_phase, slow_phase + 1.2, fast_phase], amplitude.shape)
    return BodyMotion(body, Waves(amplitude, frequency, phase), fade=fade)


def walking_motion(body: EmulatedBody, seed: int, fade: Fade | None = None) -> BodyMotion:
    """Return walking to and fro: hips, knees, ankles, swinging arms, a bobbing pelvis.

    Segments are known by their ISB names (``left_thigh``, …) with x anterior, y up and z right in the
    reference posture; segments of other names only tremble a little.
    """
    rng = np.random.default_rng([seed, 3])
    stride_hz = rng.uniform(0.85, 0.95)
    terms = [
        (n, axis, amplitude * rng.uniform(0.92, 1.08), harmonic * stride_hz, phase + rng.normal(0.0, 0.05))
        if harmonic
        else (n, axis, amplitude, 0.0, phase)
        for n, name in enumerate(body.segment_names)
        for axis, amplitude, harmonic, phase in walking_terms(name)
    ]
    heading = Rotation.from_quat(body.reference_posture[0], scalar_first=True).as_matrix()
    root: list[tuple[int, int, float, float, float]] = []
    for axis, amplitude, multiple, phase in WALKING_ROOT:  # in the root's axes: the walk is along its x
        root += [
            (0, world, amplitude * heading[world, axis], multiple * stride_hz, phase)
            for world in range(3)
            if abs(heading[world, axis]) > 1e-9
        ]
    return BodyMotion(body, waves(body.n_segments, terms), waves(1, root), fade)


def gait_motion(
    body: EmulatedBody, seed: int, fade: Fade | None = None, gait: Gait | None = None
) -> BodyMotion:
    """Return walking (or another gait) through the world: the foot that carries the body stands still.

    Segments as for ``walking_motion``, which moves a body without legs instead.
    """
    if not has_legs(body):
        return walking_motion(body, seed, fade)
    rng = np.random.default_rng([seed, 4])
    fade, gait = fade or Fade(), gait or WALK
    terms = [(0, 1, np.radians(5.0), gait.stride_hz, 2.0 * np.pi * 0.31)]
    for n, name in enumerate(body.segment_names):
        if n and name.partition("_")[2] not in ("thigh", "shank", "foot"):
            terms += [
                (n, axis, amplitude * rng.uniform(0.9, 1.1), harmonic * gait.stride_hz, phase)
                for axis, amplitude, harmonic, phase in walking_terms(name)
            ]
    others = waves(body.n_segments, terms)
    angles, path = planned_motion(body, gait, fade, others, others.rows(np.array([0])))
    return BodyMotion(body, angles, path, fade)


def everyday_motion(body: EmulatedBody, seed: int, lap: Lap | None = None) -> BodyMotion:
    """Return walking as people walk, turning, stopping, reaching out, a squat, and all over again.

    Raises ``ValueError`` for a body without two legs.
    """
    fade = Fade()
    angles, path = planned_lap(body, seed, fade, lap or Lap(), STRIDE)
    return BodyMotion(body, angles, path, fade)


MOTIONS: dict[str, Callable[[EmulatedBody, int, Fade | None], BodyMotion]] = {
    "arm": robot_arm_motion,
    "pendulum": pendulum_motion,
    "walking": gait_motion,
    "generic": lambda body, seed, fade: generic_motion(body, seed, fade=fade),
}
"""Kinds of motion by name: (body, seed, fade) to the motion."""


def _phases(rng: Generator, shape: tuple[int, ...]) -> FloatArray:
    return rng.uniform(0.0, 2.0 * np.pi, shape)


def _fitted_to_peaks(
    angles: Waves, build: Callable[[Waves], BodyMotion], peak_rate: float, peak_acceleration: float
) -> Waves:
    """Return the waves scaled to the peaks, by iteration.

    Rates go with amplitude × frequency, accelerations with amplitude × frequency².
    """
    for _ in range(_FITTING_ROUNDS):
        rate, acceleration = peak_rates(build(angles))
        faster = (peak_acceleration / peak_rate) / (acceleration / rate)
        wider = peak_rate / (rate * faster)
        # Half the way each round, as the peaks jump from one moment of the motion to another.
        angles = angles.scaled(amplitude=float(np.sqrt(wider)), frequency=float(np.sqrt(faster)))
    return angles
