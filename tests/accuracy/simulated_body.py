"""Truth for the reconstructors: articulated bodies that move by formulae, with noise-free modules.

Every segment turns against its parent about one axis after another; every angle is a sum of sines, so
orientation, angular rate, its derivative and every acceleration are exact. Calculated in extended
precision and rounded once, because differences of orientations magnify rounding.

Written without the code under test; ``test_simulated_body.py`` holds it against scipy.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from gateway.body.skeleton import LocalDevice, Skeleton, WornSuit, field_vector
from gateway.frames import ImuFrame, LocalReading, Quantity, Status

LONG = np.longdouble
GRAVITY = np.array([0.0, 0.0, -9.81])
FIELD = field_vector(42.0, 25.0, 3.0)


@dataclass(frozen=True)
class SumOfSines:
    """value(t) = Σ amplitude sin(frequency t + phase); rows (amplitude, frequency rad/s, phase)."""

    terms: tuple[tuple[float, float, float], ...]

    def derivatives(self, t):
        """Value, first and second derivative, each shaped like t."""
        value, first, second = (np.zeros_like(t) for _ in range(3))
        for amplitude, frequency, phase in self.terms:
            a, w = LONG(amplitude), LONG(frequency)
            value += a * np.sin(w * t + LONG(phase))
            first += a * w * np.cos(w * t + LONG(phase))
            second -= a * w * w * np.sin(w * t + LONG(phase))
        return value, first, second

    @classmethod
    def from_rest(cls, amplitude: float, frequency: float) -> SumOfSines:
        """amplitude sin³(frequency t): value, rate and its derivative are zero at t = 0."""
        return cls(((0.75 * amplitude, frequency, 0.0), (-0.25 * amplitude, 3.0 * frequency, 0.0)))


@dataclass(frozen=True)
class Turn:
    """One elementary rotation: about axis 0, 1 or 2 of the axes reached so far."""

    axis: int
    angle: SumOfSines


@dataclass(frozen=True)
class SimulatedBody:
    """A tree of segments with its motion; arrays as in ``Skeleton`` and ``WornSuit``."""

    parents: tuple[int, ...]
    offsets: np.ndarray
    lever_arms: np.ndarray
    turns: tuple[tuple[Turn, ...], ...]
    """Of every segment against its parent (the root: against the world)."""
    root_position: tuple[SumOfSines, ...] = ()
    """Three coordinates of the root's joint; empty: it stays at the origin."""
    local_devices: tuple[LocalDevice, ...] = ()
    module_of_segment: tuple[int, ...] | None = None

    def suit(self) -> WornSuit:
        n = len(self.parents)
        modules = np.arange(n) if self.module_of_segment is None else np.array(self.module_of_segment)
        skeleton = Skeleton(
            name="simulated",
            segment_names=tuple(f"segment_{i}" for i in range(n)),
            parents=np.array(self.parents),
            offsets=np.asarray(self.offsets, float),
            tips=np.zeros((n, 3)),
        )
        return WornSuit(
            skeleton=skeleton,
            module_ids=tuple(range(int(modules.max()) + 1)),
            module_of_segment=modules,
            sensor_to_segment=np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)),
            lever_arms=np.asarray(self.lever_arms, float),
            local_devices=self.local_devices,
            gravity=GRAVITY,
            magnetic_field=FIELD,
        )


@dataclass(frozen=True)
class Truth:
    """All arrays (instants, segments, …); world coordinates unless the name says segment axes."""

    time_ns: np.ndarray
    R: np.ndarray  # segment to world
    angular_rate: np.ndarray  # segment axes
    rate_derivative: np.ndarray  # segment axes
    joint_acceleration: np.ndarray
    p_w: np.ndarray
    specific_force: np.ndarray  # segment axes, at the module
    magnetic_field: np.ndarray  # segment axes
    point: dict[str, np.ndarray] = field(default_factory=dict)
    """Position, velocity, acceleration of the first local device, (instants, 3)."""


def simulate(body: SimulatedBody, time_ns: np.ndarray) -> Truth:
    """The body at the given instants; before t = 0 it stands still where it is at t = 0."""
    t = np.maximum(time_ns, 0).astype(LONG) / LONG(10**9)
    moving = (time_ns >= 0).astype(LONG)
    n, shape = len(body.parents), (len(t), len(body.parents))
    R, w, dw = np.zeros((*shape, 3, 3), LONG), np.zeros((*shape, 3), LONG), np.zeros((*shape, 3), LONG)
    p, v, a = (np.zeros((*shape, 3), LONG) for _ in range(3))
    for s in range(n):
        parent = body.parents[s]
        if parent < 0:
            R[:, s] = np.eye(3)
            for k, coordinate in enumerate(body.root_position):
                p[:, s, k], v[:, s, k], a[:, s, k] = coordinate.derivatives(t)
        else:
            R[:, s], w[:, s], dw[:, s] = R[:, parent], w[:, parent], dw[:, parent]
            arm = np.asarray(body.offsets[s], LONG)
            p[:, s] = p[:, parent] + _rotate(R[:, parent], arm)
            v[:, s] = v[:, parent] + _rotate(R[:, parent], np.cross(w[:, parent], arm))
            a[:, s] = a[:, parent] + _rotate(R[:, parent], _lever(dw[:, parent], w[:, parent], arm))
        for turn in body.turns[s]:
            R[:, s], w[:, s], dw[:, s] = _turned(R[:, s], w[:, s], dw[:, s], turn, t, moving)
    v, a = v * moving[:, None, None], a * moving[:, None, None]
    force = np.einsum("tsji,tsj->tsi", R, a - GRAVITY.astype(LONG)) + _lever(
        dw, w, np.asarray(body.lever_arms, LONG)
    )
    magnetic = np.einsum("tsji,j->tsi", R, FIELD.astype(LONG))
    point = {}
    for device in body.local_devices[:1]:
        s, arm = device.segment, np.asarray(device.position, LONG)
        point["position"] = p[:, s] + _rotate(R[:, s], arm)
        point["velocity"] = v[:, s] + _rotate(R[:, s], np.cross(w[:, s], arm))
        point["acceleration"] = a[:, s] + _rotate(R[:, s], _lever(dw[:, s], w[:, s], arm))
    arrays = [np.asarray(x, float) for x in (R, w, dw, a, p, force, magnetic)]
    return Truth(time_ns, *arrays, point={k: np.asarray(x, float) for k, x in point.items()})


def _rotate(R, v):
    return np.einsum("tij,tj->ti", R, np.broadcast_to(v, (len(R), 3)))


def _lever(dw, w, arm):
    return np.cross(dw, arm) + np.cross(w, np.cross(w, arm))


def _turned(R, w, dw, turn, t, moving):
    """One elementary rotation E more: ω' = Eᵀω + e θ̇,  ω̇' = Eᵀω̇ + (Eᵀω) × e θ̇ + e θ̈."""
    angle, first, second = turn.angle.derivatives(t)
    axis = np.eye(3, dtype=LONG)[turn.axis]
    first, second = (first * moving)[:, None] * axis, (second * moving)[:, None] * axis
    i, j = (turn.axis + 1) % 3, (turn.axis + 2) % 3
    E = np.zeros_like(R)
    E[:, turn.axis, turn.axis] = 1
    E[:, i, i] = E[:, j, j] = np.cos(angle)
    E[:, j, i] = np.sin(angle)
    E[:, i, j] = -E[:, j, i]
    w = np.einsum("tji,tj->ti", E, w)
    dw = np.einsum("tji,tj->ti", E, dw) + np.cross(w, first) + second
    return np.einsum("tij,tjk->tik", R, E), w + first, dw


def instants(rate_hz: int, seconds: float, start_s: float = 0.0) -> np.ndarray:
    """Gateway times of evenly spaced frames, ns."""
    step = 10**9 // rate_hz
    return int(start_s * 1e9) + step * np.arange(int(seconds * rate_hz) + 1)


def imu_frames(body: SimulatedBody, truth: Truth, gyroscopes: bool, readings=None) -> list[ImuFrame]:
    """What ideal modules and the local device measure; ``readings``: per frame a tuple, else the device
    sends at every frame."""
    suit = body.suit()
    segments = [int(np.flatnonzero(suit.module_of_segment == m)[0]) for m in range(len(suit.module_ids))]
    m = len(segments)
    nothing = np.full((m, 3), np.nan)
    return [
        ImuFrame(
            sequence=k,
            time_ns=int(truth.time_ns[k]),
            specific_force=truth.specific_force[k, segments],
            angular_rate=truth.angular_rate[k, segments] if gyroscopes else nothing,
            magnetic_field=truth.magnetic_field[k, segments],
            status=np.full(m, Status.MEASURED, np.uint8),
            gap_ns=np.zeros(m, np.int64),
            local=local_readings(body, truth, k) if readings is None else readings[k],
        )
        for k in range(len(truth.time_ns))
    ]


def local_readings(body: SimulatedBody, truth: Truth, k: int) -> tuple[LocalReading, ...]:
    """The first local device's reading at instant k."""
    for device in body.local_devices[:1]:
        if device.quantity is not Quantity.FIXED_POINT:
            value = truth.point[device.quantity.name.lower()][k]
            return (
                LocalReading(device.device or 0, int(truth.time_ns[k]), device.quantity, value, np.zeros(3)),
            )
    return ()


def angular_error_deg(q_wb: np.ndarray, R: np.ndarray) -> np.ndarray:
    """Angle between estimates (…, 4) and true matrices (…, 3, 3), degrees."""
    w, x, y, z = np.moveaxis(q_wb, -1, 0)
    E = np.stack(
        [
            np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
            np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
            np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
        ],
        -2,
    )
    # |E − R| (Frobenius) = 2√2 sin(angle / 2)
    return np.degrees(2.0 * np.arcsin(np.minimum(1.0, np.linalg.norm(E - R, axis=(-2, -1)) / np.sqrt(8.0))))


ARM_LENGTHS = (0.35, 0.30, 0.25, 0.15)
ARM_LEVERS = np.array([[0.15, 0.01, 0.0], [0.14, 0.0, 0.01], [0.12, 0.01, 0.01], [0.10, 0.0, 0.0]])


ARM_TURNS = (  # by segment: amplitude rad, frequency rad/s, phase of the turns about z, y and x
    ((0.29, 4.4, 0.42), (0.17, 4.95, 5.13), (0.17, 6.71, 4.9)),
    ((0.16, 4.84, 1.12), (0.19, 4.95, 2.98), (0.22, 5.83, 5.67)),
    ((0.1, 5.72, 2.77), (0.08, 7.92, 4.99), (0.11, 4.51, 6.23)),
    ((0.08, 7.26, 3.7), (0.09, 7.92, 1.09), (0.12, 5.17, 3.9)),
)


def arm(
    on_joint: bool,
    from_rest: bool = False,
    amplitude: float = 1.0,
    tempo: float = 1.0,
    bent: float = 0.0,
    **changes,
) -> SimulatedBody:
    """Four segments along x, spherical joints, fixed shoulder, about 3 rad/s and 20 rad/s² at the peaks."""
    turns = []
    for segment in ARM_TURNS:
        angles = []
        for a, w, phase in segment:
            if from_rest:
                angles.append(SumOfSines.from_rest(amplitude * a, 0.6 * tempo * w))
            else:
                slower = (0.4 * amplitude * a, 0.4 * tempo * w, 1.7 * phase)
                constant = (bent, 0.0, phase)
                angles.append(SumOfSines(((amplitude * a, tempo * w, phase), slower, constant)))
        turns.append(tuple(Turn(axis, angle) for axis, angle in zip((2, 1, 0), angles, strict=True)))
    offsets = np.zeros((4, 3))
    offsets[1:, 0] = ARM_LENGTHS[:3]
    parts = {
        "parents": (-1, 0, 1, 2),
        "offsets": offsets,
        "lever_arms": np.zeros((4, 3)) if on_joint else ARM_LEVERS,
        "turns": tuple(turns),
        "local_devices": (LocalDevice(Quantity.FIXED_POINT, 0, np.zeros(3)),),
    }
    return SimulatedBody(**{**parts, **changes})
