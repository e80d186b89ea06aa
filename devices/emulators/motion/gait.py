"""Walking and running whose feet stand still in the world while they carry the body, with exact derivatives.

The feet are planned first: every stance has a heel strike, a flat phase, a push-off about the toe; between
stances the foot swings. The pelvis follows a path (straight, or a circle) at a steady speed. Hips, knees and
ankles follow by inverse kinematics on a fine grid of one start and one stride, through which splines of
degree 5 are laid. The splines *are* the motion, so orientations, rates and accelerations fit each other to
rounding; that the feet stand still holds to the splines' error (micrometres).

Axes of the plan: x forward at the start, y up, z right, which are a person's ISB axes.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import factorial

import numpy as np

from devices.deferred import BPoly, Rotation, make_interp_spline
from devices.emulators.bodies import EmulatedBody, FloatArray, IntArray
from devices.emulators.motion.legs import Leg, leg_angles, leg_of
from devices.emulators.motion.waves import Derivatives, Fade, Waves

STEPS_OF_GRID = 256
"""Of one stride."""
_START_STRIDES = 3
_DEGREE = 5
_MARGIN = 8  # at its ends a spline is not laid through the grid's own knots


@dataclass(frozen=True)
class Gait:
    """How somebody walks or runs. Phases are parts of the stride, counted from the foot's heel strike."""

    stride_hz: float = 0.88
    speed: float = 1.05
    """m/s."""
    flat_from: float = 0.10
    flat_to: float = 0.40
    toe_off: float = 0.62
    strike_pitch: float = 0.30
    """rad: toes up at heel strike."""
    push_pitch: float = 0.80
    """rad: toes down at toe-off."""
    clearance: float = 0.05
    """m: of the ankle in mid-swing, beyond the way between its ends."""
    drop: float = 0.075
    """m: pelvis lower than in standing."""
    bob: float = 0.012
    """m: up and down with every step."""
    sway: float = 0.02
    """m: to the side of the standing leg."""
    track: float = 0.55
    """Distance between the feet's lines over that of the hips."""
    radius: float = 0.0
    """m: of a circle to the left; 0: straight on."""


WALK = Gait()
RUN = Gait(
    stride_hz=1.35,
    speed=2.3,
    flat_from=0.06,
    flat_to=0.19,
    toe_off=0.36,
    strike_pitch=0.15,
    push_pitch=0.80,
    clearance=0.14,
    drop=0.10,
    bob=-0.03,
    sway=0.01,
    track=0.4,
)
"""Both feet are in the air for 28 % of the stride."""


class PlannedPath:
    """The pelvis: where it is and where it faces at any time."""

    def __init__(self, gait: Gait, fade: Fade, axes: FloatArray) -> None:
        """Walk by ``gait``; axes: (3, 3) columns forward, up and right, world."""
        self._gait = gait
        self._fade = fade
        self._axes = axes
        self.start_s = fade.rest_s + 0.5 * fade.ramp_s
        self.ramp_s = fade.ramp_s

    def travelled(self, times: FloatArray) -> Derivatives:
        """Way along the path, m: the speed rises smoothly to the gait's."""
        u = np.clip((times - self.start_s) / self.ramp_s, 0.0, 1.0)
        speed = Fade(self.start_s, self.ramp_s).evaluate(times)
        way = self.ramp_s * u**5 * (7.0 - 14.0 * u + 10.0 * u**2 - 2.5 * u**3)
        way = way + np.maximum(times - self.start_s - self.ramp_s, 0.0)
        v = self._gait.speed
        return Derivatives(v * way, v * speed.value, v * speed.rate)

    def heading(self, times: FloatArray) -> Derivatives:
        """Turn to the left since the start, rad."""
        if self._gait.radius == 0.0:
            still = np.zeros_like(times)
            return Derivatives(still, still, still)
        return Derivatives(*(part / self._gait.radius for part in self.travelled(times)))

    def place(self, times: FloatArray) -> tuple[Derivatives, Derivatives, Derivatives]:
        """Return the pelvis' place: forward, up and to the right, m, with derivatives."""
        g, (s, ds, dds) = self._gait, self.travelled(times)
        psi = self.heading(times)
        cosine, sine = np.cos(psi.value), np.sin(psi.value)
        bent = ds * psi.rate
        if g.radius:
            x, z = g.radius * sine, g.radius * (cosine - 1.0)
        else:
            x, z = s, np.zeros_like(s)
        forward = Derivatives(x, ds * cosine, dds * cosine - bent * sine)
        right = Derivatives(z, -ds * sine, -dds * sine - bent * cosine)
        # twice faded: legs that are straight at rest bend without a jerk
        fade = self._fade.evaluate(times)
        slow = _times(fade, fade)
        height = Derivatives(np.full_like(s, -g.drop), np.zeros_like(s), np.zeros_like(s))
        up = _times(slow, _plus(height, _wave(times, -g.bob, 2.0 * g.stride_hz, 2.0 * np.pi * 0.31)))
        aside = _times(slow, _wave(times, g.sway, g.stride_hz, 2.0 * np.pi * 0.31 - 0.5 * np.pi))
        out_x, out_z = self._sideways(psi)
        return _plus(forward, _times(aside, out_x)), up, _plus(right, _times(aside, out_z))

    def _sideways(self, psi: Derivatives) -> tuple[Derivatives, Derivatives]:
        """Return the direction to the right of the heading: its forward and right parts."""
        c, s = np.cos(psi.value), np.sin(psi.value)
        return (
            Derivatives(s, c * psi.rate, c * psi.acceleration - s * psi.rate**2),
            Derivatives(c, -s * psi.rate, -s * psi.acceleration - c * psi.rate**2),
        )

    def evaluate(self, times: FloatArray, fade: Derivatives) -> list[Derivatives]:
        """Return world coordinates of the pelvis' joint at ``times`` (T, M)."""
        parts = self.place(times)
        turned = [
            [sum(self._axes[i, k] * parts[k][order] for k in range(3)) for order in range(3)]
            for i in range(3)
        ]
        return [Derivatives(*component) for component in turned]


class PlannedAngles:
    """Joint angles: splines for the legs, waves for everything else. Used as ``Waves`` are."""

    def __init__(
        self,
        others: Waves,
        coefficients: FloatArray,
        knots: FloatArray,
        rest_s: float,
        stride_s: float,
        nodes: IntArray | None = None,
    ) -> None:
        """Hold coefficients (6, K, N, 3) of powers from knots (K,) on, highest first; the last one recurs.

        rest_s: until then the legs are at rest. nodes: the rows that are meant, in that order; default: all.
        """
        self._others, self._coefficients, self._knots = others, coefficients, knots
        self._rest_s, self._stride_s = rest_s, stride_s
        self._nodes = np.arange(coefficients.shape[2]) if nodes is None else nodes

    def with_idle_row(self) -> PlannedAngles:
        """Return one node more, which never turns."""
        idle = np.zeros((*self._coefficients.shape[:2], 1, 3))
        coefficients = np.concatenate([self._coefficients, idle], axis=2)
        return self._of(
            self._others.with_idle_row(), coefficients, np.append(self._nodes, self._coefficients.shape[2])
        )

    def rows(self, rows: IntArray) -> PlannedAngles:
        """Return the angles of some nodes only, in that order; the large coefficients are not copied."""
        return self._of(self._others.rows(rows), self._coefficients, self._nodes[rows])

    def _of(self, others: Waves, coefficients: FloatArray, nodes: IntArray) -> PlannedAngles:
        return PlannedAngles(others, coefficients, self._knots, self._rest_s, self._stride_s, nodes)

    def evaluate(self, times: FloatArray, fade: Derivatives) -> list[Derivatives]:
        """Return the angles about x, y and z at ``times`` (T, N), each (T, N), with derivatives."""
        interval, since = self._interval(times.astype(np.float64))
        moves = times > self._rest_s
        others = self._others.evaluate(times, fade)
        result = []
        for axis in range(3):
            c = self._coefficients[:, interval, self._nodes, axis] * moves
            value, rate, acceleration = np.zeros((3, *times.shape))
            # Horner's scheme for the polynomial and its first two derivatives at once.
            for k in range(_DEGREE + 1):
                acceleration = acceleration * since + 2.0 * rate
                rate = rate * since + value
                value = value * since + c[k]
            result.append(_plus(others[axis], Derivatives(value, rate, acceleration)))
        return result

    def _interval(self, times: FloatArray) -> tuple[IntArray, FloatArray]:
        """Index of the knot before each time, and the time since it, s."""
        end = self._knots[-1]
        beyond = np.maximum(times - (end - self._stride_s), 0.0)
        folded = np.where(times > end, end - self._stride_s + beyond % self._stride_s, times)
        interval = np.clip(np.searchsorted(self._knots, folded, side="right") - 1, 0, len(self._knots) - 2)
        return interval, np.maximum(folded - self._knots[interval], 0.0)


def planned_motion(
    body: EmulatedBody, gait: Gait, fade: Fade, others: Waves, pelvis: Waves
) -> tuple[PlannedAngles, PlannedPath]:
    """Return joint angles and pelvis path of a gait.

    others: angles of segments that are no legs; the pelvis may only turn about y. pelvis: its row of it.
    Raises ``ValueError`` for a body without two legs.
    """
    axes = Rotation.from_quat(body.reference_posture[0], scalar_first=True).as_matrix()
    path = PlannedPath(gait, fade, axes)
    stride_s = 1.0 / gait.stride_hz
    steady_s = path.start_s + path.ramp_s + _START_STRIDES * stride_s
    step = stride_s / STEPS_OF_GRID
    before = int(np.ceil((steady_s - fade.rest_s) / step))
    grid = np.arange(-before - _MARGIN, STEPS_OF_GRID + _MARGIN + 1)
    times = np.asarray(steady_s + step * grid, np.float64)

    angles = np.zeros((len(times), body.n_segments, 3))
    axial = pelvis.evaluate(times[:, None], fade.evaluate(times[:, None]))[1].value[:, 0]
    facing = path.heading(times).value + axial
    place = np.stack([part.value for part in path.place(times)], axis=1)
    for side, delay in (("right", 0.0), ("left", 0.5)):
        leg = leg_of(body, side)
        foot = Foot(leg, gait, path, first_strike_s=path.start_s + (0.55 + delay) * stride_s)
        angles[:, leg.segments] = leg_angles(leg, place, facing, *foot_path(foot, times))

    # Angles are solved on a grid; as a spline they have derivatives that agree with them exactly.
    spline = make_interp_spline(times, angles.reshape(len(times), -1), k=_DEGREE)
    knots = times[_MARGIN:-_MARGIN]
    powers = [spline.derivative(m)(knots[:-1]) / factorial(m) for m in range(_DEGREE, 0, -1)]
    coefficients = np.array([*powers, spline(knots[:-1])])
    coefficients = coefficients.reshape(_DEGREE + 1, len(knots) - 1, body.n_segments, 3)
    return PlannedAngles(others, coefficients, knots, fade.rest_s, stride_s), path


def _wave(times: FloatArray, amplitude: float, frequency_hz: float, phase: float) -> Derivatives:
    w = 2.0 * np.pi * frequency_hz
    sine, cosine = np.sin(w * times + phase), np.cos(w * times + phase)
    return Derivatives(amplitude * sine, amplitude * w * cosine, -amplitude * w * w * sine)


def _plus(a: Derivatives, b: Derivatives) -> Derivatives:
    return Derivatives(*(x + y for x, y in zip(a, b, strict=True)))


def _times(a: Derivatives, b: Derivatives) -> Derivatives:
    """Apply the product rule."""
    return Derivatives(
        a.value * b.value,
        a.rate * b.value + a.value * b.rate,
        a.acceleration * b.value + 2.0 * a.rate * b.rate + a.value * b.acceleration,
    )


@dataclass(frozen=True)
class Foot:
    """One foot with its timetable."""

    leg: Leg
    gait: Gait
    path: PlannedPath
    first_strike_s: float

    def strike_s(self, stance: int) -> float:
        """Return the heel strike of a stance; stance −1 is the standing before the first step."""
        return self.first_strike_s + stance / self.gait.stride_hz

    def place(self, stance: int) -> tuple[FloatArray, float]:
        """Return the ankle of the flat foot (forward, up, right), m, and its heading, rad."""
        leg, gait = self.leg, self.gait
        if stance < 0:
            return leg.hip - np.array([0.0, leg.thigh + leg.shank, 0.0]), 0.0
        middle = np.array([self.strike_s(stance) + 0.5 * gait.toe_off / gait.stride_hz])
        s, psi = float(self.path.travelled(middle).value[0]), float(self.path.heading(middle).value[0])
        aside = gait.track * leg.hip[2]
        x, z = (gait.radius * np.sin(psi), gait.radius * (np.cos(psi) - 1)) if gait.radius else (s, 0.0)
        return np.array(
            [x + aside * np.sin(psi), leg.hip[1] - leg.thigh - leg.shank, z + aside * np.cos(psi)]
        ), psi


def foot_path(foot: Foot, times: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the ankle (T, 3), heading (T,) and pitch (T,; toes up) of the foot at times (T,)."""
    stride_s = 1.0 / foot.gait.stride_hz
    stance = np.floor((times - foot.first_strike_s) / stride_s).astype(int)
    ankle, heading, pitch = np.zeros((len(times), 3)), np.zeros(len(times)), np.zeros(len(times))
    for k in range(max(-1, int(stance.min())), int(stance.max()) + 1):
        now = np.maximum(stance, -1) == k
        phase = (times[now] - foot.strike_s(k)) / stride_s
        if k < 0:
            # Before its first strike a foot stands flat.
            phase = np.maximum(phase, foot.gait.flat_from)
        ankle[now], heading[now], pitch[now] = _stride(foot, k, phase)
    return ankle, heading, pitch


def _stride(foot: Foot, stance: int, phase: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the ankle, heading and pitch in one stance and the swing after it, by phase from heel strike
    on."""
    gait = foot.gait
    pitch = _pitch(gait)
    here, yaw = foot.place(stance)
    there, next_yaw = foot.place(stance + 1)
    off, strike = (
        _lifted(where, facing, pitch, at, pivot)
        for where, facing, at, pivot in (
            (here, yaw, gait.toe_off, foot.leg.toe),
            (there, next_yaw, 0.0, foot.leg.heel),
        )
    )

    knots = [gait.toe_off, 1.0]
    # Position and derivatives agree at both ends: the foot leaves and meets the floor without a jerk.
    swing = BPoly.from_derivatives(knots, [off, strike])
    part = np.clip((phase - gait.toe_off) / (1.0 - gait.toe_off), 0.0, 1.0)
    ankle = swing(np.maximum(phase, gait.toe_off))
    ankle[:, 1] += gait.clearance * (4.0 * part * (1.0 - part)) ** 4

    stands = phase < gait.toe_off
    for pivot, chosen in (
        (foot.leg.heel, stands & (phase < gait.flat_to)),
        (foot.leg.toe, stands & (phase >= gait.flat_to)),
    ):
        for i in np.flatnonzero(chosen):
            ankle[i] = _lifted(here, yaw, pitch, phase[i], pivot)[0]
    # A polynomial whose first three derivatives vanish at both ends.
    turn = part**4 * (35.0 - 84.0 * part + 70.0 * part**2 - 20.0 * part**3)
    return ankle, yaw + turn * (next_yaw - yaw), pitch(phase)


def _pitch(gait: Gait) -> BPoly:
    """Return the pitch over the phase, rad."""
    # Slopes somewhat steeper than a straight line, so that the curves end level.
    down = -1.5 * gait.strike_pitch / gait.flat_from
    push = -1.2 * gait.push_pitch / (gait.toe_off - gait.flat_to)
    knots = [0.0, gait.flat_from, gait.flat_to, gait.toe_off, 1.0]
    values = [
        [gait.strike_pitch, down, 0.0, 0.0],
        [0.0, 0.0, 0.0, 0.0],
        [0.0, 0.0, 0.0, 0.0],
        [-gait.push_pitch, push, 0.0, 0.0],
        [gait.strike_pitch, down, 0.0, 0.0],
    ]
    return BPoly.from_derivatives(knots, values)


def _lifted(where: FloatArray, yaw: float, pitch: BPoly, phase: float, pivot: FloatArray) -> list[FloatArray]:
    """Return the ankle of a foot pitched about a still point (forward, up), with derivatives by phase."""
    angle, rate, change, jerk = (float(pitch(phase, order)) for order in range(4))
    c, s = np.cos(angle), np.sin(angle)
    turned = np.array([c * pivot[0] - s * pivot[1], s * pivot[0] + c * pivot[1]])
    across = np.array([-turned[1], turned[0]])
    flat = (
        pivot - turned,
        -rate * across,
        -change * across + rate**2 * turned,
        (rate**3 - jerk) * across + 3.0 * rate * change * turned,
    )
    ahead = np.array([np.cos(yaw), 0.0, -np.sin(yaw)])
    up = np.array([0.0, 1.0, 0.0])
    place, *derivatives = (part[0] * ahead + part[1] * up for part in flat)
    return [where + place, *derivatives]
