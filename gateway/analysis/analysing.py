"""A motion analysed: angles, what the floor does, torques; one call for all callers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from devices.deferred import make_interp_spline
from devices.marker_files.force_plates import ForcePlates
from gateway.analysis.contact import estimated_floor, with_unknown
from gateway.analysis.cycles import Stride, strides
from gateway.analysis.floor import FloorForces, feet
from gateway.analysis.inverse_dynamics import Dynamics, inverse_dynamics
from gateway.analysis.joint_torques import angle_axes, joint_torques
from gateway.analysis.plates import LEVEL_M, measured_floor
from gateway.analysis.smooth_motion import SmoothMotion, smooth_motion
from gateway.analysis.trust import WHOLE_BODY, trust_notes
from gateway.body.inertia import BodyInertia
from gateway.body.joint_angles import joint_angles
from gateway.body.skeleton import Skeleton
from gateway.frames import FloatArray
from gateway.recording import SkeletonArrays
from gateway.recording.exporters.formats import Axes
from gateway.recording.exporters.take import take_of

ProgressOf = Callable[[str], Callable[[int, int], None]]
"""What is begun, to what is then told how far it is."""


@dataclass(frozen=True)
class MeasuredForces:
    """Plates that the motion walked over."""

    plates: ForcePlates
    vertical: str
    """Axis of their file that points up."""


@dataclass(frozen=True)
class Analysis:
    """F instants of S segments and J joints; SI units, world ENU."""

    name: str
    skeleton: Skeleton
    motion: SmoothMotion
    inertia: BodyInertia
    angles: FloatArray  # (F, J, 3) rad; NaN beyond a joint's last angle
    angle_rates: FloatArray  # (F, J, 3) rad/s
    angle_accelerations: FloatArray  # (F, J, 3) rad/s²
    axes: FloatArray  # (F, J, 3, 3) unit world axes of the angles
    torques: FloatArray  # (F, J, 3) N m, in the sense of the angles' names
    power: FloatArray  # (F, J) W, that the joint gives to the motion
    floor: FloorForces
    dynamics: Dynamics
    notes: tuple[str, ...]
    """Sentences on what was assumed and how well it explains the motion."""

    @property
    def time_s(self) -> FloatArray:
        """(T,) instants since the first frame, s."""
        return self.motion.time_s

    @property
    def is_whole(self) -> bool:
        """Whether the body is all of the person."""
        return self.inertia.share > WHOLE_BODY

    @property
    def is_known(self) -> NDArray[np.bool_]:
        """(F, J) whether every force of the floor beyond a joint is known."""
        known = self.floor.known_beyond(self.skeleton)
        return known[:, [joint.distal for joint in self.skeleton.joints]]

    @property
    def known_torques(self) -> FloatArray:
        """``torques``, NaN where a foot stands beyond the joint whose force nothing tells."""
        return np.where(self.is_known[..., None], self.torques, np.nan)

    @property
    def known_power(self) -> FloatArray:
        """(F, J) ``power``, likewise."""
        return np.where(self.is_known, self.power, np.nan)

    @property
    def strides(self) -> tuple[Stride, ...]:
        """Strides of every foot, in the order of time."""
        return strides(self.skeleton, self.floor, self.time_s, self.dynamics.p_w)

    @property
    def weight_n(self) -> float:
        """Of the whole person, also where the body is a part of one."""
        return 9.81 * self.inertia.body_kg


def analyse(
    arrays: SkeletonArrays,
    name: str,
    inertia: BodyInertia,
    gravity: FloatArray,
    cutoff_hz: float | None,
    measured: MeasuredForces | None = None,
    progress: ProgressOf | None = None,
) -> Analysis:
    """Analyse everything but muscles. gravity: (3,) m/s². measured: None where the floor's forces are to be
    estimated.

    Raises ``GatewayError`` for a motion too short, a cut-off too high, or without mujoco.
    """
    if measured is not None and arrays.origin_ns is None:  # its time is not that of the plates' file
        measured = replace(measured, plates=replace(measured.plates, begins_s=0.0))
    take = take_of(arrays, name, Axes.Z_UP)
    root = int(np.flatnonzero(arrays.skeleton.parents < 0)[0])
    motion = smooth_motion(arrays.skeleton, take.time_s, take.q_wb, take.p_w[:, root], cutoff_hz)
    found = analyse_motion(motion, name, inertia, gravity, measured, progress)
    return replace(found, notes=(*found.notes, *_fill_notes(take.filled)))


def analyse_motion(
    motion: SmoothMotion,
    name: str,
    inertia: BodyInertia,
    gravity: FloatArray,
    measured: MeasuredForces | None = None,
    progress: ProgressOf | None = None,
) -> Analysis:
    """Analyse a motion that is smooth already, as ``analyse`` does."""
    progress_of = progress or (lambda _: lambda _done, _total: None)
    skeleton = motion.skeleton
    free = inverse_dynamics(
        motion, inertia, gravity, progress=progress_of("inverse dynamics without the floor")
    )
    known = None
    if measured is not None:
        known = measured_floor(measured.plates, measured.vertical, motion, free, motion.cutoff_hz)
    floor = _floor(motion, free, known, inertia, progress_of)
    dynamics = inverse_dynamics(motion, inertia, gravity, floor, progress_of("inverse dynamics"))
    q_wb = motion.orientations()
    angles = joint_angles(skeleton, q_wb)
    rates, accelerations = _derivatives(motion.time_s, angles)
    axes = angle_axes(skeleton, angles, dynamics.rotation_wb)
    torques = joint_torques(skeleton, axes, dynamics.moment)
    weight_n = float(np.linalg.norm(gravity) * inertia.mass.sum())
    return Analysis(
        name=name,
        skeleton=skeleton,
        motion=motion,
        inertia=inertia,
        angles=angles,
        angle_rates=rates,
        angle_accelerations=accelerations,
        axes=axes,
        torques=torques,
        power=_power(skeleton, motion, dynamics),
        floor=floor,
        dynamics=dynamics,
        notes=tuple(trust_notes(motion, inertia, floor, dynamics, weight_n)),
    )


def _floor(
    motion: SmoothMotion,
    free: Dynamics,
    known: FloorForces | None,
    inertia: BodyInertia,
    progress_of: ProgressOf,
) -> FloorForces:
    """Return measured where it was, estimated elsewhere if the body is whole, has feet, and the floor is
    level."""
    on = feet(motion.skeleton)
    frames = len(motion.time_s)
    is_level = known is None or np.ptp(known.height_m) < LEVEL_M
    if len(on) and inertia.share > WHOLE_BODY and is_level:
        return estimated_floor(motion, free, known, progress=progress_of("floor forces"))
    if known is not None:
        return with_unknown(motion, free, known)
    nothing = np.zeros((frames, len(on), 3))
    none = np.zeros(nothing.shape[:2])
    return with_unknown(motion, free, FloorForces(on, nothing, nothing, none.astype(np.uint8), none))


def _derivatives(time_s: FloatArray, angles: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the first and second derivative by time; NaN where there is no angle."""
    flat = angles.reshape(len(angles), -1)
    first, second = np.full((2, *flat.shape), np.nan)
    known = np.isfinite(flat).all(axis=0)
    if known.any():
        curve = make_interp_spline(time_s, flat[:, known], k=5)
        first[:, known], second[:, known] = curve(time_s, 1), curve(time_s, 2)
    return first.reshape(angles.shape), second.reshape(angles.shape)


def _power(skeleton: Skeleton, motion: SmoothMotion, dynamics: Dynamics) -> FloatArray:
    """Return (F, J) W of moment and rate against the parent, at each joint's distal segment."""
    distal = [joint.distal for joint in skeleton.joints]
    turned = dynamics.rotation_wb[:, distal]
    rates = np.einsum("fjik,fjk->fji", turned, motion.angular_velocity[:, distal])
    power: FloatArray = np.einsum("fji,fji->fj", dynamics.moment[:, distal], rates)
    return power


def _fill_notes(filled: np.ndarray) -> list[str]:
    if not filled.any():
        return []
    return [f"{100 * float(filled.mean()):.1f} % of the orientations were put in between neighbours in time."]
