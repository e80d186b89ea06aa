"""The literal articulated reconstructor: the reference that estimators are measured against.

Equations: ``operators`` (JP4989660B2).

When a segment of rank n (root: 1) is first defined, counting samples from 1:
- ``U = 0``, no gyroscopes: sample 2n − 1 (two more orientations of rank n − 1 are needed each time);
- gyroscopes: ``ω̇`` of every segment is known from sample 2, so rank 1 with ``U = 0`` is defined from
  sample 1, every other segment from sample 2, whatever its rank;
- ``U ≠ 0``, no gyroscopes: from a static start or a starting pose.
A local device that measures velocity adds 1 to these, one that measures position 2. Until then WARMING_UP.

The root is the segment that carries the first local device; without any, the skeleton's root is taken
to turn about a fixed proximal joint (``a_1 = 0``). A segment whose module gave nothing for the instant
(HELD counts as nothing: a repeated sample has no derivative) is MISSING, and so are all segments beyond
it as seen from the root. Its own joint still has acceleration and position where the segment is entered
at that joint, since the neighbour defines them. Differences bridge a gap with the true time step; after
``longest_gap_s`` the warm-up begins anew (``U ≠ 0`` without gyroscopes: at the next rest).

Two limits of the method itself. Where ``a_n − g`` points along the field, or vanishes, the two vectors do not
define an orientation, and near it every error is magnified; a steep field (60° and more) makes this common.
And without gyroscopes rounding alone grows by about ``√6 |L| / (g Δt²)`` a rank with ``U = 0``:
rank 4 of an arm of 0.35, 0.30, 0.25 m has a floor of 5e-7° at 100 Hz, 2e-5° at 200, 0.0015° at 400,
0.10° at 800 and 7° at 1600 Hz in double precision, and sensor noise grows by the same factor.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from gateway.body.skeleton import WornSuit
from gateway.frames import FloatArray, ImuFrame, SkeletonFrame, Status
from gateway.geometry import quaternion, rotation_matrix
from gateway.geometry.compiled import compiled
from gateway.reconstruction.inertial.local_devices import RootMotion
from gateway.reconstruction.inertial.observations import (
    SegmentObservations,
    SegmentObserver,
    with_sun_as_field,
)
from gateway.reconstruction.inertial.operators import (
    Chain,
    Felt,
    Instant,
    Rotation,
    Weights,
    advance,
    initial_state,
    next_rotation,
)
from gateway.reconstruction.inertial.travel import travel_from

ON_JOINT = 1e-6
"""m: a module nearer than this to the joint counts as on it (the special case)."""


@dataclass(frozen=True, slots=True)
class ArticulatedSettings:
    """Parameters of the articulated reconstructor."""

    longest_gap_s: float = 0.25
    """Differences are not taken over longer gaps, and readings of the local device not held longer."""
    local_window_s: float = 0.08
    """Over which a position or velocity of the local device is differentiated: −3 dB at 8.8 Hz."""
    static_frames: int = 20
    """Successive frames at rest that make a static start."""
    static_norm_tolerance: float = 0.3
    """m/s²: mean specific force against |g| at a static start."""
    static_deviation: float = 0.1
    """m/s²: largest standard deviation of an axis at a static start."""
    start_orientation_sigma: float = 0.02
    """rad: how well the orientations of the start are known."""
    start_rate_sigma: float = 0.02
    """rad/s: how well the rates of the start are known."""
    specific_force_sigma: float = 1.0
    """m/s²: weight of the specific force in the general case without gyroscopes."""
    direction_sigma: float = 0.005
    """rad: weight of sensor X there. No smaller than its noise: the filter runs away at a fifth of it."""
    second_difference_sigma: float = 0.1
    """rad: prior of ω̇ Δt² about zero there."""


@dataclass(frozen=True, slots=True)
class StartingPose:
    """Orientations and rates at the first frame, from other means than the modules."""

    q_wb: FloatArray  # (n_segments, 4)
    angular_rate: FloatArray  # (n_segments, 3) rad/s, segment axes


class ArticulatedReconstructor:
    """The method of the source, exact in its equations. Compiles in the constructor (cached on disk).

    nominal_interval_s: of the frames; only the time stamps count, it serves the warm-up compilation.
    starting_pose: taken at the first frame by segments with ``U ≠ 0`` and no gyroscopes.
    """

    def __init__(
        self,
        suit: WornSuit,
        nominal_interval_s: float,
        settings: ArticulatedSettings | None = None,
        starting_pose: StartingPose | None = None,
    ) -> None:
        self._settings = settings = settings or ArticulatedSettings()
        self._starting_pose = starting_pose
        self._n_segments = suit.skeleton.n_segments
        device = suit.local_devices[0] if suit.local_devices else None
        self._chain = travelled_chain(suit)
        self._root = int(self._chain.order[0])
        self._weights = Weights(
            settings.specific_force_sigma,
            settings.direction_sigma,
            settings.second_difference_sigma,
        )
        self._observer = SegmentObserver(suit)
        self._root_motion = RootMotion(device, settings.longest_gap_s, settings.local_window_s)
        self._static_start = StaticStart(
            suit.gravity,
            suit.magnetic_field,
            settings.static_frames,
            settings.static_norm_tolerance,
            settings.static_deviation,
        )
        self._compile(len(suit.module_ids), nominal_interval_s)
        self.reset()

    def reset(self) -> None:
        """Forget everything but the parameters."""
        self._state = initial_state(self._n_segments)
        self._root_motion.reset()
        self._static_start.reset()
        self._needs_pose = self._starting_pose is not None

    def update(self, observation: ImuFrame, stood_s: FloatArray | None = None) -> SkeletonFrame:
        """Return the pose of one instant.

        Raises nothing: what is not defined is NaN, and ``status`` says why.
        """
        time_ns = observation.time_ns
        sun = observation.sun
        if sun is not None:
            observation = with_sun_as_field(observation, sun)
            self._chain = self._chain._replace(field=np.array(sun.world, np.float64))

        observed = self._observer.observe(observation)
        self._root_motion.add(observation.local)
        self._start(observed, time_ns)
        root_position = self._root_motion.position(time_ns)
        self._state, pose = advance(
            self._chain,
            self._state,
            self._weights,
            self._settings.longest_gap_s,
            Instant(time_ns, self._root_motion.acceleration(time_ns), root_position, observed),
        )

        return SkeletonFrame(
            sequence=observation.sequence,
            time_ns=time_ns,
            q_wb=pose.q_wb,
            angular_rate=pose.angular_rate,
            joint_acceleration=pose.joint_acceleration,
            p_w=pose.p_w,
            sigma=np.full(self._n_segments, np.nan),
            status=pose.status,
            root=self._root,
        )

    def _start(self, observed: SegmentObservations, time_ns: int) -> None:
        """Start segments that need two earlier orientations, by the starting pose or from rest."""
        lacks_rate = np.isnan(observed.angular_rate).any(axis=1)
        needs = (self._chain.on_joint == 0) & (self._state.is_started == 0) & lacks_rate
        needs &= observed.status <= Status.INTERPOLATED
        if not needs.any():
            self._static_start.reset()
            return
        if self._needs_pose and self._starting_pose is not None:
            R = np.stack([quaternion.to_matrix(quaternion.normalise(q)) for q in self._starting_pose.q_wb])
            self._needs_pose = False
            self._take_start(needs, R, self._starting_pose.angular_rate, time_ns)
            return
        at_rest = self._static_start.add(observed)
        if at_rest is not None:
            needs &= np.isfinite(at_rest).all(axis=(1, 2))
            self._take_start(needs, at_rest, np.zeros((self._n_segments, 3)), time_ns)

    def _take_start(self, which: FloatArray, R: FloatArray, rate: FloatArray, time_ns: int) -> None:
        state, settings = self._state, self._settings
        sigma = np.repeat([settings.start_orientation_sigma, settings.start_rate_sigma], 3)
        state.R[which], state.rate[which] = R[which], rate[which]
        state.covariance[which] = np.diag(sigma**2)
        state.step[which], state.time_ns[which], state.is_started[which] = 0.0, time_ns, 1

    def _compile(self, n_modules: int, nominal_interval_s: float) -> None:
        """Feed two frames of rest, so that every kernel is compiled before the first real frame comes."""
        self.reset()
        for k in range(2):
            self.update(
                ImuFrame(
                    sequence=k,
                    time_ns=round(k * nominal_interval_s * 1e9),
                    specific_force=np.ones((n_modules, 3)),
                    angular_rate=np.zeros((n_modules, 3)),
                    magnetic_field=np.zeros((n_modules, 3)),
                    status=np.zeros(n_modules, np.uint8),
                    gap_ns=np.zeros(n_modules, np.int64),
                )
            )


def travelled_chain(suit: WornSuit) -> Chain:
    """Return the body as travelled from the first local device's segment, or from the skeleton's root."""
    device = suit.local_devices[0] if suit.local_devices else None
    root = device.segment if device else int(np.flatnonzero(suit.skeleton.parents < 0)[0])
    travel = travel_from(suit.skeleton, root, device.position if device else np.zeros(3))
    U = travel.arms(suit.lever_arms)
    return Chain(
        order=travel.order,
        entered_from=travel.entered_from,
        L=travel.link,
        U=U,
        proximal=travel.proximal,
        on_joint=(np.linalg.norm(U, axis=1) < ON_JOINT).astype(np.int64),
        gravity=np.array(suit.gravity, np.float64),
        field=np.array(suit.magnetic_field, np.float64),
    )


class StaticStart:
    """Watches for rest of the whole body; gives all orientations once it has lasted long enough.

    n_frames: how many successive frames rest must last.
    norm_tolerance: how far the mean specific force may be from |g|, m/s².
    deviation: largest standard deviation of an axis of the specific force, m/s².
    """

    def __init__(
        self, gravity: FloatArray, field: FloatArray, n_frames: int, norm_tolerance: float, deviation: float
    ) -> None:
        self._gravity, self._field = gravity, field
        self._n_frames, self._norm_tolerance, self._deviation = n_frames, norm_tolerance, deviation
        self.reset()

    def reset(self) -> None:
        """Forget the frames seen so far."""
        self._history: list[SegmentObservations] = []

    def add(self, observations: SegmentObservations) -> FloatArray | None:
        """Return the orientations (n_segments, 3, 3) once the body has rested, until then None.

        They are NaN for segments without a module.
        """
        self._history = [*self._history[1 - self._n_frames :], observations]
        if len(self._history) < self._n_frames:
            return None
        force = np.array([o.specific_force for o in self._history])  # (n_frames, n_segments, 3)
        observed = np.isfinite(force).all(axis=(0, 2))
        if not observed.any() or not self._is_static(force[:, observed]):
            return None
        magnetic = np.array([o.magnetic_field for o in self._history]).mean(axis=0)
        mean = force.mean(axis=0)
        up = -self._gravity
        vectors = zip(mean, magnetic, strict=True)
        vectors = zip(mean, magnetic, strict=True)
        return np.stack([rotation_matrix.from_two_vectors(f, x, up, self._field) for f, x in vectors])

    def _is_static(self, force: FloatArray) -> bool:
        norms = np.linalg.norm(force.mean(axis=0), axis=-1)
        off_norm = np.abs(norms - np.linalg.norm(self._gravity))
        return bool(off_norm.max() < self._norm_tolerance and force.std(axis=0).max() < self._deviation)


# Which headings are not observable
#
# Find for which placements ``articulated`` loses the heading where modules have no gyroscopes.
#
# At rest a module off its joint shows nothing of a turn about the field but the acceleration that such a
# turn would cause (``next_rotation``): where the arm from the joint lies in the plane of vertical and field,
# only the pendulum equation is left, and that is stable for a module that hangs below the joint. So it is
# tried, with these equations themselves: from a start that is wrong by a degree, a body at rest in the
# neutral posture gives exact readings, and the error has to shrink. It depends on the way the body faces.


FACINGS = tuple(range(0, 360, 15))
"""Ways to face, degrees clockwise from north. Placements are lost within 10° or more to either side."""
_NEUTRAL_FACING = 90
_START_ERROR = math.radians(1.0)
_N_FRAMES, _INTERVAL_S = 200, 0.005
"""What hangs below its joint has lost a quarter of the error by then, what stands above it is off by 5°."""


def unobserved_headings(suit: WornSuit) -> dict[str, tuple[int, ...]]:
    """Return, by segment, those of ``FACINGS`` in which its heading is not observed; none: not in the result.

    Of ``articulated`` without gyroscopes, at rest in the neutral posture. Segments without a module, or with
    one on their joint, have no such ways.
    """
    settings = ArticulatedSettings()
    weights = Weights(
        settings.specific_force_sigma, settings.direction_sigma, settings.second_difference_sigma
    )
    sigma = np.repeat([settings.start_orientation_sigma, settings.start_rate_sigma], 3)
    U = travelled_chain(suit).U
    neutral = quaternion.to_matrix(quaternion.normalise(suit.skeleton.neutral))
    found: dict[str, tuple[int, ...]] = {}
    for s in np.flatnonzero((suit.module_of_segment >= 0) & (np.linalg.norm(U, axis=1) >= ON_JOINT)):
        lost = tuple(
            facing
            for facing in FACINGS
            if _largest_error_at_rest(
                _turned(neutral, facing),
                -suit.gravity,
                suit.magnetic_field,
                U[s],
                weights,
                np.diag(sigma**2),
            )
            > _START_ERROR
        )
        if lost:
            found[suit.skeleton.segment_names[s]] = lost
    return found


def _turned(neutral: FloatArray, facing: int) -> FloatArray:
    """Return the orientation (3, 3) of segments whose body faces that way.

    neutral: (3, 3), of a body facing east.
    """
    angle = math.radians(_NEUTRAL_FACING - facing)  # counter-clockwise from above
    turn = rotation_matrix.from_rotation_vector(np.array([0.0, 0.0, angle]))
    return np.asarray(turn @ neutral)


@compiled
def _largest_error_at_rest(
    truth: FloatArray,
    up: FloatArray,
    field: FloatArray,
    U: FloatArray,
    weights: Weights,
    covariance: FloatArray,
) -> float:
    """Return the angle, rad, that the orientation is off after a second at rest, having begun a degree off.

    truth: (3, 3) segment to world; up: (3,) a − g, m/s²; field: (3,) µT, both in the world.
    The degree is about the field, one way and the other; the larger outcome counts.
    """
    f, x = rotation_matrix.rotate_inverse(truth, up), rotation_matrix.rotate_inverse(truth, field)
    largest = 0.0
    for sign in (-1.0, 1.0):
        turn = field * (sign * _START_ERROR / math.sqrt((field * field).sum()))
        R = rotation_matrix.multiply(rotation_matrix.from_rotation_vector(turn), truth)
        now = Rotation(R, np.zeros(3), np.zeros(3), covariance)
        for _ in range(_N_FRAMES):
            now = next_rotation(now, _INTERVAL_S, _INTERVAL_S, Felt(f, x, up, field), U, weights)
        off = now.R - truth  # the sum of its squares is 8 sin²(angle / 2)
        largest = max(largest, 2.0 * math.asin(min(1.0, math.sqrt((off * off).sum() / 8.0))))
    return largest
