"""Poses of a person on a robot: inverse kinematics by ``mink``, within limits and rates of the joints.

A link turns against the neutral posture as the segment that it follows does, both against their bases. Each
frame is one quadratic program over the turns of the joints since the frame before, bounded by limits and by
what rates allow in that time: a Gauss-Newton step, which at the rate of poses leaves next to nothing.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from typing import Any

import numpy as np

from devices.extras import how_to_add
from gateway.body.kinematics import joint_positions, lowest_point
from gateway.body.robot import LinkEntry, Robot
from gateway.body.skeleton import Skeleton
from gateway.errors import GatewayError
from gateway.frames import FloatArray, SkeletonFrame
from gateway.geometry import quaternion

_LONGEST_S = 0.1
"""After a longer silence the robot begins as slowly as after this."""
_FIRST_S = 0.01
_POSTURE_COST = 0.02
"""Of the neutral posture, 1/rad: decides where links leave a joint free."""
_POSTURE_GAIN = 0.02
"""What is left free goes there so slowly, a share a frame: an arm that is lost sinks, and does not drop."""
_DAMPING = 1e-4


@dataclass(frozen=True)
class RobotPose:
    """Joints of a robot at one instant, in the order of ``Robot.joints``."""

    sequence: int
    time_ns: int
    angles: FloatArray  # (J,) rad
    rates: FloatArray  # (J,) rad/s, since the pose before
    base_orientation: FloatArray  # (4,) base link to world
    base_position: FloatArray | None  # (3,) m, world; None: bolted down
    errors: FloatArray  # (n_links,) rad, from the orientation that a link is to have; NaN: not known


class Retargeter:
    """Solves frames of one person in their order. Not threadsafe."""

    def __init__(self, robot: Robot, skeleton: Skeleton) -> None:
        """Prepare to retarget a body to a robot. Raises ``GatewayError`` without the extra ``robot``."""
        try:
            self._mink: Any = importlib.import_module("mink")
            self._qp: Any = importlib.import_module("qpsolvers")
            mujoco = importlib.import_module("mujoco")
        except ImportError as error:
            raise GatewayError(f"mink is not there ({error}): {how_to_add('robot')}") from error
        self.robot = robot
        self._skeleton = skeleton
        model = _model(mujoco, robot)
        self._configuration: Any = self._mink.Configuration(model, robot.neutral)
        file, names = robot.file, skeleton.segment_names
        entries = list(file.links.values())
        self._base = names.index(file.base)
        self._segments = np.array([names.index(entry.segment) for entry in entries])
        self._links = list(file.links)
        self._turn = quaternion.from_matrix(robot.base_to_world)
        self._neutral = np.array([self._orientation(link) for link in self._links])
        self._unturned = quaternion.conjugate(skeleton.neutral)
        self._reaches = [self._reach(link, file.links[link]) for link in self._links]
        self._scale = self._size_ratio()
        self._tasks = [
            self._mink.FrameTask(link, "site", entry.reach, entry.orientation, lm_damping=1e-3)
            for link, entry in file.links.items()
        ]
        self._posture = self._mink.PostureTask(model, cost=_POSTURE_COST, gain=_POSTURE_GAIN)
        self._low, self._high = robot.limits.T
        start = np.clip(robot.neutral, self._low, self._high)
        self._posture.set_target(start)
        self._configuration.update(start)
        self._advance([self._posture], _FIRST_S)  # what loads at first use is there before poses come
        self._last_ns: int | None = None

    def solve(self, frame: SkeletonFrame) -> RobotPose | None:
        """Return the robot's pose; None where the base's segment is not known, or time did not go on."""
        base = quaternion.multiply(frame.q_wb[self._base], self._unturned)
        before = self._last_ns
        if np.isnan(base[0]) or (before is not None and frame.time_ns <= before):
            # A clock that stepped back begins anew; a repeated time gives no pose, as no rate can be kept.
            self._last_ns = frame.time_ns if before is not None and frame.time_ns < before else before
            return None
        self._last_ns = frame.time_ns
        # After a pause the robot may not make up for the time at once.
        seconds = _FIRST_S if before is None else min((frame.time_ns - before) * 1e-9, _LONGEST_S)

        targets = self._targets(base, frame.q_wb)
        known = np.isfinite(targets[:, 0])
        self._aim(base, frame.q_wb, targets, known)
        tasks = [task for task, is_known in zip(self._tasks, known.tolist(), strict=True) if is_known]
        angles = self._advance([*tasks, self._posture], seconds)
        orientation = quaternion.multiply(base, self._turn)
        return RobotPose(
            frame.sequence,
            frame.time_ns,
            angles[0],
            angles[1],
            orientation,
            self._place(frame, orientation),
            self._errors(targets, known),
        )

    def _targets(self, base: FloatArray, q_wb: FloatArray) -> FloatArray:
        """Return (n_links, 4) what each link's orientation against the base link is to be."""
        back = quaternion.conjugate(quaternion.multiply(base, self._turn))
        targets = np.empty((len(self._links), 4))
        for i, segment in enumerate(self._segments):
            turned = quaternion.multiply(q_wb[segment], self._unturned)
            link = quaternion.multiply(self._turn, self._neutral[i])
            targets[i] = quaternion.multiply(back, quaternion.multiply(turned, link))
        return targets

    def _aim(self, base: FloatArray, q_wb: FloatArray, targets: FloatArray, known: Any) -> None:
        skeleton = self._skeleton
        back = quaternion.conjugate(quaternion.multiply(base, self._turn))
        places = None
        for i, task in enumerate(self._tasks):
            if not known[i]:
                continue
            place = np.zeros(3)
            if (reach := self._reaches[i]) is not None:
                # Computed once, and only if a link reaches: forward kinematics of the person.
                if places is None:
                    places = joint_positions(skeleton.parents, skeleton.offsets, q_wb, np.zeros(3))
                step = quaternion.rotate(back, places[reach.segment] - places[reach.start])
                if np.isnan(step[0]):
                    known[i] = False
                    continue
                place = self._site(reach.start_link).translation() + reach.scale * step
            rotation = self._mink.SO3(targets[i])
            task.set_target(self._mink.SE3.from_rotation_and_translation(rotation, place))

    def _advance(self, tasks: list[Any], seconds: float) -> tuple[FloatArray, FloatArray]:
        """Return angles and rates, (J,) each, after a frame that lasts so long."""
        configuration, before = self._configuration, self._configuration.q.copy()
        furthest = self.robot.rates * seconds
        problem = self._mink.build_ik(configuration, tasks, seconds, _DAMPING, limits=[])
        problem.lb = np.maximum(self._low - before, -furthest)
        problem.ub = np.minimum(self._high - before, furthest)
        solution = self._qp.solve_problem(problem, solver="daqp")
        if not solution.found:
            raise GatewayError("the robot's posture was not found: the solver did not come to an end")
        # A solver's own tolerance is not to show as a limit broken by a millionth.
        turns = np.clip(solution.x, problem.lb, problem.ub)
        angles = np.clip(before + turns, self._low, self._high)
        configuration.update(angles)
        return angles, turns / seconds

    def _errors(self, targets: FloatArray, known: Any) -> FloatArray:
        errors = np.full(len(self._links), np.nan)
        for i in np.flatnonzero(known):
            errors[i] = quaternion.angle_between(self._orientation(self._links[i]), targets[i])
        return errors

    def _place(self, frame: SkeletonFrame, orientation: FloatArray) -> FloatArray | None:
        """Return where the base link is: over the person's, its lower sole as high as the person is."""
        if not self.robot.file.soles:
            return None
        place = self._scale * frame.p_w[frame.root]
        is_placed = bool(np.isfinite(frame.p_w).all() and np.isfinite(frame.q_wb).all())
        height = self._scale * lowest_point(self._skeleton, frame.q_wb, frame.p_w) if is_placed else 0.0
        soles = [
            quaternion.rotate(orientation, self._site(link).translation()) for link in self.robot.file.soles
        ]
        found: FloatArray = np.nan_to_num(place)
        found[2] = height - min(sole[2] for sole in soles)
        return found

    def _size_ratio(self) -> float:
        """Return the length of the robot's legs by that of the person's, in the neutral postures."""
        if not self.robot.file.soles:
            return 1.0
        skeleton = self._skeleton
        neutral = np.tile(skeleton.neutral, (skeleton.n_segments, 1))
        places = joint_positions(skeleton.parents, skeleton.offsets, neutral, np.zeros(3))
        own = -min(self._site(link).translation()[2] for link in self.robot.file.soles)
        persons = -lowest_point(skeleton, neutral, places)
        if not (own > 0 and persons > 0):
            raise GatewayError("soles: in the neutral posture they are not below the base: name others")
        return float(own / persons)

    def _reach(self, link: str, entry: LinkEntry) -> _Reach | None:
        if not entry.reach or entry.start is None or entry.start_link is None:
            return None
        names, parents = self._skeleton.segment_names, self._skeleton.parents
        start, segment = names.index(entry.start), names.index(entry.segment)
        persons, at = 0.0, segment
        while at != start and at >= 0:
            persons += float(np.linalg.norm(self._skeleton.offsets[at]))
            at = int(parents[at])
        # The ratio of the robot's limb to the person's scales the reach.
        own, place = 0.0, self._site(link).translation()
        tree, here = self.robot.tree, link
        while here != entry.start_link and here in tree.joint_of:
            here = tree.joint_of[here].parent
            before = self._site(here).translation()
            own, place = own + float(np.linalg.norm(place - before)), before
        if at < 0 or here != entry.start_link or not persons > 0 or not own > 0:
            raise GatewayError(
                f"links: '{link}' reaches from '{entry.start_link}' as '{entry.segment}' does from "
                f"'{entry.start}': name a start that it hangs from, with a joint between"
            )
        return _Reach(segment, start, entry.start_link, own / persons)

    def _site(self, link: str) -> Any:
        return self._configuration.get_transform_frame_to_world(link, "site")

    def _orientation(self, link: str) -> FloatArray:
        """Return (4,) link to base link, as the joints stand."""
        wxyz: FloatArray = self._site(link).rotation().wxyz
        return wxyz


@dataclass(frozen=True)
class _Reach:
    """The place of a link, as far from its start as the person's segment is from its own."""

    segment: int
    start: int
    start_link: str
    scale: float


def _model(mujoco: Any, robot: Robot) -> Any:
    """Return the robot's joints as a model of MuJoCo, a site a link; masses mean nothing."""
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    spec.compiler.boundmass = spec.compiler.boundinertia = 1e-3
    tree = robot.tree
    limits = dict(zip(robot.joint_names, robot.limits, strict=True))
    body_of = {tree.links[0]: (spec.worldbody.add_body(name=tree.links[0]), np.eye(4))}
    for link in tree.links:
        # A fixed joint has no body of its own: its link is a site on the parent.
        if (joint := tree.joint_of.get(link)) is not None:
            body, at = body_of[joint.parent]
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = joint.rotation, joint.xyz
            pose = at @ pose
            if joint.turns:
                body = body.add_body(name=link, pos=pose[:3, 3], quat=quaternion.from_matrix(pose[:3, :3]))
                low, high = limits[joint.name]
                is_limited = bool(np.isfinite([low, high]).all())
                body.add_joint(
                    name=joint.name,
                    type=mujoco.mjtJoint.mjJNT_HINGE,
                    axis=joint.axis,
                    range=(low, high) if is_limited else (0.0, 0.0),
                    limited=is_limited,
                )
                pose = np.eye(4)
            body_of[link] = body, pose
        body, pose = body_of[link]
        body.add_site(name=link, pos=pose[:3, 3], quat=quaternion.from_matrix(pose[:3, :3]))
    return spec.compile()
