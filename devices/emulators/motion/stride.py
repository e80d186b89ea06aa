"""One stride of somebody who walks: where pelvis and feet are, so that the joints turn as published.

Phases are parts of the stride from the right foot's heel strike on. The foot rolls over heel, sole and ball
without slipping; hip, knee and ankle follow by inverse kinematics (``legs``). Constants of ``STRIDE`` are
a least-squares fit of the three angles to the means of ``devices.normal_gait``, in units of their standard
deviations; a test holds them within one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from devices.deferred import BPoly
from devices.emulators.bodies import FloatArray

FITTED_LEG_M = 0.860
"""Thigh and shank of the body that the stride was fitted for: others' lengths are in proportion."""


@dataclass(frozen=True)
class Stride:
    """Shape of the stride. Angles in rad and lengths in m, rates by phase; toes up is positive."""

    length: float = 1.39
    carries_at: float = 0.3
    """Phase at which the pelvis is above the flat foot's ankle."""
    flat_from: float = 0.09
    """Until then the foot turns about its heel."""
    flat_to: float = 0.34
    """From then on about its ball."""
    toe_off: float = 0.615
    strike: tuple[float, float] = (0.28, -3.0)
    """Pitch of the foot at heel strike, and its rate."""
    push: tuple[float, float, float] = (-1.08, -5.0, 60.0)
    """Pitch at toe-off, its rate and its change."""
    rise: tuple[float, float] = (0.0, 0.0)
    """Bumps of the pitch between flat and toe-off."""
    swing_pitch: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Bumps of the pitch in swing: early, middle, late."""
    lift: tuple[float, float, float] = (0.05, 0.02, 0.0)
    """Bumps of the ankle's height in swing."""
    advance: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Bumps of the ankle's way forward in swing."""
    drop: float = 0.02
    """Pelvis lower than in standing."""
    bob: tuple[float, ...] = (-0.01, 0.0, 0.0, 0.0, 0.0, 0.0)
    """Cosines and sines of the pelvis' height, in turn, at 2, 4, 6 … times the stride."""
    surge: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)
    """The same of its way forward."""
    tilt: float = 0.19
    """Of the pelvis, forward."""

    def scaled(self, leg_m: float) -> Stride:
        """Return the same stride of somebody whose thigh and shank together are ``leg_m`` long."""
        ratio = leg_m / FITTED_LEG_M
        return replace(
            self,
            length=ratio * self.length,
            lift=_times(self.lift, ratio),
            advance=_times(self.advance, ratio),
            drop=ratio * self.drop,
            bob=tuple(ratio * size for size in self.bob),
            surge=tuple(ratio * size for size in self.surge),
        )


def _times(sizes: tuple[float, float, float], ratio: float) -> tuple[float, float, float]:
    return sizes[0] * ratio, sizes[1] * ratio, sizes[2] * ratio


def bump(part: FloatArray, kind: int) -> FloatArray:
    """Return a bump, 0 at both ends of 0 … 1 with four derivatives; kind −1: early, 0: middle, 1: late."""
    shape = np.clip(4.0 * part * (1.0 - part), 0.0, 1.0) ** 5
    return shape * (1.0 + (4.0 * (part - 0.5) if kind > 0 else -4.0 * (part - 0.5)) if kind else shape**0)


def pitch(stride: Stride, phase: FloatArray) -> FloatArray:
    """Return the pitch of a foot at a phase (T,) of its own stride, rad; twice continuously
    differentiable."""
    strike, flat, still = [*stride.strike, 0.0], [0.0] * 4, [0.0] * 4
    knots = [0.0, stride.flat_from, stride.flat_to, stride.toe_off, 1.0]
    curve: FloatArray = BPoly.from_derivatives(knots, [strike, flat, still, [*stride.push], strike])(phase)
    rising = (phase - stride.flat_to) / (stride.toe_off - stride.flat_to)
    swinging = (phase - stride.toe_off) / (1.0 - stride.toe_off)
    for kind, size in zip((-1, 1), stride.rise, strict=True):
        curve = curve + size * bump(rising, kind)
    for kind, size in zip((-1, 0, 1), stride.swing_pitch, strict=True):
        curve = curve + size * bump(swinging, kind)
    return curve


def harmonics(pairs: tuple[float, ...], phase: FloatArray) -> FloatArray:
    """Sum of cosines and sines at 2, 4, … times the stride."""
    angle = 4.0 * np.pi * phase
    total = np.zeros_like(phase)
    for n, (a, b) in enumerate(zip(pairs[::2], pairs[1::2], strict=True), 1):
        total = total + a * np.cos(n * angle) + b * np.sin(n * angle)
    return total


STRIDE = Stride(
    length=1.3147,
    carries_at=0.22,
    flat_from=0.1033,
    flat_to=0.22,
    toe_off=0.5849,
    strike=(0.155, -4.4641),
    push=(-0.7428, -6.4043, -126.1429),
    rise=(-0.0795, 0.0953),
    swing_pitch=(0.2708, 0.0742, -0.1694),
    lift=(0.0577, -0.0469, 0.0012),
    advance=(-0.0286, -0.1406, -0.0112),
    drop=0.0238,
    bob=(-0.0091, -0.0075, -0.0009, 0.0027, 0.0013, 0.0012),
    surge=(0.0328, -0.0135, -0.0004, 0.0029),
    tilt=0.2226,
)
"""Fitted to ``devices.normal_gait``."""
