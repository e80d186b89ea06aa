"""What befalls a single module besides the motion of its body: a tap of a finger, a shake by hand.

Both are added to what its sensors feel, in sensor axes, as functions of the true time. They are no exact
kinematics: the orientation after them is that of the body, and the magnetometer feels nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from devices.emulators.bodies import FloatArray

_TAP_DIRECTION = np.array([0.2, -0.3, 0.93])
_TAP_AXIS = np.array([0.8, 0.6, 0.0])
# Sampled at 100 Hz, at whatever phase, one of the first three samples has 0.3 of the peak or more.
_TAP_FREQUENCY_HZ = 40.0
_TAP_LASTS = 8  # decay times

_SHAKE_DIRECTION = np.array([0.9, 0.4, -0.2])
_SHAKE_AXIS = np.array([0.3, -0.2, 0.93])


class Disturbance(Protocol):
    """Added to a module's true readings while it lasts."""

    @property
    def start_s(self) -> float:
        """True time at which it begins, s."""
        ...

    @property
    def end_s(self) -> float:
        """True time at which it ends, s."""
        ...

    def at(self, times: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return specific force (m/s²) and angular rate (rad/s) to add at true times (n,): two of (n, 3)."""
        ...


@dataclass(frozen=True)
class Tap:
    """A short damped ringing."""

    start_s: float
    specific_force: float = 40.0
    """Peak, m/s²."""
    angular_rate: float = 3.0
    """Peak, rad/s."""
    decay_s: float = 0.03

    @property
    def end_s(self) -> float:
        """When it is over, s."""
        return self.start_s + _TAP_LASTS * self.decay_s

    def at(self, times: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return what the tap adds at times (n,), s: specific force, m/s², and angular rate, rad/s, (n, 3)
        each.
        """
        t = times - self.start_s
        is_on = (times >= self.start_s) & (times < self.end_s)
        ringing = np.where(is_on, np.exp(-np.maximum(t, 0.0) / self.decay_s), 0.0)
        ringing = (ringing * np.cos(2 * np.pi * _TAP_FREQUENCY_HZ * t))[:, None]
        return self.specific_force * ringing * _TAP_DIRECTION, self.angular_rate * ringing * _TAP_AXIS


@dataclass(frozen=True)
class Shake:
    """A swing to and fro that fades in and out; the turns cancel over its length."""

    start_s: float
    duration_s: float
    specific_force: float = 15.0
    """Peak, m/s²."""
    angular_rate: float = 6.0
    """Peak, rad/s."""
    frequency_hz: float = 4.0

    @property
    def end_s(self) -> float:
        """When it is over, s."""
        return self.start_s + self.duration_s

    def at(self, times: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return what the shake adds at times (n,), s: specific force, m/s², and angular rate, rad/s, (n, 3)
        each.
        """
        t = times - self.start_s
        is_on = (times >= self.start_s) & (times < self.end_s)
        envelope = np.where(is_on, np.sin(np.pi * t / self.duration_s) ** 2, 0.0)
        # A whole number of swings: the module ends where it began, at rest.
        swings = max(1, round(self.frequency_hz * self.duration_s))
        phase = 2 * np.pi * swings * t / self.duration_s
        force = self.specific_force * (envelope * np.cos(phase))[:, None] * _SHAKE_DIRECTION
        return force, self.angular_rate * (envelope * np.sin(phase))[:, None] * _SHAKE_AXIS


def felt(disturbances: Sequence[Disturbance], times: FloatArray) -> tuple[FloatArray, FloatArray] | None:
    """Return what all of them add at true times (n,) in order, n > 0; None when none of them lasts then."""
    now = [one for one in disturbances if one.start_s <= times[-1] and times[0] < one.end_s]
    if not now:
        return None
    parts = [one.at(times) for one in now]
    return np.sum([force for force, _ in parts], axis=0), np.sum([rate for _, rate in parts], axis=0)
