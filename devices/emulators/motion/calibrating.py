"""A wearer who goes through a body calibration: poses, squats, legs, arms, then everything at once.

The timetable is that of ``devices.calibration_script``. Joint angles are a script: amounts that are faded in
and out, at rest or swinging, one after another. It is made of terms
``amplitude · window(t) · sin(2π frequency (t − begin) + phase)``, whose window rises within ``ramp`` from
``begin`` on and falls within ``ramp`` before ``end``; all derivatives are exact.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import pi, radians
from typing import NamedTuple

import numpy as np

from devices.calibration_script import PERIOD_S, timetable
from devices.deferred import Rotation
from devices.emulators.bodies import EmulatedBody, FloatArray, IntArray
from devices.emulators.motion.motions import BodyMotion
from devices.emulators.motion.waves import Derivatives, Fade


class Term(NamedTuple):
    """One contribution to one angle."""

    row: int
    axis: int
    amplitude: float  # rad
    begin: float  # s
    end: float  # s
    ramp: float = 0.8  # s
    frequency: float = 0.0  # Hz; 0 with phase π/2: a constant
    phase: float = pi / 2


def pulses(row: int, axis: int, angle: float, begin: float, end: float, count: int) -> list[Term]:
    """Return terms, angle (1 − cos) / 2, from 0 to the angle and back ``count`` times from begin to end."""
    frequency = count / (end - begin)
    ramp = min(0.3, 0.1 * (end - begin))
    return [
        Term(row, axis, 0.5 * angle, begin, end, ramp),
        Term(row, axis, 0.5 * angle, begin, end, ramp, frequency, -pi / 2),
    ]


@dataclass(frozen=True)
class Script:
    """Terms of N rows of three angles; begins anew after ``period``."""

    period: float
    amplitude: FloatArray  # (N, 3, K), as all the others
    begin: FloatArray
    end: FloatArray
    ramp: FloatArray
    frequency: FloatArray
    phase: FloatArray

    @classmethod
    def of(cls, n_rows: int, terms: list[Term], period: float) -> Script:
        """Return the script of a list of terms."""
        used: dict[tuple[int, int], int] = {}
        slots = []
        for term in terms:
            key = (term.row, term.axis)
            slots.append(used.get(key, 0))
            used[key] = slots[-1] + 1
        arrays = np.zeros((6, n_rows, 3, max(used.values(), default=1)))
        arrays[3] = 1.0  # a ramp that is nowhere divided by as 0
        for k, term in zip(slots, terms, strict=True):
            values = (term.amplitude, term.begin, term.end, term.ramp, term.frequency, term.phase)
            arrays[:, term.row, term.axis, k] = values
        return cls(period, *arrays)

    def rows(self, rows: IntArray) -> Script:
        """Return some rows only, in that order."""
        return Script(self.period, *(array[rows] for array in self._arrays()))

    def with_idle_row(self) -> Script:
        """Return one row more, which never moves."""
        idle = [np.zeros((1, *array.shape[1:])) for array in self._arrays()]
        idle[3] += 1.0
        pairs = zip(self._arrays(), idle, strict=True)
        return Script(self.period, *(np.concatenate([array, none]) for array, none in pairs))

    def evaluate(self, times: FloatArray, fade: Derivatives) -> list[Derivatives]:
        """Return the three angles at ``times`` (T, N), each (T, N); the script has its own fades."""
        at = np.mod(times, self.period)
        return [self._component(axis, at) for axis in range(3)]

    def _arrays(self) -> tuple[FloatArray, ...]:
        return self.amplitude, self.begin, self.end, self.ramp, self.frequency, self.phase

    def _component(self, axis: int, times: FloatArray) -> Derivatives:
        value, rate, acceleration = np.zeros((3, *times.shape), times.dtype)
        for k in range(self.amplitude.shape[2]):
            amplitude, begin, end, ramp, frequency, phase = (a[:, axis, k] for a in self._arrays())
            if not amplitude.any():
                continue
            window = _window(times, begin, end, ramp)
            omega = 2.0 * pi * frequency
            angle = omega * (times - begin) + phase
            sine, cosine = amplitude * np.sin(angle), amplitude * np.cos(angle)
            # Product rule, twice: the window's own derivatives matter while it opens and closes.
            value += window.value * sine
            rate += window.rate * sine + window.value * omega * cosine
            acceleration += (window.acceleration - window.value * omega**2) * sine
            acceleration += 2.0 * window.rate * omega * cosine
        return Derivatives(value, rate, acceleration)


def _window(times: FloatArray, begin: FloatArray, end: FloatArray, ramp: FloatArray) -> Derivatives:
    rise = Fade(begin, ramp).evaluate(times)  # type: ignore[arg-type]  # arrays, row by row
    fall = Fade(end - ramp, ramp).evaluate(times)  # type: ignore[arg-type]
    return Derivatives(*(up - down for up, down in zip(rise, fall, strict=True)))


_KNEE_BEND = radians(45.0)  # of thigh and shank against the vertical in the squat
_SETTLING_S = 0.6  # the wearer is in position so long before a pose begins


@dataclass(frozen=True)
class WearerFaults:
    """What a wearer does wrong, for trying whether it is noticed."""

    pose_error: float = radians(1.5)
    """Of every segment in a pose, about each axis, rad (standard deviation): nobody stands as drawn."""
    moving: str | None = None
    """Segment that turns during the N-pose."""
    moving_angle: float = radians(14.0)
    effort: float = 1.0
    """Size of the movements; 0.1: far too small."""
    wobble: float = 0.0
    """Movements' axis wanders from one repetition to the next by about so much, rad."""


def calibration_motion(
    body: EmulatedBody, seed: int, heading: float = 0.0, faults: WearerFaults | None = None
) -> BodyMotion:
    """Return the whole script, facing ``heading`` (rad, anticlockwise from east)."""
    faults = faults or WearerFaults()
    rng = np.random.default_rng([seed, 11])
    rows = {name: n for n, name in enumerate(body.segment_names)}
    times = timetable()
    terms = [
        *_poses(body, rows, times, rng, faults),
        *_squat(rows, times["squat"], faults),
        *_legs(rows, times, faults),
        *_arms(rows, times["arms"], faults),
        *_free(rows, times["free"], rng, faults.effort),
        *_wobble(rows, times, rng, faults.wobble),
    ]
    # The pelvis goes down by as much as the bent knees shorten the legs.
    begin, end = times["squat"]
    depth = pulses(0, 2, _KNEE_BEND * faults.effort, begin + 0.3, end - 0.3, 2)
    leg = _length(body, "left_shank") + _length(body, "left_foot")
    path = SquatPath(Script.of(1, depth, PERIOD_S), leg, heading)
    return BodyMotion(body, Script.of(body.n_segments, terms, PERIOD_S), path)


def strapped_on(body: EmulatedBody, seed: int, displacement: float = 0.02) -> EmulatedBody:
    """Return a body with modules turned at random, each displaced by so much (m) in a random direction."""
    rng = np.random.default_rng([seed, 12])
    turned = Rotation.random(body.n_segments, random_state=rng).as_quat(scalar_first=True)
    away = rng.normal(size=(body.n_segments, 3))
    away *= displacement / np.linalg.norm(away, axis=1, keepdims=True)
    return replace(body, sensor_to_segment=turned, module_positions=body.module_positions + away)


@dataclass(frozen=True)
class SquatPath:
    """The root goes down as the thighs turn forward, so that the feet stay where they are."""

    bend: Script
    """One row: the angle of thigh and shank against the vertical, third component, rad."""
    leg: float
    """Length of thigh and shank together, m."""
    facing: float
    """rad, anticlockwise from east."""

    def evaluate(self, times: FloatArray, fade: Derivatives) -> list[Derivatives]:
        """Return the position of the root's joint in the world and its derivatives, each (T, N)."""
        bend = self.bend.rows(np.zeros(times.shape[1], dtype=np.int64)).evaluate(times, fade)[2]
        sine, cosine = np.sin(bend.value), np.cos(bend.value)
        still = np.zeros_like(times)
        level = Derivatives(still, still, still)
        down = Derivatives(
            -self.leg * (1.0 - cosine),
            -self.leg * sine * bend.rate,
            -self.leg * (cosine * bend.rate**2 + sine * bend.acceleration),
        )
        return [level, level, down]

    def heading(self, times: FloatArray) -> Derivatives:
        """Constant."""
        still = np.zeros_like(times)
        return Derivatives(still + self.facing, still, still)


def _length(body: EmulatedBody, segment: str) -> float:
    if segment not in body.segment_names:
        return 0.0
    return float(np.linalg.norm(body.offsets[body.segment_names.index(segment)]))


def _poses(
    body: EmulatedBody,
    rows: dict[str, int],
    times: dict[str, tuple[float, float]],
    rng: np.random.Generator,
    faults: WearerFaults,
) -> list[Term]:
    """Return both poses, each a little wrong, the arms spread, and one segment that will not be still."""
    terms = []
    for pose in ("n_pose", "t_pose"):
        begin, end = times[pose]
        begin, end = begin - _SETTLING_S - 1.0, end + 1.0
        wrong = rng.normal(0.0, faults.pose_error, (len(rows), 3))
        for row in rows.values():  # of the segments against the drawing, not of joint upon joint
            parent = int(body.parents[row])
            joint = wrong[row] - (wrong[parent] if parent >= 0 else 0.0)
            terms += [Term(row, axis, joint[axis], begin, end, 1.0) for axis in range(3)]
    begin, end = times["t_pose"]
    for side, sign in (("left", 1.0), ("right", -1.0)):
        if (arm := rows.get(f"{side}_upper_arm")) is not None:
            terms.append(Term(arm, 0, sign * pi / 2, begin - _SETTLING_S - 1.5, end + 1.5, 1.5))
    first = times["n_pose"][0] - 1.0
    for axis, sway in ((0, 0.15), (2, 0.25)):  # nobody stands like a statue
        terms.append(Term(0, axis, radians(sway), first, times["t_pose"][1], 0.8, 0.3 + 0.1 * axis, 0.0))
    if faults.moving is not None:
        begin, end = times["n_pose"]
        terms += pulses(rows[faults.moving], 0, faults.moving_angle, begin + 0.5, end - 0.5, 1)
    return terms


def _squat(rows: dict[str, int], span: tuple[float, float], faults: WearerFaults) -> list[Term]:
    """Return two squats; the trunk leans forward, the feet stay."""
    begin, end = span
    knee, lean = _KNEE_BEND * faults.effort, radians(35.0) * faults.effort
    terms = pulses(0, 2, -lean, begin + 0.3, end - 0.3, 2)
    for side in ("left", "right"):
        for part, angle in (("thigh", knee + lean), ("shank", -2.0 * knee), ("foot", knee)):
            if (row := rows.get(f"{side}_{part}")) is not None:
                # hip and ankle make up for lean and knee
                terms += pulses(row, 2, angle, begin + 0.3, end - 0.3, 2)
    return terms


def _legs(rows: dict[str, int], times: dict[str, tuple[float, float]], faults: WearerFaults) -> list[Term]:
    """Return the movements of each leg: forward stretched, the knee up, and both again."""
    terms = []
    for side in ("left", "right"):
        begin, end = times[f"{side}_leg"]
        quarters = np.linspace(begin + 0.2, end - 0.2, 5)
        swing, lift = radians(45.0) * faults.effort, radians(65.0) * faults.effort
        for quarter in range(4):
            span = float(quarters[quarter]), float(quarters[quarter + 1])
            angle = lift if quarter % 2 else swing
            if (thigh := rows.get(f"{side}_thigh")) is not None:
                terms += pulses(thigh, 2, angle, *span, 1)
            if (shank := rows.get(f"{side}_shank")) is not None and quarter % 2:
                terms += pulses(shank, 2, -lift, *span, 1)
    return terms


def _arms(rows: dict[str, int], span: tuple[float, float], faults: WearerFaults) -> list[Term]:
    """Return both stretched arms going forward and up, twice."""
    begin, end = span
    terms = []
    for side in ("left", "right"):
        if (row := rows.get(f"{side}_upper_arm")) is not None:
            terms += pulses(row, 2, radians(100.0) * faults.effort, begin + 0.2, end - 0.2, 2)
    return terms


_FREE: dict[str, tuple[float, float, float]] = {
    "pelvis": (22, 35, 25),
    "thorax": (15, 25, 15),
    "head": (20, 30, 20),
    "shoulder_girdle": (15, 15, 8),
    "upper_arm": (35, 20, 40),
    "forearm": (4, 50, 40),
    "hand": (25, 4, 30),
    "thigh": (25, 20, 40),
    "shank": (2, 4, 40),
    "foot": (20, 8, 25),
}
"""Amplitudes about x, y, z in the free movement, degrees."""


def _free(
    rows: dict[str, int], span: tuple[float, float], rng: np.random.Generator, effort: float
) -> list[Term]:
    """Return all joints moving about all their axes."""
    begin, end = span
    terms = []
    for name, row in rows.items():
        part = name.partition("_")[2] if name.startswith(("left_", "right_")) else name
        for axis, degrees in enumerate(_FREE.get(part, (8, 8, 8))):
            angle, frequency = radians(degrees) * effort, rng.uniform(0.45, 0.9)
            terms.append(Term(row, axis, angle, begin, end, 1.5, frequency, rng.uniform(0, 2 * pi)))
            if part in ("shank", "forearm") and axis == 2:  # bent in the mean: neither goes the other way
                terms.append(Term(row, 2, (-1.2 if part == "shank" else 1.2) * angle, begin, end, 1.5))
    return terms


def _wobble(
    rows: dict[str, int],
    times: dict[str, tuple[float, float]],
    rng: np.random.Generator,
    amount: float,
) -> list[Term]:
    """Return, beside the movement asked for, another one that differs between its repetitions."""
    terms: list[Term] = []
    if amount == 0.0:
        return terms
    moved = {
        "squat": ["pelvis"],
        "left_leg": ["left_thigh"],
        "right_leg": ["right_thigh"],
        "arms": ["left_upper_arm", "right_upper_arm"],
    }
    for step, names in moved.items():
        begin, end = times[step]
        # The second half deviates the other way, so that repetitions disagree.
        middle = 0.5 * (begin + end)
        for name in names:
            if name in rows:
                sign = float(rng.choice([-1.0, 1.0]))
                terms += pulses(rows[name], 1, sign * amount, begin + 0.2, middle, 2)
                terms += pulses(rows[name], 1, -sign * amount, middle, end - 0.2, 2)
    return terms
