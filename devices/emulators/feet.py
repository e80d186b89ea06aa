"""Where a foot is during a gait: stances that stand still, swings between them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from devices.deferred import BPoly
from devices.emulators.bodies import FloatArray
from devices.emulators.legs import Leg

if TYPE_CHECKING:
    from devices.emulators.gait import Gait, PlannedPath


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
