"""A person as somebody sees one: walks as people walk, turns, stops, reaches out, squats, and walks back.

A lap is two walks, each half a turn to the left and back beside where it began, and what is done between
them; then it begins anew. Feet are planned first, as in ``gait``: each stance rolls over heel, sole and ball,
and is where the pelvis is in the middle of it. The legs follow by inverse kinematics. Splines of degree 5
through a fine grid of all angles and of the pelvis' path *are* the motion: orientations, rates and
accelerations fit each other to rounding.

Axes of the plan: x forward at the start, y up, z right, which are a person's ISB axes.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import factorial, pi, radians

import numpy as np

from devices.deferred import BPoly, Rotation, gaussian_filter1d, make_interp_spline
from devices.emulators.bodies import EmulatedBody, FloatArray, IntArray
from devices.emulators.motion.legs import Leg, foot_turn, leg_angles_of, leg_of
from devices.emulators.motion.stride import Stride, bump, harmonics, pitch
from devices.emulators.motion.waves import Derivatives, Fade

STRIDE_HZ = 0.9
GRID_HZ = 100.0
RAMP_S = 1.2
"""Within so long a walk reaches its speed, and ends."""
FIRST_STRIKE = 0.5
"""Of the right foot, strides after a walk's begin."""
TRACK = 0.55
"""Distance between the feet's lines over that of the hips, in walking."""
AS_IT_STANDS_M = 0.15
"""A step that would end nearer to where a walk ends goes there at once."""
YAW, OBLIQUITY, SWAY_M = radians(4.0), radians(2.5), 0.015
"""Of the pelvis: towards the leading leg, up on the standing one, to the side of it."""
LONGEST = 0.9995
"""Of the leg's length: the pelvis gives way before a leg is overstretched."""
GIVING_WAY_S = 0.06
"""How gradually it does."""
_DEGREE = 5
_MARGIN = 8


@dataclass(frozen=True)
class Lap:
    """When and where is walked, and what is done in between; times in s from the lap's begin."""

    straight_m: float = 3.3
    """Before each turn and after it."""
    radius_m: float = 1.6
    pause_s: tuple[float, float] = (10.5, 2.5)
    """After the first walk (reaching, a squat) and after the second."""
    lead_s: float = 0.6

    def walk_m(self) -> float:
        """Return the length of each walk."""
        return 2.0 * self.straight_m + pi * self.radius_m

    def walks(self, speed: float) -> list[tuple[float, float]]:
        """Begin and end of both walks."""
        lasts = self.walk_m() / speed + RAMP_S
        second = self.lead_s + lasts + self.pause_s[0]
        return [(self.lead_s, self.lead_s + lasts), (second, second + lasts)]

    def period(self, speed: float) -> float:
        """Return the time until all begins anew, s."""
        return self.walks(speed)[1][1] + self.pause_s[1]


@dataclass(frozen=True)
class Course:
    """The line that is walked along: straight, half a circle to the left, straight, and the same again."""

    lap: Lap
    speed: float
    """m/s."""

    def amount(self, times: FloatArray) -> FloatArray:
        """Return how much of the full speed there is, 0 to 1."""
        return sum(
            (window(times, begin, end, RAMP_S) for begin, end in self.lap.walks(self.speed)),
            np.zeros_like(times),
        )

    def travelled(self, times: FloatArray) -> FloatArray:
        """Return the way since the lap's begin, m."""
        way = np.zeros_like(times)
        for begin, end in self.lap.walks(self.speed):
            way = way + self.speed * (_way(times, begin) - _way(times, end - RAMP_S))
        return way

    def heading(self, s: FloatArray) -> FloatArray:
        """Turn to the left since the begin, rad, at a way s; the turn is entered and left smoothly."""
        lap, one = self.lap, self.lap.walk_m()
        turn, eased = pi * lap.radius_m, 0.5 * lap.straight_m
        total = np.zeros_like(s)
        for n in range(2):
            into, out = n * one + lap.straight_m, n * one + lap.straight_m + turn
            rising = _eased(s, into, eased) - _eased(s, out, eased)
            total = total + rising / lap.radius_m
        return total

    def places(self, s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Forward and right, m, at ways s along the line."""
        step = 0.005
        grid = np.arange(-4 * step, 2.0 * self.lap.walk_m() + 5 * step, step)
        psi = self.heading(grid + 0.5 * step)
        x, z = (
            np.concatenate([[0.0], np.cumsum(step * part(psi))]) for part in (np.cos, lambda a: -np.sin(a))
        )
        at = np.append(grid, grid[-1] + step)
        forward, right = make_interp_spline(at, x, k=5), make_interp_spline(at, z, k=5)
        origin = float(forward(0.0)), float(right(0.0))
        ends = float(forward(2.0 * self.lap.walk_m())), float(right(2.0 * self.lap.walk_m()))
        part = s / (2.0 * self.lap.walk_m())  # what rounding leaves open, closed
        return (
            forward(s) - origin[0] - part * (ends[0] - origin[0]),
            right(s) - origin[1] - part * (ends[1] - origin[1]),
        )


def window(times: FloatArray, begin: float, end: float, ramp: float) -> FloatArray:
    """Return 0 before begin and after end, 1 between; three times continuously differentiable."""
    return Fade(begin, ramp).evaluate(times).value - Fade(end - ramp, ramp).evaluate(times).value


def _way(times: FloatArray, begin: float) -> FloatArray:
    """Return the integral of the rise of a window that begins there."""
    return _eased_way((times - begin) / RAMP_S, RAMP_S)


def _eased_way(u: FloatArray, ramp: float) -> FloatArray:
    v = np.clip(u, 0.0, 1.0)
    way: FloatArray = ramp * v**5 * (7.0 - 14.0 * v + 10.0 * v**2 - 2.5 * v**3)
    return way + ramp * np.maximum(u - 1.0, 0.0)


def _eased(s: FloatArray, at: float, ramp: float) -> FloatArray:
    """Return how far beyond ``at``, m, with a smooth bend of length ``ramp`` about it."""
    return _eased_way((s - at) / ramp + 0.5, ramp)


@dataclass(frozen=True)
class Steps:
    """The stances of one foot in one walk."""

    strikes: FloatArray  # (K,) s; the first is the standing before
    ankle: FloatArray  # (K, 3) m, of the flat foot
    heading: FloatArray  # (K,) rad
    size: FloatArray  # (K,) of the step after each, 1: a full stride


@dataclass
class Plan:
    """Everything on the grid."""

    times: FloatArray
    pelvis: FloatArray  # (T, 3)
    heading: FloatArray  # (T,)
    turns: dict[str, FloatArray] = field(default_factory=dict)
    """Segment to (T, 3) angles about x, y, z, rad."""


def steps_of(leg: Leg, sign: float, walk: tuple[float, float], course: Course, stride: Stride) -> Steps:
    """Return the stances of a foot; ``sign`` is +1 for the right, −1 for the left."""
    begin, end = walk
    first = begin + (FIRST_STRIKE + (0.0 if sign > 0 else 0.5)) / STRIDE_HZ
    count = int(np.ceil((end - first) * STRIDE_HZ)) + 2
    strikes = first + np.arange(-1, count) / STRIDE_HZ
    middle = strikes + stride.carries_at / STRIDE_HZ
    middle[0] = begin
    s, (start, finish) = course.travelled(middle), course.travelled(np.array(walk))
    # A step much shorter than the others looks like stumbling: the feet close where the walk begins and ends.
    s = np.where(finish - s < AS_IT_STANDS_M, finish, np.where(s - start < 0.5 * AS_IT_STANDS_M, start, s))
    stands = (s == start) | (s == finish)
    amount = np.where(stands, 0.0, course.amount(middle))
    psi, (x, z) = course.heading(s), course.places(s)
    aside = leg.hip[2] * (1.0 - (1.0 - TRACK) * amount)
    up = np.full_like(s, leg.hip[1] - leg.thigh - leg.shank)
    ankle = np.stack([x + aside * np.sin(psi), up, z + aside * np.cos(psi)], axis=1)
    far = np.linalg.norm(np.diff(ankle, axis=0), axis=1)
    size = np.append(np.clip(far / stride.length, 0.0, 1.0), 0.0)
    return Steps(strikes, ankle, psi, size)


def foot_at(
    leg: Leg, steps: Steps, stride: Stride, times: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the ankle (T, 3), heading (T,) and pitch (T,; toes up) of a foot."""
    n = np.clip(np.searchsorted(steps.strikes, times, side="right") - 1, 0, len(steps.strikes) - 1)
    phase = np.clip((times - steps.strikes[n]) * STRIDE_HZ, 0.0, 1.0)
    # The last step ends with a flat foot, and the first one begins with one.
    stands_still = (n == len(steps.strikes) - 1) & (phase > 0.5 * (stride.flat_from + stride.flat_to))
    phase = np.where(stands_still, 0.5 * (stride.flat_from + stride.flat_to), phase)
    phase = np.where((n == 0) & (phase < stride.flat_to), 0.5 * (stride.flat_from + stride.flat_to), phase)
    # A stance takes its first half from the step before it, and its second from the step after.
    before = np.append(0.0, steps.size[:-1])[n]
    size = np.where(phase < 0.5 * (stride.flat_from + stride.flat_to), before, steps.size[n])
    angle = size * pitch(stride, phase)

    ankle, part = np.empty((len(times), 3)), np.zeros(len(times))
    for pivot, chosen in (
        (leg.heel, phase < stride.flat_to),
        (leg.toe, (phase >= stride.flat_to) & (phase < stride.toe_off)),
    ):
        lifted = pivot - _turned(angle[chosen], pivot)
        ankle[chosen] = steps.ankle[n[chosen]] + _ahead(steps.heading[n[chosen]], lifted)

    swings = phase >= stride.toe_off
    part[swings] = (phase[swings] - stride.toe_off) / (1.0 - stride.toe_off)
    for k in np.unique(n[swings]):
        chosen = swings & (n == k)
        ankle[chosen] = _swing(leg, steps, int(k), stride, phase[chosen])
    turn = part**4 * (35.0 - 84.0 * part + 70.0 * part**2 - 20.0 * part**3)
    after = np.minimum(n + 1, len(steps.strikes) - 1)
    return ankle, steps.heading[n] + turn * (steps.heading[after] - steps.heading[n]), angle


def _swing(leg: Leg, steps: Steps, k: int, stride: Stride, phase: FloatArray) -> FloatArray:
    """Return the ankle between toe-off of stance k and the heel strike after it."""
    size, after = float(steps.size[k]), min(k + 1, len(steps.strikes) - 1)
    ends = []
    for where, pivot, curve in ((k, leg.toe, stride.push), (after, leg.heel, (*stride.strike, 0.0))):
        derivatives = _pivoted(pivot, [size * value for value in curve])
        place = [_ahead(steps.heading[where : where + 1], part[None])[0] for part in derivatives]
        ends.append([steps.ankle[where] + place[0], *place[1:]])
    ankle: FloatArray = BPoly.from_derivatives([stride.toe_off, 1.0], ends)(phase)
    part = (phase - stride.toe_off) / (1.0 - stride.toe_off)
    raised = np.zeros((len(phase), 2))
    for axis, sizes in ((1, stride.lift), (0, stride.advance)):
        for kind, amount in zip((-1, 0, 1), sizes, strict=True):
            raised[:, axis] += amount * bump(part, kind)
    # Short steps lift the foot less than in proportion would, but never drag it.
    lift = size if size > 0.3 else max(size, 0.3 * min(1.0, size / 0.02))
    heading = np.full(len(phase), 0.5 * (steps.heading[k] + steps.heading[after]))
    return ankle + _ahead(heading, raised * [size, lift])


def _turned(angle: FloatArray, place: FloatArray) -> FloatArray:
    """Return a place (forward, up) turned by the pitch, (T, 2)."""
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([c * place[0] - s * place[1], s * place[0] + c * place[1]], axis=1)


def _pivoted(pivot: FloatArray, curve: list[float]) -> list[FloatArray]:
    """Return the ankle against a flat foot's, (forward, up), with two derivatives by phase, about a still
    point.
    """
    angle, rate, change = curve
    turned = _turned(np.array([angle]), pivot)[0]
    across = np.array([-turned[1], turned[0]])
    return [pivot - turned, -rate * across, -change * across + rate**2 * turned]


def _ahead(heading: FloatArray, place: FloatArray) -> FloatArray:
    """Return (T, 2) forward and up of a foot as (T, 3) of the plan."""
    return np.stack([place[:, 0] * np.cos(heading), place[:, 1], -place[:, 0] * np.sin(heading)], axis=1)


def plan_of(
    body: EmulatedBody, lap: Lap, stride: Stride, times: FloatArray, rng: np.random.Generator
) -> Plan:
    """Return what all parts of the body do at times (T,), s from the lap's begin."""
    course = Course(lap, stride.length * STRIDE_HZ)
    s, amount = course.travelled(times), course.amount(times)
    phase = _phase(times, course)
    legs = {side: leg_of(body, side) for side in ("left", "right")}

    activities = _activities(lap, course, times)
    x, z = course.places(s)
    heading = course.heading(s)
    squat = activities["squat"]
    ahead = amount * harmonics(stride.surge, phase) - 0.13 * squat**2
    aside = amount * SWAY_M * np.cos(2.0 * pi * (phase - stride.carries_at))
    up = amount**2 * (harmonics(stride.bob, phase) - stride.drop) - 0.34 * squat**2
    tilt = amount * stride.tilt + radians(28.0) * squat + radians(6.0) * activities["bow"]
    sway = amount * YAW * np.cos(2.0 * pi * phase)
    yaw = sway + radians(12.0) * activities["twist"]
    oblique = -amount * OBLIQUITY * np.cos(2.0 * pi * (phase - 0.17))

    own = np.stack([oblique, yaw, -tilt], axis=1)
    R_pelvis = Rotation.from_euler("y", heading[:, None]) * Rotation.from_euler("ZXY", own[:, [2, 0, 1]])
    pelvis = np.stack(
        [
            x + ahead * np.cos(heading) + aside * np.sin(heading),
            up,
            z - ahead * np.sin(heading) + aside * np.cos(heading),
        ],
        axis=1,
    )
    # Legs that would be stretched beyond their length lower the pelvis instead.
    feet = {side: _feet(legs[side], 1.0 if side == "right" else -1.0, course, stride, times) for side in legs}
    pelvis[:, 1] -= _giving_way(legs, feet, pelvis, R_pelvis, amount)

    plan = Plan(times, pelvis, heading)
    for side, leg in legs.items():
        ankle, foot_heading, foot_pitch = feet[side]
        turned = leg_angles_of(leg, pelvis, R_pelvis, ankle, foot_turn(foot_heading, foot_pitch))
        for row, part in enumerate(("thigh", "shank", "foot")):
            plan.turns[f"{side}_{part}"] = turned[:, row]
    plan.turns[body.segment_names[0]] = own
    plan.turns.update(_upper_body(amount, phase, tilt, sway, oblique, activities, rng))
    return plan


def _phase(times: FloatArray, course: Course) -> FloatArray:
    """Return the phase of the right foot's stride; each walk counts from its own first step."""
    walks = course.lap.walks(course.speed)
    between = 0.5 * (walks[0][1] + walks[1][0])
    begin = np.where(times < between, walks[0][0], walks[1][0])
    return (times - begin) * STRIDE_HZ - FIRST_STRIKE


def _feet(
    leg: Leg, sign: float, course: Course, stride: Stride, times: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return a foot through both walks."""
    walks = course.lap.walks(course.speed)
    between = 0.5 * (walks[0][1] + walks[1][0])
    both = [foot_at(leg, steps_of(leg, sign, walk, course, stride), stride, times) for walk in walks]
    first = times < between
    ankle = np.where(first[:, None], both[0][0], both[1][0])
    return ankle, np.where(first, both[0][1], both[1][1]), np.where(first, both[0][2], both[1][2])


def _giving_way(
    legs: dict[str, Leg],
    feet: dict[str, tuple[FloatArray, FloatArray, FloatArray]],
    pelvis: FloatArray,
    R_pelvis: Rotation,
    amount: FloatArray,
) -> FloatArray:
    """Return how much lower the pelvis has to be for legs that else were too short, m.

    It changes smoothly, and early enough.
    """
    needed = np.zeros(len(pelvis))
    for side, leg in legs.items():
        reach = feet[side][0] - pelvis - R_pelvis.apply(leg.hip)
        across = np.hypot(reach[:, 0], reach[:, 2])
        longest = (leg.thigh + leg.shank) * (1.0 - (1.0 - LONGEST) * np.minimum(1.0, 20.0 * amount))
        needed = np.maximum(needed, -reach[:, 1] - np.sqrt(np.maximum(longest**2 - across**2, 0.0)))
    needed = np.where(needed > 1e-9, needed, 0.0)
    near = round(4.0 * GIVING_WAY_S * GRID_HZ)
    # The largest need nearby, smoothed: an average alone would be too little at the peaks.
    padded = np.pad(needed, near, mode="edge")
    widest = np.lib.stride_tricks.sliding_window_view(padded, 2 * near + 1).max(axis=1)
    smooth: FloatArray = gaussian_filter1d(widest, GIVING_WAY_S * GRID_HZ, truncate=4.0, mode="nearest")
    return smooth


def _activities(lap: Lap, course: Course, times: FloatArray) -> dict[str, FloatArray]:
    """Return the amounts, 0 to 1, of what is done while standing."""
    (_, first), (_, second) = lap.walks(course.speed)
    t, u = first + 0.3, second
    return {
        "right_reach": window(times, t, t + 3.0, 1.1),
        "left_reach": window(times, t + 3.0, t + 6.0, 1.1),
        "squat": window(times, t + 6.2, t + 9.8, 1.5),
        "twist": window(times, t, t + 3.0, 1.2) - window(times, t + 3.0, t + 6.0, 1.2),
        "bow": window(times, t, t + 6.0, 1.2),
        "wave": window(times, u, u + 2.3, 0.8),
    }


def _upper_body(
    amount: FloatArray,
    phase: FloatArray,
    tilt: FloatArray,
    sway: FloatArray,
    oblique: FloatArray,
    activities: dict[str, FloatArray],
    rng: np.random.Generator,
) -> dict[str, FloatArray]:
    """Return trunk, head and arms: the trunk turns against the pelvis, each arm swings with the other side's
    leg."""
    swing = 2.0 * pi * phase
    nothing = np.zeros_like(phase)
    thorax = np.stack(
        [
            -0.8 * oblique,
            -2.0 * sway + radians(14.0) * activities["twist"],
            0.8 * tilt - radians(3.0) * amount,
        ],
        axis=1,
    )
    turns = {
        "thorax": thorax,
        "head": np.stack([nothing, 0.9 * sway, 0.2 * tilt + radians(2.0) * amount], axis=1),
    }
    for side, sign in (("right", 1.0), ("left", -1.0)):
        size, squat = rng.uniform(0.92, 1.08), activities["squat"]
        forward = -sign * np.cos(swing - 0.25)
        reach = activities[f"{side}_reach"]
        wave = activities["wave"] if side == "right" else nothing
        turns[f"{side}_upper_arm"] = np.stack(
            [
                -sign * radians(4.0) * (amount + squat) + sign * radians(20.0) * reach,
                sign * radians(8.0) * reach,
                radians(17.0 * size) * amount * forward
                + radians(118.0) * reach
                + radians(80.0) * squat
                + radians(62.0) * wave,
            ],
            axis=1,
        )
        turns[f"{side}_forearm"] = np.stack(
            [
                nothing,
                sign * radians(18.0) * amount,
                amount * (radians(24.0) + radians(9.0 * size) * forward)
                + radians(22.0) * reach
                + radians(10.0) * squat
                + wave * (radians(75.0) + radians(18.0) * np.sin(2.0 * pi * 1.3 * (phase / STRIDE_HZ))),
            ],
            axis=1,
        )
        turns[f"{side}_hand"] = np.stack(
            [nothing, nothing, radians(6.0) * amount - radians(15.0) * reach], axis=1
        )
    return turns


class SplineRows:
    """Angles of N segments, or the three coordinates of a path, as splines that begin anew after a lap."""

    def __init__(
        self, coefficients: FloatArray, begin_s: float, step_s: float, nodes: IntArray | None = None
    ):
        """Hold coefficients (6, K, N, 3) of powers from each of K knots on, highest first.

        begin_s: until then the first values hold. nodes: the rows meant, in that order; default: all.
        """
        self._coefficients, self._begin_s, self._step_s = coefficients, begin_s, step_s
        self._nodes = np.arange(coefficients.shape[2]) if nodes is None else nodes

    @classmethod
    def through(cls, times: FloatArray, values: FloatArray, begin_s: float, period_s: float) -> SplineRows:
        """Return splines through values (T, N, 3) at even times (T,), s from the lap's begin; with margins"""
        spline = make_interp_spline(times, values.reshape(len(times), -1), k=_DEGREE)
        knots = times[(times > -1e-9) & (times < period_s - 1e-9)]
        powers = [spline.derivative(m)(knots) / factorial(m) for m in range(_DEGREE, 0, -1)]
        coefficients = np.array([*powers, spline(knots)])
        step_s = float(times[1] - times[0])
        return cls(coefficients.reshape(_DEGREE + 1, len(knots), *values.shape[1:]), begin_s, step_s)

    def with_idle_row(self) -> SplineRows:
        """Return one node more, which never turns."""
        idle = np.zeros((*self._coefficients.shape[:2], 1, 3))
        coefficients = np.concatenate([self._coefficients, idle], axis=2)
        nodes = np.append(self._nodes, self._coefficients.shape[2])
        return SplineRows(coefficients, self._begin_s, self._step_s, nodes)

    def rows(self, rows: IntArray) -> SplineRows:
        """Return some rows only, in that order; coefficients stay where they are."""
        return SplineRows(self._coefficients, self._begin_s, self._step_s, self._nodes[rows])

    def evaluate(self, times: FloatArray, fade: Derivatives) -> list[Derivatives]:
        """Return the three components at ``times`` (T, N), each (T, N), with their derivatives."""
        at = np.maximum(times.astype(np.float64) - self._begin_s, 0.0)
        n_knots = self._coefficients.shape[1]
        at = np.mod(at, n_knots * self._step_s)
        interval = np.minimum((at / self._step_s).astype(np.int64), n_knots - 1)
        since = at - interval * self._step_s
        return [self._component(axis, interval, since) for axis in range(3)]

    def _component(self, axis: int, interval: IntArray, since: FloatArray) -> Derivatives:
        c = self._coefficients[:, interval, self._nodes, axis]
        value, rate, acceleration = np.zeros((3, *since.shape))
        for k in range(_DEGREE + 1):
            acceleration = acceleration * since + 2.0 * rate
            rate = rate * since + value
            value = value * since + c[k]
        return Derivatives(value, rate, acceleration)


@dataclass(frozen=True)
class SplinePath:
    """Where the root's joint is and where it faces; a root path of ``kinematics_truth``."""

    places: SplineRows
    """One row: east, north, up, m."""
    facing: SplineRows
    """One row, of which the first component is the turn to the left, rad."""

    def evaluate(self, times: FloatArray, fade: Derivatives) -> list[Derivatives]:
        """Return world coordinates at ``times`` (T, M)."""
        return self.places.rows(np.zeros(times.shape[1], np.int64)).evaluate(times, fade)

    def heading(self, times: FloatArray) -> Derivatives:
        """Turn to the left since the begin, rad."""
        still = np.zeros_like(times)
        one = self.facing.rows(np.zeros(times.shape[1], np.int64))
        return one.evaluate(times, Derivatives(still, still, still))[0]


def planned_lap(
    body: EmulatedBody, seed: int, fade: Fade, lap: Lap, stride: Stride
) -> tuple[SplineRows, SplinePath]:
    """Return joint angles and the pelvis' path. Raises ``ValueError`` for a body without two legs."""
    stride = stride.scaled((leg := leg_of(body, "left")).thigh + leg.shank)
    period_s = lap.period(stride.length * STRIDE_HZ)
    n = round(period_s * GRID_HZ)
    step_s = period_s / n
    # A margin at both ends, so that the spline is as smooth where the lap repeats.
    times = np.asarray(step_s * np.arange(-_MARGIN, n + _MARGIN + 1), np.float64)
    plan = plan_of(body, lap, stride, times, np.random.default_rng([seed, 5]))
    angles = np.zeros((len(times), body.n_segments, 3))
    for segment, turns in plan.turns.items():
        if segment in body.segment_names:
            angles[:, body.segment_names.index(segment)] = turns

    R_reference = Rotation.from_quat(body.reference_posture[0], scalar_first=True)
    world = R_reference.apply(plan.pelvis)[:, None]
    facing = np.zeros((len(times), 1, 3))
    facing[:, 0, 0] = plan.heading
    rows = [SplineRows.through(times, values, fade.rest_s, period_s) for values in (angles, world, facing)]
    return rows[0], SplinePath(rows[1], rows[2])
