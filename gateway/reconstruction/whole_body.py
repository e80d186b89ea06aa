"""What is the same whatever finds the orientations: before it and after it.

ImuFrame → stuck modules left out → (rest of each segment) → orientations → segments without module
         → where the body is in the world → SkeletonFrame
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from gateway.body.interpolation import following_rules
from gateway.body.skeleton import WornSuit
from gateway.frames import FloatArray, ImuFrame, IntArray, Quantity, SkeletonFrame, unknown_pose
from gateway.geometry.compiled import for_types_of
from gateway.geometry.records import Records, records
from gateway.reconstruction.inertial.contacts import (
    ContactPlace,
    PositionState,
    StanceState,
    Walk,
    initial_position,
    initial_stance,
)
from gateway.reconstruction.inertial.observations import sensor_to_segment_matrices
from gateway.reconstruction.joint_agreement import (
    AgreementState,
    initial_agreement,
    joint_scores,
    joints_of,
    segment_scores,
)
from gateway.reconstruction.module_faults import RepeatState, initial_repeats
from gateway.reconstruction.mounting import (
    NOBODY,
    MountingState,
    initial_mounting,
    judge_mounting,
    rig_mounting,
)
from gateway.reconstruction.root_settings import NO_CONTACTS, RootMode, RootSettings
from gateway.reconstruction.stacked_frames import (
    POSE_ARRAYS,
    Poses,
    StackedFrames,
    stacked,
    stacked_poses,
    unstacked,
)
from gateway.reconstruction.whole_body_frames import (
    NEVER_NS,
    After,
    Before,
    SegmentFrames,
    finish_frames,
    observe_frames,
    prepare_frames,
    segment_room,
)

_STUCK_FIELD = (
    "its magnetometer repeats one reading while the module turns, so it is left out: switch the module off "
    "and on; if that does not help, the sensor is broken"
)


class OrientationFinder(Protocol):
    """What this wraps: any reconstructor."""

    def update(self, observation: ImuFrame, stood_s: FloatArray | None = None) -> SkeletonFrame:
        """Return orientations at the instant of a frame. stood_s: (S,) s that each segment has been at
        rest."""
        ...

    def reset(self) -> None:
        """Forget everything but the parameters."""
        ...


@runtime_checkable
class HasCertainty(Protocol):
    """A finder that knows how sure it is of tilts and headings apart."""

    def certainty(self) -> dict[str, dict[str, float | str | None]]:
        """Return, by segment, standard deviations in rad, and what shows the heading."""
        ...


class Prepared(NamedTuple):
    """T instants as the finder is given them, and what is done after it needs to know of them."""

    observations: Sequence[ImuFrame]
    """Without modules and magnetometers that are stuck."""
    frames: StackedFrames
    """The same, in arrays."""
    segments: SegmentFrames
    """What was found of the segments themselves."""

    @property
    def stood_s(self) -> FloatArray:
        """(T, n) for how long each segment stands still, s; 0: it does not."""
        return self.segments.stood_s


class _Memory(NamedTuple):
    """All state besides the finder's."""

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
    their sigma is that of an unknown orientation; their orientations stay as they were found.
    ``joint_agreement``: see that module.
    """

    def __init__(self, suit: WornSuit, finder: OrientationFinder, root: RootSettings | None = None) -> None:
        """Create the reconstructor and compile its kernels.

        Raises ``ValueError`` if the root shall walk and the body has no contacts.
        """
        self._suit = suit
        self.finder = finder
        self._array_finder = finder if isinstance(finder, _ArrayFinder) else None
        self._joints, self._mounting = joints_of(suit), rig_mounting(suit)
        self._places, self._walks = _ground(suit, root or RootSettings())
        self._prepare_frames: Callable[..., bool] = prepare_frames
        self._finish_frames: Callable[..., int] = finish_frames
        self.reset()
        self._compile()
        self.reset()

    def reset(self) -> None:
        """Forget everything but the parameters."""
        self.finder.reset()
        n = self._suit.skeleton.n_segments
        self._last = unknown_pose(n)
        self._clock = np.full(1, NEVER_NS, np.int64)
        self._memory = _Memory(
            initial_stance(n),
            initial_position(len(self._places)),
            initial_repeats(len(self._suit.module_ids)),
            initial_agreement(n),
            initial_mounting(n),
        )
        self._before, self._after = self._before_finder(), self._after_finder()

    def _before_finder(self) -> Before:
        suit, n = self._suit, self._suit.skeleton.n_segments
        carries = np.zeros(n)
        carries[[segment for segment, _ in suit.skeleton.contacts]] = 1.0
        return Before(
            module_of_segment=suit.module_of_segment.astype(np.int64),
            R_bs=sensor_to_segment_matrices(suit),
            carries=carries,
            gravity=np.array([np.linalg.norm(suit.gravity)], np.float64),
            clock=self._clock,
            repeats=self._memory.repeats,
            stance=self._memory.stance,
        )

    def _after_finder(self) -> After:
        skeleton, memory = self._suit.skeleton, self._memory
        return After(
            judged=memory.mounting.since_s,
            is_doubtful=memory.mounting.is_doubtful,
            joints=self._joints,
            agreement=memory.agreement,
            rules=following_rules(self._suit),
            parents=skeleton.parents.astype(np.int64),
            offsets=np.array(skeleton.offsets, np.float64),
            places=self._places,
            walks=self._walks,
            position=memory.position,
        )

    def update(self, observation: ImuFrame) -> SkeletonFrame:
        """Return the pose of one instant.

        Raises nothing: what is not defined is NaN, and ``status`` says why.
        """
        return self.update_many((observation,))[0]

    def update_many(self, observations: Sequence[ImuFrame]) -> list[SkeletonFrame]:
        """Return the poses of instants in time order; the same as by ``update`` of each, bit for bit."""
        newest_ns, is_later = int(self._clock[0]), []
        for observation in observations:
            is_later.append(observation.time_ns > newest_ns)
            newest_ns = max(newest_ns, observation.time_ns)
        if all(is_later):
            poses = self._solved(observations)
            self._last = poses[-1] if poses else self._last
            return poses
        later = [one for one, counts in zip(observations, is_later, strict=True) if counts]
        solved, poses = iter(self._solved(later)), []
        for observation, counts in zip(observations, is_later, strict=True):
            self._last = next(solved) if counts else replace(self._last, sequence=observation.sequence)
            poses.append(self._last)
        return poses

    def _solved(self, observations: Sequence[ImuFrame]) -> list[SkeletonFrame]:
        """Return the poses of instants each later than the one before."""
        if not observations:
            return []
        prepared = self.prepare(observations)
        return self.finish(self._found(prepared), prepared)

    def prepare(self, observations: Sequence[ImuFrame]) -> Prepared:
        """Return instants in time order, at least one, prepared for the finder.

        Stuck modules and magnetometers are left out, and it is found how long each segment has been standing
        still.
        """
        frames = stacked(observations)
        segments = segment_room(len(observations), self._suit.skeleton.n_segments)
        if self._prepare_frames(frames, segments, self._before):
            observations = unstacked(observations, frames)
        return Prepared(observations, frames, segments)

    def prepared_again(
        self, observations: Sequence[ImuFrame], stood_s: FloatArray, dt: FloatArray
    ) -> Prepared:
        """Return what ``prepare`` made of instants once, from its own ``observations`` and arrays."""
        frames = stacked(observations)
        segments = segment_room(len(observations), self._suit.skeleton.n_segments)
        segments.stood_s[...], segments.dt[...] = stood_s, dt
        observe_frames(frames, segments, self._before)
        return Prepared(observations, frames, segments)

    def _found(self, prepared: Prepared) -> Poses:
        finder, stood_s = self.finder, prepared.stood_s
        if self._array_finder is not None:
            return self._array_finder.poses(prepared.observations, prepared.frames, stood_s)
        found = [
            finder.update(observation, rest)
            for observation, rest in zip(prepared.observations, stood_s, strict=True)
        ]
        return stacked_poses(found)

    def finish(self, poses: Poses, prepared: Prepared) -> list[SkeletonFrame]:
        """Return poses after all that follows the finder, in time order; ``poses`` are changed in place.

        Segments without a module are filled in, modules worn otherwise are marked, the body is placed in the
        world.
        """
        arrays, memory, n_frames = poses.arrays(), self._memory, len(poses.root)
        first = self._finish_frames(0, 0, arrays, prepared.segments, self._after)
        while first < n_frames:
            judge_mounting(self._joints, memory.agreement, self._mounting, memory.mounting)
            first = self._finish_frames(first, first + 1, arrays, prepared.segments, self._after)
        return poses.frames()

    def certainty(self) -> dict[str, dict[str, float | str | None]]:
        """Return how sure each segment's tilt and heading are, and what shows the heading.

        Empty if the finder does not know.
        """
        return self.finder.certainty() if isinstance(self.finder, HasCertainty) else {}

    def joint_agreement(self) -> dict[str, float]:
        """Return by segment how its module and its best neighbour agree about their joint.

        0: fully, about 1: not at all. Only segments that the motion of the last seconds is enough for.
        """
        scores = segment_scores(self._joints, joint_scores(self._joints, self._memory.agreement))
        names = self._suit.skeleton.segment_names
        return {names[s]: round(float(scores[s]), 3) for s in np.flatnonzero(np.isfinite(scores))}

    def doubts(self) -> dict[int, str]:
        """Return by module id what speaks against it, and a remedy.

        That is why its segment is doubtful, or that its magnetometer is stuck.
        """
        mounting, rows = self._memory.mounting, self._suit.module_of_segment
        ids, repeats = self._suit.module_ids, self._memory.repeats.modules
        stuck = {ids[m]: _STUCK_FIELD for m in np.flatnonzero(repeats["has_stuck_field"])}
        return stuck | {ids[rows[s]]: self._doubt(int(s)) for s in np.flatnonzero(mounting.is_doubtful)}

    def _doubt(self, s: int) -> str:
        """Return why a segment is doubtful, and a remedy, in words."""
        mounting, names = self._memory.mounting, self._suit.skeleton.segment_names
        module, other, rival = (
            self._suit.module_ids[self._suit.module_of_segment[k]]
            for k in (s, int(mounting.partner[s]), int(mounting.rival[s]))
        )
        if mounting.partner[s] != s:
            place = names[mounting.partner[s]]
            return (
                f"{_in_words(names[s])} and {_in_words(place)} move as if their modules had changed places: "
                f"check that module {module} is on the {_in_words(names[s])} and module {other} on the "
                f"{_in_words(place)}, or exchange them with 'modules assign'"
            )

        near = [int(p) for p in (self._joints.sides[s].parent,) if p >= 0]
        near += [int(c) for c in np.flatnonzero(self._joints.sides["parent"] == s)]
        around = " and ".join(_in_words(names[k]) for k in near)

        degrees = math.degrees(math.acos(min(max((np.trace(mounting.turn[s]) - 1.0) / 2.0, -1.0), 1.0)))
        either = (
            ""
            if mounting.rival[s] == NOBODY
            else f" (or module {rival} on the {_in_words(names[mounting.rival[s]])})"
        )
        return (
            f"{_in_words(names[s])} and {around} disagree about the joint between them, as if module "
            f"{module} were turned by {degrees:.0f}°{either}: check that it is worn as the rig says, or run "
            "'calibrate body'"
        )

    def state(self) -> dict[str, NDArray[np.generic]]:
        """Return all state, as arrays by name. Raises ``TypeError`` if the finder cannot be saved."""
        if not isinstance(self.finder, _Resumable):
            raise TypeError(f"{type(self.finder).__name__} cannot be saved and resumed")
        state = dict(self.finder.state())
        for part, memory in self._memory._asdict().items():
            state |= {f"{part}.{name}": array.copy() for name, array in memory._asdict().items()}
        state |= {f"last.{name}": getattr(self._last, name).copy() for name in POSE_ARRAYS}
        return state | {"time_ns.whole_body": self._clock.copy(), "last.numbers": _numbers(self._last)}

    def set_state(self, state: dict[str, NDArray[np.generic]]) -> None:
        """Set a saved state, to go on from it.

        Raises ``ValueError`` if it is of another body, ``TypeError`` if the finder cannot be resumed.
        """
        if not isinstance(self.finder, _Resumable):
            raise TypeError(f"{type(self.finder).__name__} cannot be saved and resumed")
        for part, memory in self._memory._asdict().items():
            for name, array in memory._asdict().items():
                saved = state.get(f"{part}.{name}")
                if saved is None or saved.shape != array.shape:
                    raise ValueError(f"the saved state's '{part}.{name}' does not fit this body")
                array[...] = saved
        sequence, time_ns, root = (int(number) for number in state["last.numbers"])
        arrays: dict[str, Any] = {name: state[f"last.{name}"].copy() for name in POSE_ARRAYS}
        self._last = replace(self._last, sequence=sequence, time_ns=time_ns, root=root, **arrays)
        self._clock[0] = state["time_ns.whole_body"][0]
        self.finder.set_state(state)

    def _compile(self) -> None:
        """Feed a few frames, so that every kernel is compiled before the first real frame comes."""
        m = len(self._suit.module_ids)
        ones, none = np.ones((m, 3)), np.zeros(m, np.int64)
        for k in range(2):
            frame = ImuFrame(k, k * 10_000_000, ones, 0.1 * ones, ones, none.astype(np.uint8), none)
            self.update(frame)
        room = segment_room(1, self._suit.skeleton.n_segments)
        self._prepare_frames = for_types_of(prepare_frames, stacked((frame,)), room, self._before)
        pose = stacked_poses((self._last,)).arrays()
        self._finish_frames = for_types_of(finish_frames, 0, 0, pose, room, self._after)


def _numbers(pose: SkeletonFrame) -> IntArray:
    """Return what a pose holds beside its arrays."""
    return np.array([pose.sequence, pose.time_ns, pose.root], np.int64)


@runtime_checkable
class _ArrayFinder(Protocol):
    """A finder that takes many frames in one call, in arrays."""

    def poses(self, observations: Sequence[ImuFrame], frames: StackedFrames, stood_s: FloatArray) -> Poses:
        """Return the poses of frames in order. stood_s: (T, S) s that each segment has been at rest."""
        ...


@runtime_checkable
class _Resumable(Protocol):
    """A finder whose state can be saved."""

    def state(self) -> dict[str, NDArray[np.generic]]:
        """Return all that it keeps from frame to frame, by name."""
        ...

    def set_state(self, state: dict[str, NDArray[np.generic]]) -> None:
        """Go on from what ``state`` returned."""
        ...


def _in_words(segment: str) -> str:
    return segment.replace("_", " ")


def _ground(suit: WornSuit, root: RootSettings) -> tuple[Records[ContactPlace], Records[Walk]]:
    """Return what the body stands on and how it walks; none of either where the root does not walk."""
    skeleton = suit.skeleton
    is_placed = any(device.quantity is Quantity.POSITION for device in suit.local_devices)
    walks = root.mode is RootMode.WALKING or (
        root.mode is RootMode.AUTO and bool(skeleton.contacts) and not is_placed
    )
    if not walks:
        return records(ContactPlace, 0), records(Walk, 0)
    if not skeleton.contacts:
        raise ValueError(NO_CONTACTS.format(skeleton.name))
    with_module = np.flatnonzero(suit.module_of_segment >= 0)
    own_root = int(np.flatnonzero(skeleton.parents < 0)[0])
    places, all_walks = records(ContactPlace, len(skeleton.contacts)), records(Walk, 1)
    for place, (segment, point) in zip(np.asarray(places), skeleton.contacts, strict=True):
        place["segment"], place["point"] = segment, point
    walk = all_walks[0]
    walk.reference = own_root if own_root in with_module else int(with_module[0])
    walk.arm[:], walk.gravity[:] = suit.lever_arms[walk.reference], suit.gravity
    walk.has_floor, walk.floor = int(root.has_floor), root.floor
    return places, all_walks
