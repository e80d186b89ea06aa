"""What is the same whatever finds the orientations: before it and after it.

ImuFrame → stuck modules left out → (rest of each segment) → orientations → segments without module
         → where the body is in the world → SkeletonFrame
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from enum import StrEnum
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from gateway.body.interpolation import follow, following_rules
from gateway.body.kinematics import joint_positions
from gateway.body.skeleton import WornSuit
from gateway.frames import (
    Clipped,
    FloatArray,
    ImuFrame,
    IntArray,
    Quantity,
    SkeletonFrame,
    Status,
    StatusArray,
)
from gateway.reconstruction.inertial.observations import SegmentObservations, SegmentObserver
from gateway.reconstruction.inertial.root_position import (
    Contacts,
    PositionSettings,
    PositionState,
    advance_position,
    initial_position,
)
from gateway.reconstruction.inertial.stance import StanceSettings, StanceState, initial_stance, watch_stance
from gateway.reconstruction.joint_agreement import (
    AgreementState,
    initial_agreement,
    joint_scores,
    joints_of,
    segment_scores,
    watch_joints,
)
from gateway.reconstruction.module_faults import RepeatState, initial_repeats, stuck_modules
from gateway.reconstruction.mounting import (
    NOBODY,
    UNKNOWN,
    MountingState,
    initial_mounting,
    judge_mounting,
    worn_of,
)

SHORTEST_STEP_S = 1e-5
LONGEST_STEP_S = 0.5
"""A longer pause counts as one of that length."""
_NEVER_NS = int(np.iinfo(np.int64).min)


NO_CONTACTS = "body '{}' has no contacts to walk on: give its feet 'contacts', or set 'auto' or 'fixed'"


class RootMode(StrEnum):
    """What the skeleton's root does."""

    AUTO = "auto"
    """Walks if the body has contacts (feet) and no device measures where it is; else fixed."""
    FIXED = "fixed"
    """Stays at the origin, or where a local device measures it."""
    WALKING = "walking"
    """Stands on resting contacts and flies between them."""


class RootSettings(NamedTuple):
    """How the body moves through the world."""

    mode: RootMode = RootMode.AUTO
    has_floor: bool = True
    floor: float = 0.0
    """m: height of a level floor."""


class OrientationFinder(Protocol):
    """What this wraps: any reconstructor."""

    def update(self, observation: ImuFrame, resting: FloatArray | None = None) -> SkeletonFrame: ...

    def reset(self) -> None: ...


class Prepared(NamedTuple):
    """An instant as the finder is given it."""

    observation: ImuFrame
    """Without modules that are stuck."""
    observed: SegmentObservations
    resting: FloatArray
    """(n_segments,) for how long each stands still, s; 0: it does not."""
    dt: float
    """s since the frame before."""


class _Memory(NamedTuple):
    """All that is remembered besides the finder."""

    stance: StanceState
    position: PositionState
    repeats: RepeatState
    agreement: AgreementState
    mounting: MountingState


class WholeBodyReconstructor:
    """A reconstructor for the whole body around one that finds orientations.

    root of its frames: the segment that the body stands on, while it walks. p_w: in the world, z from the
    floor, the start above the origin. status: PREDICTED for segments without module; a stuck module counts as
    silent. A frame that is not later than the one before changes nothing and gets the last pose again.
    Segments whose modules seem to be worn otherwise than the suit says are DOUBTFUL (see ``mounting``), and
    their sigma says that nothing is known; their orientations stay as they were found.
    ``joint_agreement``: see that module.
    """

    def __init__(self, suit: WornSuit, finder: OrientationFinder, root: RootSettings | None = None) -> None:
        """Raises ``ValueError`` if the root shall walk and the body has no contacts."""
        self._suit = suit
        self.finder = finder
        self._observer = SegmentObserver(suit)
        self._rules = following_rules(suit)
        self._joints, self._worn = joints_of(suit), worn_of(suit)
        self._contacts = _contacts(suit, root or RootSettings())
        self._carries = np.zeros(suit.skeleton.n_segments)
        self._carries[[segment for segment, _ in suit.skeleton.contacts]] = 1.0
        self._gravity = float(np.linalg.norm(suit.gravity))
        self._parents = suit.skeleton.parents.astype(np.int64)
        self._offsets = np.array(suit.skeleton.offsets, np.float64)
        self.reset()
        self._compile()
        self.reset()

    def reset(self) -> None:
        """Forget everything but the parameters."""
        self.finder.reset()
        self._time_ns = _NEVER_NS
        n = self._suit.skeleton.n_segments
        self._last = no_pose(n)
        n_contacts = len(self._contacts.segments) if self._contacts else 0
        self._memory = _Memory(
            initial_stance(n),
            initial_position(n_contacts),
            initial_repeats(len(self._suit.module_ids)),
            initial_agreement(n),
            initial_mounting(n),
        )

    def update(self, observation: ImuFrame) -> SkeletonFrame:
        """One instant. Raises nothing: what is not defined is NaN and says so in ``status``."""
        return self.update_many((observation,))[0]

    def update_many(self, observations: Sequence[ImuFrame]) -> list[SkeletonFrame]:
        """Instants in time order; the same as ``update`` of each, bit for bit."""
        newest_ns, is_later = self._time_ns, []
        for observation in observations:
            is_later.append(observation.time_ns > newest_ns)
            newest_ns = max(newest_ns, observation.time_ns)
        later = [one for one, counts in zip(observations, is_later, strict=True) if counts]
        solved = iter(self._solved(later) if later else ())
        poses = []
        for observation, counts in zip(observations, is_later, strict=True):
            self._last = next(solved) if counts else replace(self._last, sequence=observation.sequence)
            poses.append(self._last)
        return poses

    def _solved(self, observations: Sequence[ImuFrame]) -> list[SkeletonFrame]:
        """Return the poses of instants each later than the one before."""
        prepared = self.prepare(observations)
        if isinstance(self.finder, _BatchFinder):
            rest = np.stack([one.resting for one in prepared])
            found = self.finder.update_many([one.observation for one in prepared], rest)
        else:
            found = [self.finder.update(one.observation, one.resting) for one in prepared]
        return [self.finish(*one) for one in zip(found, prepared, strict=True)]

    def prepare(self, observations: Sequence[ImuFrame]) -> list[Prepared]:
        """What is done before the finder, to instants in time order."""
        prepared = []
        for observation in observations:
            dt = self._step(observation.time_ns)
            clean = self._without_stuck(observation, dt)
            observed = self.observe(clean)
            prepared.append(Prepared(clean, observed, self._watch(observed, dt), dt))
        return prepared

    def observe(self, observation: ImuFrame) -> SegmentObservations:
        """A frame by segment, segment axes."""
        return self._observer.observe(observation)

    def _step(self, time_ns: int) -> float:
        """Seconds since the frame before."""
        dt = (time_ns - self._time_ns) * 1e-9 if self._time_ns > _NEVER_NS else 0.0
        self._time_ns = time_ns
        return min(max(dt, SHORTEST_STEP_S), LONGEST_STEP_S)

    def _watch(self, observed: SegmentObservations, dt: float) -> FloatArray:
        return watch_stance(
            StanceSettings(),
            self._memory.stance,
            self._carries,
            self._gravity,
            observed.specific_force,
            observed.angular_rate,
            observed.status,
            dt,
        )

    def joint_agreement(self) -> dict[str, float]:
        """By segment: 0 when its module agrees with a neighbour's about their joint, about 1 when with none.

        Only segments of which the last seconds' motion tells it."""
        scores = segment_scores(self._joints, joint_scores(self._joints, self._memory.agreement))
        names = self._suit.skeleton.segment_names
        return {names[s]: round(float(scores[s]), 3) for s in np.flatnonzero(np.isfinite(scores))}

    def doubts(self) -> dict[int, str]:
        """Why the segments of some modules are doubtful, and what to do, by module id."""
        mounting, rows = self._memory.mounting, self._suit.module_of_segment
        return {
            self._suit.module_ids[rows[s]]: self._doubt(int(s)) for s in np.flatnonzero(mounting.is_doubtful)
        }

    def _doubt(self, s: int) -> str:
        """The reason in words of a segment that is doubtful, and a remedy."""
        mounting, names = self._memory.mounting, self._suit.skeleton.segment_names
        module, other, rival = (
            self._suit.module_ids[self._suit.module_of_segment[k]]
            for k in (s, int(mounting.partner[s]), int(mounting.rival[s]))
        )
        if mounting.partner[s] != s:
            place = names[mounting.partner[s]]
            return (
                f"{_spoken(names[s])} and {_spoken(place)} move as if their modules had changed places: "
                f"check that module {module} is on the {_spoken(names[s])} and module {other} on the "
                f"{_spoken(place)}, or exchange them with 'modules assign'"
            )
        near = [int(p) for p in (self._joints.parents[s],) if p >= 0]
        near += [int(c) for c in np.flatnonzero(self._joints.parents == s)]
        around = " and ".join(_spoken(names[k]) for k in near)
        degrees = math.degrees(math.acos(min(max((np.trace(mounting.turn[s]) - 1.0) / 2.0, -1.0), 1.0)))
        either = (
            ""
            if mounting.rival[s] == NOBODY
            else f" (or module {rival} on the {_spoken(names[mounting.rival[s]])})"
        )
        return (
            f"{_spoken(names[s])} and {around} disagree about the joint between them, as if module {module} "
            f"were turned by {degrees:.0f}°{either}: check that it is worn as the rig says, or run "
            "'calibrate body'"
        )

    def _without_stuck(self, observation: ImuFrame, dt: float) -> ImuFrame:
        force, rate = (
            np.array(v, np.float64, order="C") for v in (observation.specific_force, observation.angular_rate)
        )
        status = np.array(observation.status, np.uint8)
        stuck = stuck_modules(self._memory.repeats, force, rate, status, dt).astype(bool)
        if not stuck.any():
            return observation
        field = np.array(observation.magnetic_field, np.float64)
        force[stuck], rate[stuck], field[stuck] = np.nan, np.nan, np.nan
        status[stuck] = Status.MISSING
        return replace(
            observation, specific_force=force, angular_rate=rate, magnetic_field=field, status=status
        )

    def finish(self, found: SkeletonFrame, prepared: Prepared) -> SkeletonFrame:
        """What is done after the finder, to instants in time order."""
        _, observed, resting, dt = prepared
        q_wb, rate = np.array(found.q_wb, np.float64), np.array(found.angular_rate, np.float64)
        sigma, status = np.array(found.sigma, np.float64), np.array(found.status, np.uint8)
        _tell_clipped(status, observed)
        agreement, mounting = self._memory.agreement, self._memory.mounting
        watch_joints(self._joints, agreement, q_wb, observed.specific_force, rate, status, dt)
        judge_mounting(self._joints, agreement, self._worn, mounting, dt)
        tell_doubtful(status, sigma, mounting.is_doubtful)
        follow(self._rules, q_wb, rate, sigma, status)
        p_w, root = found.p_w, found.root
        if self._contacts is not None:
            place, stands_on = advance_position(
                self._contacts,
                PositionSettings(),
                self._memory.position,
                q_wb,
                np.nan_to_num(rate),
                observed.specific_force,
                resting,
                dt,
            )
            p_w = joint_positions(self._parents, self._offsets, q_wb, place)
            root = stands_on if stands_on >= 0 else root
        elif len(self._rules.segments):
            p_w = joint_positions(self._parents, self._offsets, q_wb, np.array(p_w[0]))
        return replace(found, q_wb=q_wb, angular_rate=rate, sigma=sigma, status=status, p_w=p_w, root=root)

    def state(self) -> dict[str, NDArray[np.generic]]:
        """All that is remembered, as arrays. Raises ``TypeError`` if the finder cannot tell its state."""
        if not isinstance(self.finder, _Resumable):
            raise TypeError(f"{type(self.finder).__name__} cannot be saved and resumed")
        state = dict(self.finder.state())
        for part, memory in self._memory._asdict().items():
            state |= {f"{part}.{name}": array.copy() for name, array in memory._asdict().items()}
        state |= {f"last.{name}": getattr(self._last, name).copy() for name in _POSE_ARRAYS}
        return state | {"time_ns.whole_body": np.array([self._time_ns]), "last.numbers": _numbers(self._last)}

    def set_state(self, state: dict[str, NDArray[np.generic]]) -> None:
        """Go on from a saved state. Raises ``ValueError`` if it is of another body."""
        if not isinstance(self.finder, _Resumable):
            raise TypeError(f"{type(self.finder).__name__} cannot be saved and resumed")
        for part, memory in self._memory._asdict().items():
            for name, array in memory._asdict().items():
                saved = state.get(f"{part}.{name}")
                if saved is None or saved.shape != array.shape:
                    raise ValueError(f"the saved state's '{part}.{name}' does not fit this body")
                array[...] = saved
        sequence, time_ns, root = (int(number) for number in state["last.numbers"])
        arrays: dict[str, Any] = {name: state[f"last.{name}"].copy() for name in _POSE_ARRAYS}
        self._last = replace(self._last, sequence=sequence, time_ns=time_ns, root=root, **arrays)
        self._time_ns = int(state["time_ns.whole_body"][0])
        self.finder.set_state(state)

    def _compile(self) -> None:
        """A few frames, so that every kernel is compiled before the first real one comes."""
        m = len(self._suit.module_ids)
        ones, none = np.ones((m, 3)), np.zeros(m, np.int64)
        for k in range(2):
            self.update(ImuFrame(k, k * 10_000_000, ones, 0.1 * ones, ones, none.astype(np.uint8), none))


_POSE_ARRAYS = ("q_wb", "angular_rate", "joint_acceleration", "p_w", "sigma", "status")


def no_pose(n: int) -> SkeletonFrame:
    """Return the pose of n segments of which nothing is known."""
    q_wb, rate, acceleration, p_w = (np.full((n, size), np.nan) for size in (4, 3, 3, 3))
    status = np.full(n, Status.MISSING, np.uint8)
    return SkeletonFrame(0, 0, q_wb, rate, acceleration, p_w, np.full(n, np.nan), status, 0)


def _numbers(pose: SkeletonFrame) -> IntArray:
    """Return what a pose holds beside its arrays."""
    return np.array([pose.sequence, pose.time_ns, pose.root], np.int64)


@runtime_checkable
class _BatchFinder(Protocol):
    """A finder that takes many frames in one call."""

    def update_many(
        self, observations: Sequence[ImuFrame], resting: FloatArray | None = None
    ) -> list[SkeletonFrame]: ...


@runtime_checkable
class _Resumable(Protocol):
    """A finder whose state can be saved."""

    def state(self) -> dict[str, NDArray[np.generic]]: ...

    def set_state(self, state: dict[str, NDArray[np.generic]]) -> None: ...


def tell_doubtful(status: StatusArray, sigma: FloatArray, is_doubtful: StatusArray) -> None:
    """In place: measured segments that are doubtful; nothing is known of how they are turned."""
    if is_doubtful.any():
        told = (is_doubtful > 0) & (status <= Status.INTERPOLATED)
        status[told], sigma[told] = Status.DOUBTFUL, UNKNOWN


def _spoken(segment: str) -> str:
    return segment.replace("_", " ")


def _tell_clipped(status: StatusArray, observed: SegmentObservations) -> None:
    """In place: whoever found the orientations, a gyrometer at the end of its range does not say how far its
    segment has turned, nor such an accelerometer where down is."""
    is_told = status <= Status.INTERPOLATED
    status[is_told & (observed.clipped & Clipped.SPECIFIC_FORCE > 0)] = Status.UNAIDED
    status[is_told & (observed.clipped & Clipped.ANGULAR_RATE > 0)] = Status.PREDICTED


def _contacts(suit: WornSuit, root: RootSettings) -> Contacts | None:
    """None where the root does not walk."""
    skeleton = suit.skeleton
    is_placed = any(device.quantity is Quantity.POSITION for device in suit.local_devices)
    walks = root.mode is RootMode.WALKING or (
        root.mode is RootMode.AUTO and bool(skeleton.contacts) and not is_placed
    )
    if not walks:
        return None
    if not skeleton.contacts:
        raise ValueError(NO_CONTACTS.format(skeleton.name))
    with_module = np.flatnonzero(suit.module_of_segment >= 0)
    own_root = int(np.flatnonzero(skeleton.parents < 0)[0])
    reference = own_root if own_root in with_module else int(with_module[0])
    return Contacts(
        parents=skeleton.parents.astype(np.int64),
        offsets=np.array(skeleton.offsets, np.float64),
        segments=np.array([segment for segment, _ in skeleton.contacts], np.int64),
        points=np.array([point for _, point in skeleton.contacts], np.float64),
        reference=reference,
        arm=np.array(suit.lever_arms[reference], np.float64),
        gravity=np.array(suit.gravity, np.float64),
        has_floor=root.has_floor,
        floor=float(root.floor),  # of a whole number, the kernel is compiled once more
    )
