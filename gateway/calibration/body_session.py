"""A body calibration while it is done: frames in, steps begun and ended, then the result. Sans-I/O."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from gateway.body.skeleton import WornSuit
from gateway.calibration.axes import hinge_axes, movement_axis
from gateway.calibration.body_quality import judge_module
from gateway.calibration.body_result import BodyResult, ModuleEvidence, ModuleResult
from gateway.calibration.body_solver import (
    ARMS_UP_SIGMA,
    AXIS_SIGMA,
    FIELD_SIGMA,
    POSE_SIGMA,
    AxisTerm,
    PoseTerm,
    Problem,
    Solution,
    solve_body,
)
from gateway.calibration.evidence import EvenSamples, Span, even_samples, field_heading, pose_of
from gateway.calibration.joint_centres import JointEquations, joint_equations, side
from gateway.calibration.procedure import Step, StepKind, pose_rotation, procedure_for
from gateway.errors import GatewayError, nearest
from gateway.frames import FloatArray, ImuFrame
from gateway.geometry import quaternion

LONGEST_S = 1200.0
"""A session forgets what is older than so long."""
TRUSTED_FIELD_CHANGE = 0.10
"""Relative change of the field's strength up to which it gives headings."""
HINGE_SIGMA = np.radians(5.0)
"""Of a knee's axis as found in any movement: no knee is a hinge."""
_LIVE_S = 0.3
_SMALL_MOVEMENT = np.radians(20.0)


@dataclass(frozen=True)
class Liveliness:
    """What a module does at the moment."""

    is_received: bool
    turning: float
    """Mean angular rate, rad/s."""


@dataclass
class BodySession:
    """One wearer, one suit, steps in any order."""

    suit: WornSuit
    uses_field: bool = True
    """False: headings come from movements alone, as with modules without magnetometers."""
    steps: tuple[Step, ...] = ()
    spans: dict[tuple[str, int], Span] = field(default_factory=dict)
    """By step and module (row of the rig): when it was done last."""
    current: str | None = None

    def __post_init__(self) -> None:
        self.steps = self.steps or procedure_for(self.suit.skeleton)
        self._frames: list[ImuFrame] = []
        self._begun_ns = 0
        self._chosen: tuple[int, ...] = ()
        self._segments = [
            int(np.flatnonzero(self.suit.module_of_segment == m)[0]) for m in range(len(self.suit.module_ids))
        ]

    def step(self, name: str) -> Step:
        """Return the step of a name. Raises ``GatewayError`` for an unknown one."""
        by_name = {step.name: step for step in self.steps}
        if name not in by_name:
            raise GatewayError(f"there is no step '{name}'{nearest(name, by_name)}")
        return by_name[name]

    def add(self, frame: ImuFrame) -> None:
        """Add a frame, in order of time; frames older than ``LONGEST_S`` are dropped now and then."""
        self._frames.append(frame)
        if len(self._frames) % 1000 == 0:
            oldest = frame.time_ns - LONGEST_S * 1e9
            self._frames = [kept for kept in self._frames if kept.time_ns >= oldest]

    @property
    def now_ns(self) -> int:
        """Instant of the newest frame; 0 before the first."""
        return self._frames[-1].time_ns if self._frames else 0

    def refuse_without_frames(self) -> None:
        """Raise ``GatewayError`` if there has been no frame yet."""
        if not self._frames:
            raise GatewayError("no module has been heard yet: are they switched on, and is the link right?")

    def begin(self, name: str, segments: Iterable[str] | None = None) -> None:
        """Begin a step with the next frame.

        Raises ``GatewayError`` for an unknown step, or if no module was heard yet.

        segments: those for which the new recording counts (to redo one module); None: all.
        """
        self.step(name)
        self.refuse_without_frames()
        self._chosen = self._modules(segments)
        self.current, self._begun_ns = name, self.now_ns

    def end(self) -> None:
        """End the current step; it counts from now on."""
        if self.current is not None:
            for module in self._chosen:
                self.spans[self.current, module] = (self._begun_ns, self.now_ns)
        self.current = None

    def mark(self, name: str, begin_ns: int, end_ns: int) -> None:
        """Mark a step of all modules afterwards, for recordings.

        Raises ``GatewayError`` for an unknown one.
        """
        self.step(name)
        for module in range(len(self._segments)):
            self.spans[name, module] = (begin_ns, end_ns)

    @property
    def done(self) -> list[str]:
        """Names of the steps that were done, in the order of the procedure."""
        return [step.name for step in self.steps if any(name == step.name for name, _ in self.spans)]

    def live(self) -> list[Liveliness]:
        """Return, by module, whether it is heard and how fast it turns, rad/s, over the last moments."""
        newest = self.now_ns
        # Only the newest frames can lie within the last moments; searching all would take longer each time.
        frames = [f for f in self._frames[-200:] if f.time_ns > newest - _LIVE_S * 1e9]
        if not frames:
            return [Liveliness(False, 0.0)] * len(self._segments)
        rates = np.linalg.norm(np.stack([f.angular_rate for f in frames]), axis=2)
        is_known = np.isfinite(rates)
        mean = np.where(is_known, rates, 0.0).sum(axis=0) / np.maximum(is_known.sum(axis=0), 1)
        return [
            Liveliness(bool(known), float(rate))
            for known, rate in zip(is_known.any(axis=0), mean, strict=True)
        ]

    def result(self) -> BodyResult:
        """Return what the steps done so far give. Takes a second or two. Raises ``GatewayError``."""
        try:
            readings = even_samples(list(self._frames), self.suit)
            findings = [self._examine(readings, m) for m in range(len(self._segments))]
            solution = solve_body(self._problem(readings, findings))
        except ValueError as error:
            raise GatewayError(str(error)) from error
        return self._judged(findings, solution)

    def _modules(self, segments: Iterable[str] | None) -> tuple[int, ...]:
        if segments is None:
            return tuple(range(len(self._segments)))
        names = [self.suit.skeleton.segment_names[s] for s in self._segments]
        chosen = []
        for segment in segments:
            if segment not in names:
                raise GatewayError(f"no module sits on '{segment}'{nearest(segment, names)}")
            chosen.append(names.index(segment))
        return tuple(chosen)

    def _examine(self, readings: EvenSamples, module: int) -> ModuleEvidence:
        """Return all that one module did by itself."""
        segment = self.suit.skeleton.segment_names[self._segments[module]]
        found = ModuleEvidence(segment, self.suit.module_ids[module])
        pose_spans = []
        for step in self.steps:
            span = self.spans.get((step.name, module))
            if span is None:
                continue
            if not readings.is_received(module, span):
                found.unreceived.append(step.name)
            elif step.kind is StepKind.POSE:
                pose = pose_of(readings, module, span)
                if pose is not None:
                    found.poses[step.name] = pose
                    pose_spans.append(span)
            elif step.kind is StepKind.MOVEMENT and segment in step.turns:
                rate = readings.angular_rate[readings.rows(span), module]
                found.movements[step.name] = movement_axis(rate, readings.interval_s)

        if self.uses_field and pose_spans:
            # Steps beside the poses show whether the field is the same where the wearer moves.
            others = [span for (_, m), span in self.spans.items() if m == module and span not in pose_spans]
            found.earth_field = field_heading(readings, module, pose_spans, self.suit.magnetic_field, others)
        return found

    def _problem(self, readings: EvenSamples, findings: list[ModuleEvidence]) -> Problem:
        skeleton = self.suit.skeleton
        neutral = quaternion.to_matrix(skeleton.neutral)
        poses, axes, fields = [], [], {}
        for segment, found in zip(self._segments, findings, strict=True):
            terms = self._axis_terms(segment, found)
            # A field that changed during the steps is iron nearby, and says nothing of north.
            is_trusted = found.earth_field is not None and found.earth_field.change < TRUSTED_FIELD_CHANGE
            axes += terms
            if is_trusted and found.earth_field is not None and found.poses:
                fields[segment] = (found.earth_field.heading, FIELD_SIGMA + found.earth_field.change)
            for name, pose in found.poses.items():
                turn = quaternion.to_matrix(
                    quaternion.from_rotation_vector(pose_rotation(name, found.segment))
                )
                # Raised arms waver more than a body that stands.
                is_arm = bool(np.any(pose_rotation(name, found.segment)))
                sigma = (ARMS_UP_SIGMA if is_arm else POSE_SIGMA) + 0.5 * pose.moved_rad
                poses.append(PoseTerm(segment, pose.R_es, neutral @ turn, sigma))
        equations = self._equations(readings, {term.segment for term in poses})
        axes += self._hinges(readings, {term.segment for term in axes}, set(equations))

        with_heading = _reached(
            {term.segment for term in axes} | set(fields), equations, skeleton.parents.tolist()
        )
        for segment, found in zip(self._segments, findings, strict=True):
            found.has_no_heading = bool(found.poses) and segment not in with_heading
        poses = [term for term in poses if term.segment in with_heading]
        posed = {term.segment for term in poses}
        axes = [term for term in axes if term.segment in posed]
        # A module without heading gets one only by a joint that connects it to a module with a heading.
        equations = {
            child: one for child, one in equations.items() if {child, int(skeleton.parents[child])} <= posed
        }
        return Problem(
            skeleton.parents, self.suit.lever_arms, skeleton.offsets, poses, axes, fields, equations
        )

    def _axis_terms(self, segment: int, found: ModuleEvidence) -> list[AxisTerm]:
        """Return the axes of movements that were large and regular enough to give one."""
        terms = []
        for name, movement in found.movements.items():
            if movement is not None and movement.range_rad > _SMALL_MOVEMENT:
                sign = self.step(name).turns[found.segment]
                # A movement that varies, or turns about several axes, gives a less certain axis.
                sigma = AXIS_SIGMA + 0.5 * movement.spread_rad + np.radians(10.0) * (1.0 - movement.share)
                terms.append(AxisTerm(segment, movement.axis, sign, sigma))
        return terms

    def _hinges(self, readings: EvenSamples, known: set[int], joined: set[int]) -> list[AxisTerm]:
        """Return the knees' axes in the free movement, for segments without an axis of another movement.

        A knee bends about -z, starting from standing.
        """
        skeleton = self.suit.skeleton
        module_of = {segment: module for module, segment in enumerate(self._segments)}
        terms = []
        for child in sorted(joined):
            parent = int(skeleton.parents[child])
            span = self.spans.get(("free", module_of[child]))
            is_knee = skeleton.segment_names[child].endswith("shank")
            if span is None or not is_knee or {child, parent} <= known:
                continue
            rows = readings.rows(span)
            above, below = (readings.angular_rate[rows, module_of[s]] for s in (parent, child))
            try:
                hinge = hinge_axes(above, below, readings.interval_s)
            except ValueError:
                continue
            # The sign of an axis is arbitrary; a knee's mean flexion while moving is not.
            bend = np.cumsum(below @ hinge.second - above @ hinge.first) * readings.interval_s
            if np.ptp(bend) > _SMALL_MOVEMENT:
                sign = -1 if bend.mean() > 0.0 else 1
                terms += [
                    AxisTerm(parent, hinge.first, sign, HINGE_SIGMA),
                    AxisTerm(child, hinge.second, sign, HINGE_SIGMA),
                ]
        return terms

    def _equations(self, readings: EvenSamples, used: set[int]) -> Mapping[int, JointEquations]:
        """Return the equations of all joints between two modules, from every step that was a movement."""
        found: dict[int, JointEquations] = {}
        moving = [step.name for step in self.steps if step.kind is not StepKind.POSE]
        module_of = {segment: module for module, segment in enumerate(self._segments)}
        for child, parent in enumerate(self.suit.skeleton.parents.tolist()):
            if not {child, parent} <= used:
                continue
            first, second = module_of[parent], module_of[child]
            spans = [self.spans[name, second] for name in moving if (name, second) in self.spans]
            rows = np.zeros(len(readings.time_ns), dtype=bool)
            for span in spans:
                rows[readings.rows(span)] = True
            rows &= readings.has_sample[:, first] & readings.has_sample[:, second]
            # Fewer rows are a fraction of a movement, and would only add noise.
            if rows.sum() >= 100:
                sides = [
                    side(
                        readings.specific_force[:, m],
                        readings.angular_rate[:, m],
                        readings.R_es[:, m],
                        readings.interval_s,
                    )
                    for m in (first, second)
                ]
                kept = [
                    replace(one, force=one.force[rows], gamma=one.gamma[rows], R_es=one.R_es[rows])
                    for one in sides
                ]
                found[child] = joint_equations(kept[0], kept[1])
        return found

    def _judged(self, findings: list[ModuleEvidence], solution: Solution) -> BodyResult:
        modules = []
        for segment, found in zip(self._segments, findings, strict=True):
            expected = {
                step.name
                for step in self.steps
                if step.kind is StepKind.MOVEMENT and found.segment in step.turns
            }
            quality = judge_module(found, expected & set(self.done), solution, segment, self.suit)
            q_bs: FloatArray = solution.sensor_to_segment[segment]
            is_solved = bool(np.isfinite(q_bs).all())
            modules.append(
                ModuleResult(
                    found.module,
                    found.segment,
                    quality,
                    q_bs if is_solved else None,
                    solution.places[segment],
                    float(solution.rotation_sigma[segment]),
                    float(solution.place_sigma[segment]),
                )
            )
        return BodyResult(tuple(modules), solution.facing, solution.joints, self.done)


def _reached(known: set[int], equations: Mapping[int, JointEquations], parents: list[int]) -> set[int]:
    """Return segments whose heading is known, or can be had from a neighbour by the joint between them."""
    reached = set(known)
    for _ in equations:
        for child in equations:
            if {child, parents[child]} & reached:
                reached |= {child, parents[child]}
    return reached
