"""The articulated estimators: ``joint`` (the whole tree in one filter) and ``outward`` (segment by segment).

Both observe the same: every joint's acceleration from both sides, every local device, the field where it
is undisturbed, rest. See ``tree_filter`` (the filter), ``chain_averages`` (why no rate is differenced),
``chain_rows`` (the equations), ``heading_start``, ``local_rows``. Fast motion is what they live on: it shows
the headings.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from gateway.body.kinematics import joint_positions
from gateway.body.skeleton import WornSuit
from gateway.frames import FloatArray, ImuFrame, Quantity, SkeletonFrame, Status, StatusArray
from gateway.geometry import quaternion
from gateway.geometry.compiled import compiled
from gateway.reconstruction.inertial.chain_prediction import turn_segments
from gateway.reconstruction.inertial.chain_state import (
    FilterState,
    Noise,
    chain_body,
    fixed_points,
    initial_state,
)
from gateway.reconstruction.inertial.chain_step import orientation_sigma, step
from gateway.reconstruction.inertial.local_device import RootMotion
from gateway.reconstruction.inertial.local_rows import take_reading
from gateway.reconstruction.inertial.observations import SegmentObservations, SegmentObserver

SHORTEST_STEP_S = 1e-5


@dataclass(frozen=True, slots=True)
class ChainSettings:
    """Parameters of the chain estimators; the defaults serve all bodies and motions."""

    noise: Noise = field(default_factory=Noise)
    uses_field: bool = True
    """Whether the earth's field tells headings: weakly, the less the more its norm and dip are off."""
    longest_hold_s: float = 0.25
    """Age up to which a measured position of the root is passed on."""


class ChainReconstructor:
    """Joint or outward filter over a body. Compiles in the constructor (cached on disk).

    Every segment's orientation is defined from its module's first sample on. status: the module's, PREDICTED
    while it is silent (the orientation coasts, then stays) and for segments without module (as the
    parent), MISSING before the first sample. sigma: root of the expected square of the error's angle, rad;
    above 1.6 while the heading is not known. angular_rate: bias taken off. joint_acceleration: after the
    low-pass of the rows; NaN where the module is silent or saturated. A module needs its gyrometers.
    A frame that is not later than the one before changes nothing.
    """

    is_joint = True

    def __init__(
        self, suit: WornSuit, nominal_interval_s: float, settings: ChainSettings | None = None
    ) -> None:
        self._settings = settings = settings or ChainSettings()
        self._interval_s = nominal_interval_s
        self._n = suit.skeleton.n_segments
        self._body = chain_body(suit, settings.uses_field)
        self._fixed = fixed_points(self._body)
        device = suit.local_devices[0] if suit.local_devices else None
        self._device = device
        self._root = device.segment if device else int(np.flatnonzero(suit.skeleton.parents < 0)[0])
        self._devices = [d for d in suit.local_devices if suit.module_of_segment[d.segment] >= 0]
        self._parents = suit.skeleton.parents.astype(np.int64)
        self._offsets = np.array(suit.skeleton.offsets, np.float64)
        self._has_module = suit.module_of_segment >= 0
        self._observer = SegmentObserver(suit)
        self._root_motion = RootMotion(device, settings.longest_hold_s)
        self._compile(len(suit.module_ids))
        self.reset()

    def reset(self) -> None:
        """Forget everything but the parameters."""
        self._state = initial_state(self._n, len(self._devices))
        self._root_motion.reset()

    def state(self) -> dict[str, NDArray[np.generic]]:
        """All that is remembered, as arrays; a position that is being interpolated is not part of it."""
        return {name: array.copy() for name, array in self._state._asdict().items()}

    def set_state(self, state: dict[str, NDArray[np.generic]]) -> None:
        """Go on from a saved state: as if never interrupted, bit for bit. Raises ``ValueError`` if it is of
        another body."""
        fresh = initial_state(self._n, len(self._devices))._asdict()
        for name, array in fresh.items():
            if name not in state or state[name].shape != array.shape:
                raise ValueError(f"the saved state's {name!r} does not fit this body of {self._n} segments")
            array[...] = state[name]
        self._state = FilterState(**fresh)

    def update(self, observation: ImuFrame, resting: FloatArray | None = None) -> SkeletonFrame:
        """One instant. Raises nothing: what is not defined is NaN and says so in ``status``.

        resting: (n_segments,) s for how long each has stood still, 0: not; see ``stance``."""
        observed = self._observer.observe(observation)
        clock = self._state.time_ns
        if clock[1] < 0:
            clock[:] = observation.time_ns - round(self._interval_s * 1e9), observation.time_ns
        dt = (observation.time_ns - clock[0]) * 1e-9
        acceleration, is_valid = np.full((self._n, 3), np.nan), np.zeros(self._n)
        if dt > SHORTEST_STEP_S:
            self._take_readings(observation)
            time_s = (observation.time_ns - clock[1]) * 1e-9
            clock[0] = observation.time_ns
            noise = self._settings.noise
            acceleration, is_valid = step(
                self._body,
                self._state,
                noise,
                self._fixed,
                self.is_joint,
                dt,
                time_s,
                observed,
                np.zeros(self._n) if resting is None else resting,
            )
        return self._frame(observation, observed, acceleration, is_valid)

    def _take_readings(self, observation: ImuFrame) -> None:
        if self._device is not None and self._device.quantity is Quantity.POSITION:
            self._root_motion.add(observation.local)
        for reading in observation.local:
            for d, device in enumerate(self._devices):
                if reading.device != device.device or reading.quantity != device.quantity:
                    continue
                value = np.array(reading.value, np.float64)
                if np.isfinite(value).all():
                    time_s = (reading.time_ns - self._state.time_ns[1]) * 1e-9
                    sigma = float(np.max(np.nan_to_num(np.asarray(reading.sigma))))
                    take_reading(self._state, self._settings.noise, d, time_s, value, sigma)

    def _frame(
        self,
        observation: ImuFrame,
        observed: SegmentObservations,
        acceleration: FloatArray,
        is_valid: FloatArray,
    ) -> SkeletonFrame:
        q_wb, rate, sigma, status = _outputs(
            self._state, self._parents, self._has_module, is_valid, observed.angular_rate, observed.status
        )
        return SkeletonFrame(
            sequence=observation.sequence,
            time_ns=observation.time_ns,
            q_wb=q_wb,
            angular_rate=rate,
            joint_acceleration=acceleration,
            p_w=joint_positions(self._parents, self._offsets, q_wb, self._root_position(q_wb, observation)),
            sigma=sigma,
            status=status,
            root=self._root,
        )

    def _root_position(self, q_wb: FloatArray, observation: ImuFrame) -> FloatArray:
        """(3,) of the skeleton root's joint: by a device on it that measures position, else the origin."""
        device = self._device
        if device is None or device.quantity is not Quantity.POSITION or self._parents[device.segment] >= 0:
            return np.zeros(3)
        measured = self._root_motion.position(observation.time_ns)
        return measured - quaternion.rotate(q_wb[device.segment], device.position)

    def _compile(self, n_modules: int) -> None:
        """A few frames, so that every kernel is compiled before the first real one comes."""
        self.reset()
        turn_segments(self._body, self._state, np.zeros((self._n, 3)))
        for d in range(len(self._devices)):
            take_reading(self._state, self._settings.noise, d, 0.0, np.zeros(3), 1.0)
        ones, none = np.ones((n_modules, 3)), np.zeros(n_modules, np.int64)
        for k in range(2):
            time_ns = round((k + 1) * self._interval_s * 1e9)
            self.update(ImuFrame(k, time_ns, ones, 0.1 * ones, ones, none.astype(np.uint8), none))


class OutwardReconstructor(ChainReconstructor):
    """Every segment in a filter of 6 states for itself; its parent's orientation and covariance are handed
    down and nothing is handed back."""

    is_joint = False


JointReconstructor = ChainReconstructor


@compiled
def _outputs(
    state: FilterState,
    parents: NDArray[np.int64],
    has_module: NDArray[np.bool_],
    is_valid: FloatArray,
    measured_rate: FloatArray,
    measured_status: StatusArray,
) -> tuple[FloatArray, FloatArray, FloatArray, StatusArray]:
    n = len(parents)
    q_wb, rate = np.full((n, 4), np.nan), np.full((n, 3), np.nan)
    sigma, status = orientation_sigma(state), measured_status.copy()
    for s in range(n):
        p = parents[s]
        if not has_module[s]:
            status[s] = Status.MISSING.value
            if p >= 0 and status[p] != Status.MISSING.value:
                q_wb[s], rate[s], status[s] = q_wb[p], rate[p], Status.PREDICTED.value
        elif state.is_started[s] == 0:
            status[s] = Status.MISSING.value
        else:
            q_wb[s] = quaternion.from_matrix(state.R[s])
            rate[s] = state.rate[s] - state.bias[s]
            if is_valid[s] == 0.0:
                status[s] = Status.PREDICTED.value
    return q_wb, rate, sigma, status
