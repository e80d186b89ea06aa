"""The moments that a motion takes: inverse dynamics, with what the floor gives."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from gateway.analysis.body_model import compiled_model
from gateway.analysis.floor import FloorForces
from gateway.analysis.smooth_motion import SmoothMotion
from gateway.body.inertia import BodyInertia
from gateway.frames import FloatArray

Progress = Callable[[int, int], None]
_FRAMES_A_REPORT = 64


@dataclass(frozen=True)
class Dynamics:
    """What S joints do over F instants; world axes."""

    moment: FloatArray
    """(F, S, 3) N m that the parent side exerts on a segment at its proximal joint; at the root what is left
    over (see ``residual_moment``)."""
    residual_force: FloatArray  # (F, 3) N that nothing in the model explains, at the root
    residual_moment: FloatArray  # (F, 3) N m, about the root's joint
    p_w: FloatArray  # (F, S, 3) m, proximal joints
    rotation_wb: FloatArray  # (F, S, 3, 3) segment to world
    centre_of_mass: FloatArray  # (F, 3) m
    centre_of_mass_velocity: FloatArray  # (F, 3) m/s


class InverseDynamics:
    """One body, instant by instant."""

    def __init__(self, motion: SmoothMotion, inertia: BodyInertia, gravity: FloatArray) -> None:
        """Build the model. gravity: (3,) m/s², world. Raises ``GatewayError`` without mujoco."""
        import mujoco  # noqa: PLC0415 - an extra; told by compiled_model when absent

        self._mujoco = mujoco
        self.model = compiled_model(motion.skeleton, inertia, gravity)
        self.data = mujoco.MjData(self.model)
        names = motion.skeleton.segment_names
        self._bodies = [self.model.body(name).id for name in names]
        self._position = [int(self.model.joint(name).qposadr[0]) for name in names]
        self._rate = [int(self.model.joint(name).dofadr[0]) for name in names]
        self._root = int(np.flatnonzero(motion.skeleton.parents < 0)[0])
        self._states = self._stacked(motion)

    def at(self, frame: int) -> FloatArray:
        """Return (6 + 3 (S − 1),) generalised forces of an instant without the floor; leaves its state in
        ``data``."""
        data = self.data
        data.qpos[:], data.qvel[:], data.qacc[:] = (values[frame] for values in self._states)
        self._mujoco.mj_inverse(self.model, data)
        forces: FloatArray = data.qfrc_inverse.copy()
        return forces

    def applied(self, segment: int, force: FloatArray, moment: FloatArray) -> FloatArray:
        """Return the generalised forces of a force (3,) N and its moment (3,) N m about the world's origin on
        a segment."""
        into = np.zeros(self.model.nv)
        self._mujoco.mj_applyFT(
            self.model, self.data, force, moment, np.zeros(3), self._bodies[segment], into
        )
        return into

    def moments(self, forces: FloatArray) -> FloatArray:
        """Return (S, 3) N m in world axes, of generalised forces at the instant in ``data``."""
        turned = self.data.xmat[self._bodies].reshape(-1, 3, 3)
        own = np.stack([forces[at + 3 : at + 6] if s == self._root else forces[at : at + 3]
                        for s, at in enumerate(self._rate)])  # fmt: skip
        found: FloatArray = np.einsum("sij,sj->si", turned, own)
        return found

    def root_force(self, forces: FloatArray) -> FloatArray:
        """Return (3,) N at the root, of generalised forces."""
        at = self._rate[self._root]
        return forces[at : at + 3]

    def places(self) -> tuple[FloatArray, FloatArray]:
        """Return (S, 3) m proximal joints, and (S, 3, 3) segment to world, of the instant in ``data``."""
        turned = self.data.xmat[self._bodies].reshape(-1, 3, 3)
        return self.data.xpos[self._bodies].copy(), turned.copy()

    def centre_of_mass(self) -> tuple[FloatArray, FloatArray]:
        """Return (3,) m, and (3,) m/s, of the instant in ``data``."""
        self._mujoco.mj_subtreeVel(self.model, self.data)
        root = self._bodies[self._root]
        return self.data.subtree_com[root].copy(), self.data.subtree_linvel[root].copy()

    def _stacked(self, motion: SmoothMotion) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return qpos, qvel, qacc of all instants."""
        count = len(motion.time_s)
        position = np.zeros((count, self.model.nq))
        rate, change = np.zeros((2, count, self.model.nv))
        for s, (p, v) in enumerate(zip(self._position, self._rate, strict=True)):
            shift = 3 if s == self._root else 0
            if s == self._root:
                position[:, p : p + 3], rate[:, v : v + 3] = motion.root, motion.root_velocity
                change[:, v : v + 3] = motion.root_acceleration
            position[:, p + shift : p + shift + 4] = motion.rotation[:, s]
            rate[:, v + shift : v + shift + 3] = motion.angular_velocity[:, s]
            change[:, v + shift : v + shift + 3] = motion.angular_acceleration[:, s]
        return position, rate, change


def inverse_dynamics(
    motion: SmoothMotion,
    inertia: BodyInertia,
    gravity: FloatArray,
    floor: FloorForces | None = None,
    progress: Progress | None = None,
) -> Dynamics:
    """Return the moments of all joints over a motion; gravity (3,), m/s². Raises ``GatewayError`` without
    mujoco."""
    solver = InverseDynamics(motion, inertia, gravity)
    frames, segments = motion.rotation.shape[:2]
    moment, p_w = np.zeros((2, frames, segments, 3))
    turned = np.zeros((frames, segments, 3, 3))
    left, com, com_velocity = np.zeros((3, frames, 3))
    for f in range(frames):
        forces = solver.at(f)
        for c, segment in enumerate(() if floor is None else floor.segments.tolist()):
            assert floor is not None
            forces -= solver.applied(segment, floor.force[f, c], floor.moment[f, c])
        moment[f], left[f] = solver.moments(forces), solver.root_force(forces)
        (p_w[f], turned[f]), (com[f], com_velocity[f]) = solver.places(), solver.centre_of_mass()
        if progress is not None and f % _FRAMES_A_REPORT == 0:
            progress(f, frames)
    root = int(np.flatnonzero(motion.skeleton.parents < 0)[0])
    return Dynamics(moment, left, moment[:, root].copy(), p_w, turned, com, com_velocity)
