"""The articulated estimators: ``joint`` (the whole tree in one filter) and ``outward`` (segment by segment).

Both observe the same: every joint's acceleration from both sides, every local device, the field where it
is undisturbed, rest. ``docs/explanation/estimator.md`` states the model, and where each part of it is
computed. Fast motion is what they live on: it shows the headings.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gateway.body.skeleton import WornSuit
from gateway.frames import FloatArray, ImuFrame, IntArray, Quantity, SkeletonFrame
from gateway.geometry.compiled import for_types_of
from gateway.geometry.records import array_of
from gateway.reconstruction.inertial.local_devices import PlaceKeeper, RootMotion, in_segment_axes
from gateway.reconstruction.inertial.tree.headings import stacked_sights
from gateway.reconstruction.inertial.tree.smoothing import turned_back
from gateway.reconstruction.inertial.tree.state import (
    NEVER_NS,
    Heading,
    Started,
    State,
    chain_body,
    initial_state,
    work_space,
)
from gateway.reconstruction.inertial.tree.step import (
    SHORTEST_STEP_S,
    Filter,
    Inputs,
    advance,
    room_for,
    wearing_of,
)
from gateway.reconstruction.inertial.tree.tuning import Tuning, tuning
from gateway.reconstruction.stacked_frames import Poses, StackedFrames, stacked

STATE_VERSION = 14
"""Of what ``state`` returns. 1 had an array for every quantity, 2 a clock that began at −1, 3 other names."""
_FRAMES_AT_ONCE = 16
"""Live frames that room is made for at once."""
SHOWN_HEADING = 0.35
"""rad: a heading less sure than that against its parent is no longer called observed."""
READINGS_AT_ONCE = 8
"""Of local devices, for which a live frame has room made beforehand."""


@dataclass(frozen=True, slots=True)
class ChainSettings:
    """Parameters of the chain estimators; the defaults serve all bodies and motions."""

    tuning: Tuning = field(default_factory=tuning)
    uses_field: bool = True
    """Whether the earth's field leads headings; the more its norm and dip are off, the less."""
    longest_hold_s: float = 0.25
    """Age up to which a measured position of the root is passed on."""


class ChainReconstructor:
    """Joint or outward filter over a body. Compiles in the constructor (cached on disk).

    Every segment's orientation is defined from its module's first sample on. status: the module's, PREDICTED
    while it is silent (the orientation coasts, then stays) and for segments without module (as the
    parent), UNAIDED where all local devices of the chain have fallen silent or the accelerometer is
    saturated, MISSING before the first sample. sigma: root of the expected square of the error's angle, rad;
    above 1.6 while the heading is not known. angular_rate: bias taken off. joint_acceleration: after the
    low-pass of the rows; NaN where the module is silent or saturated. A module needs its gyroscopes.
    A frame that is not later than the one before changes nothing.
    """

    is_tree = True

    def __init__(
        self, suit: WornSuit, nominal_interval_s: float, settings: ChainSettings | None = None
    ) -> None:
        self._settings = settings = settings or ChainSettings()
        self._suit, self._nominal_interval_s = suit, nominal_interval_s
        self._n = suit.skeleton.n_segments
        self._body = chain_body(suit, settings.uses_field, self.is_tree, settings.tuning)
        device = suit.local_devices[0] if suit.local_devices else None
        self._device = device
        self._root = device.segment if device else int(np.flatnonzero(suit.skeleton.parents < 0)[0])
        self._devices = [d for d in suit.local_devices if suit.module_of_segment[d.segment] >= 0]
        placing = [d for d in suit.local_devices if d.quantity is Quantity.POSITION]
        placing.sort(key=lambda d: int(suit.skeleton.parents[d.segment]) >= 0)  # best on the root itself
        self._measures_place = bool(placing)
        self._root_motion = RootMotion(placing[0] if placing else None, settings.longest_hold_s)
        self._place = PlaceKeeper()
        self._wearing = wearing_of(suit, placing[0] if placing else None, nominal_interval_s)
        self._no_readings = np.zeros((0, 8))
        self._no_covariance = np.zeros((0, self._n, 2, 3, 3))
        self._never_resting = np.zeros((1, self._n))
        self._room, self._used = room_for(_FRAMES_AT_ONCE, self._n), 0
        """Live frames are views of it; when it is full another takes its place."""
        self._compile(len(suit.module_ids))
        self.reset()

    def reset(self) -> None:
        """Forget everything but the parameters."""
        self._use(initial_state(self._n, len(self._devices)))
        self._root_motion.reset()
        self._place.reset()

    def state(self) -> dict[str, NDArray[np.generic]]:
        """Return all state, as arrays by name."""
        state = self._state
        filtered = {"segments": state.segments.copy(), "devices": state.devices.copy()}
        clock = np.array([state.clock.last_ns, state.clock.first_ns])
        version = np.array([STATE_VERSION])
        return (
            filtered | {"clock": clock, "version": version} | self._root_motion.places() | self._place.state()
        )

    def set_state(self, state: dict[str, NDArray[np.generic]]) -> None:
        """Set a saved state, with which the filter goes on as if never interrupted, bit for bit.

        Raises ``ValueError`` if it is of another body, or of another version of this filter.
        """
        version = int(state["version"][0]) if "version" in state else 1
        if version != STATE_VERSION:
            raise ValueError(f"the saved state is of version {version}; this is version {STATE_VERSION}")
        for name, array in self.state().items():
            if name not in state or state[name].shape != array.shape:
                raise ValueError(f"the saved state's {name!r} does not fit this body of {self._n} segments")
        fresh = initial_state(self._n, len(self._devices))
        for name, records in (("segments", fresh.segments), ("devices", fresh.devices)):
            if state[name].dtype.descr != np.asarray(records).dtype.descr:
                raise ValueError(f"the saved state's {name!r} have other fields than those of this version")
            records[...] = state[name]
        fresh.clock.last_ns, fresh.clock.first_ns = state["clock"]
        self._use(fresh)
        self._root_motion.set_places(state)
        self._place.set_state(state)

    def certainty(self) -> dict[str, dict[str, float | str | None]]:
        """Return how well each segment's orientation is known, by the names of segments that have started.

        ``sigma_tilt``, ``sigma_heading`` (in the world) and ``sigma_relative`` (orientation against the
        parent; None for a root) are standard deviations, rad. ``heading`` is what shows the heading, against
        the parent or, of a root, in the world: ``observed`` (motion, a device or the sun), ``by field`` (the
        field alone), ``held`` (gyroscopes alone).
        """
        names, links, segments = self._suit.skeleton.segment_names, self._body.segments, self._state.segments
        # (68) the tilts that constant errors of two accelerometers leave
        lasting = 4.0 * (self._settings.tuning.force_bias / float(np.linalg.norm(self._suit.gravity))) ** 2
        found: dict[str, dict[str, float | str | None]] = {}
        for s in range(self._n):
            segment, p = segments[s], links[s].parent
            if segment.started == Started.NO:
                continue
            is_shown = segment.heading == Heading.OBSERVED
            tilt_square = float(segment.published[0, 0] + segment.published[1, 1])
            relative = None
            if p >= 0:
                C = segment.C[:3, :3]
                between = segment.P[:3, :3] + segments[p].P[:3, :3] - C - C.T
                is_shown = is_shown and bool(between[2, 2] < SHOWN_HEADING**2)
                # (68a) what motion shows of a heading is shown by the joint
                heading = float(between[2, 2]) * (min(segment.tilt_share, 1.0) if is_shown else 1.0)
                tilt = segment.tilt_share * float(np.trace(between[:2, :2])) + lasting
                missed = 3.0 * (segment.gap.missed + segments[p].gap.missed)
                relative = math.sqrt(max(tilt + heading + missed, 0.0))
            else:
                is_shown = is_shown and links[s].heading_observable == 1
            compass = segment.compass
            uses_compass = self._body.world.uses_field == 1 and compass.seconds > 0.0
            found[names[s]] = {
                "sigma_tilt": math.sqrt(tilt_square),
                "sigma_heading": math.sqrt(float(segment.published[2, 2])),
                "sigma_relative": relative,
                "heading": "observed" if is_shown else "by field" if uses_compass else "held",
            }
        return found

    def turned_back(self) -> ChainReconstructor:
        """Return the same estimator, to go backward from where this one is; see ``smoothing``."""
        back = type(self)(self._suit, self._nominal_interval_s, self._settings)
        gravity = self._body.world.gravity
        back._use(turned_back(self._state, self._settings.tuning, gravity, self.is_tree))
        return back

    def _use(self, state: State) -> None:
        self._state = state
        work = work_space(self._n)
        held = Filter(self._wearing, self._body, state, self._settings.tuning, work)
        self._arrays: Any = held.arrays()
        self._began: IntArray = array_of(state.clock)["first_ns"]
        """(1,) ns; of a record each attribute takes a microsecond."""

    def update(self, observation: ImuFrame, stood_s: FloatArray | None = None) -> SkeletonFrame:
        """Return the pose of one instant.

        Raises nothing: what is not defined is NaN, and ``status`` says why. stood_s: (n_segments,) s for how
        long each has stood still, 0: not; see ``contacts``.
        """
        if self._used == _FRAMES_AT_ONCE:
            self._room, self._used = room_for(_FRAMES_AT_ONCE, self._n), 0
        k = self._used
        self._used += 1
        self._advance(
            self._never_resting if stood_s is None else stood_s[None],
            self._no_covariance,
            *self._inputs_of_one(observation),
            *self._arrays,
            k,
            *self._room,
        )
        q_wb, rate, acceleration, p_w, sigma, status = self._room
        return SkeletonFrame(
            observation.sequence, observation.time_ns, q_wb[k], rate[k], acceleration[k], p_w[k], sigma[k],
            status[k], self._root,
        )  # fmt: skip

    def update_many(
        self,
        observations: Sequence[ImuFrame],
        stood_s: FloatArray | None = None,
        covariance: FloatArray | None = None,
    ) -> list[SkeletonFrame]:
        """Return the poses of instants in time order.

        They are the same as by ``update`` of each, bit for bit, but found faster. stood_s: (T, n_segments) as
        there. covariance: (T, n_segments, 2, 3, 3) is filled with that of the orientation errors, world axes,
        rad²: the estimate's own, and the one that ``sigma`` is made of.
        """
        if not observations:
            return []
        rest = np.zeros((len(observations), self._n)) if stood_s is None else stood_s
        return self.poses(observations, stacked(observations), rest, covariance).frames()

    def poses(
        self,
        observations: Sequence[ImuFrame],
        frames: StackedFrames,
        stood_s: FloatArray,
        covariance: FloatArray | None = None,
    ) -> Poses:
        """Return the same as ``update_many`` in arrays. frames: the observations, stacked."""
        wanted = self._no_covariance if covariance is None else covariance
        room = room_for(len(observations), self._n)
        is_one = len(observations) == 1
        inputs = self._inputs_of_one(observations[0]) if is_one else self._inputs(observations, frames)
        self._advance(np.ascontiguousarray(stood_s), wanted, *inputs, *self._arrays, 0, *room)
        return Poses(
            [observation.sequence for observation in observations],
            [observation.time_ns for observation in observations],
            *room,
            np.full(len(observations), self._root),
        )

    def _inputs_of_one(self, observation: ImuFrame) -> Inputs:
        """Return the kernel's inputs of one frame, in arrays made once where they are large enough.

        Live, making arrays takes longer than the filter of some segments.
        """
        rows = self._rows_of(observation, self._first_ns(observation)) if observation.local else []
        if observation.sun is not None or self._measures_place or len(rows) > READINGS_AT_ONCE:
            return self._inputs((observation,), stacked((observation,)))
        one = self._one
        one.time_ns[0] = observation.time_ns
        one.specific_force[...] = observation.specific_force
        one.angular_rate[...] = observation.angular_rate
        one.magnetic_field[...] = observation.magnetic_field
        one.status[...] = observation.status
        if observation.clipped is None:
            one.clipped.fill(0)
        else:
            one.clipped[...] = observation.clipped
        one.readings_end[0] = len(rows)
        if rows:
            one.readings[: len(rows)] = rows
        return one

    def _inputs(self, observations: Sequence[ImuFrame], frames: StackedFrames) -> Inputs:
        readings, readings_end = self._no_readings, np.zeros(len(observations), np.int64)
        if any(observation.local for observation in observations):
            readings, readings_end = self._readings(observations)
        return Inputs(
            *frames,
            self._root_positions(observations),
            readings_end,
            readings,
            stacked_sights(observations),
        )

    def _readings(self, observations: Sequence[ImuFrame]) -> tuple[FloatArray, IntArray]:
        first_ns = self._first_ns(observations[0])
        rows: list[tuple[float, ...]] = []
        ends = []
        for observation in observations:
            rows += self._rows_of(observation, first_ns)
            ends.append(len(rows))
        return np.array(rows, np.float64).reshape(-1, 8), np.array(ends, np.int64)

    def _first_ns(self, observation: ImuFrame) -> int:
        """Return when the filter's seconds begin, ns: the observation's time, if this is the first frame."""
        first_ns = int(self._began[0])
        return observation.time_ns if first_ns == NEVER_NS else first_ns

    def _rows_of(self, observation: ImuFrame, first_ns: int) -> list[tuple[float, ...]]:
        """Return the readings of the filter's devices, each as a row of ``Inputs.readings``."""
        return [
            (
                d,
                (reading.time_ns - first_ns) * 1e-9,
                *in_segment_axes(device, reading.value).tolist(),
                *reading.sigma.tolist(),
            )
            for reading in observation.local
            for d, device in enumerate(self._devices)
            if reading.device == device.device and reading.quantity == device.quantity
        ]

    def _root_positions(self, observations: Sequence[ImuFrame]) -> FloatArray:
        """Return where the device that measures a position is, (T, 3) m; without such a device, zeros."""
        positions = np.zeros((len(observations), 3))
        if self._measures_place:
            latest_ns = int(self._state.clock.last_ns)
            for position, observation in zip(positions, observations, strict=True):
                if (observation.time_ns - latest_ns) * 1e-9 > SHORTEST_STEP_S:
                    latest_ns = observation.time_ns
                    self._root_motion.add(observation.local)
                measured = self._root_motion.position(observation.time_ns)
                position[:] = self._place.at(measured, observation.time_ns)
        return positions

    def _compile(self, n_modules: int) -> None:
        """Compile the kernel before the first frame comes, for arrays as ``_inputs`` makes them."""
        self.reset()
        ones, none = np.ones((n_modules, 3)), np.zeros(n_modules, np.int64)
        frame = ImuFrame(0, 0, ones, ones, ones, none.astype(np.uint8), none)
        self._one = self._inputs((frame,), stacked((frame,)))._replace(
            readings=np.zeros((READINGS_AT_ONCE, 8))
        )
        one = self._never_resting, self._no_covariance, *self._one
        self._advance: Callable[..., None] = for_types_of(advance, *one, *self._arrays, 0, *self._room)


class OutwardReconstructor(ChainReconstructor):
    """Every segment in a filter of 6 states for itself; its parent's orientation and covariance are handed
    down and nothing is handed back."""

    is_tree = False


JointReconstructor = ChainReconstructor
