"""What gyroscope and accelerometer of a device felt, made again from the orientations that it fused of them.

Specific force is linear acceleration and gravity in sensor axes. Angular rate is the turn between the samples
before and after, by the mean interval: arrival times are too uneven to divide by. So a sample is complete
when the next one comes, and the rates of all samples add up to the turn between the first and the last.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from devices.vendor_protocols.rotations import Quaternion
from firmware_protocol.samples import STANDARD_GRAVITY
from gateway.clocks import ArrivalClock, ArrivalLine
from gateway.frames import Vector3

_MOST_TURN = math.radians(2600.0)
"""rad/s; gyroscopes end at 2000 deg/s. What turns faster has been set anew."""
_LONGEST_GAP = 12
"""Intervals between two samples, over which the turn between them is still their rate."""


class Arrival(NamedTuple):
    """One sample that came."""

    number: int
    """Counted with those that were lost."""
    intervals: int
    """Since the sample before."""
    stamp_us: int
    """For ``UnfusedSensor.clock``, 32 bits."""


class Felt(NamedTuple):
    """What the sensors felt at one sample."""

    number: int
    time_ns: int
    specific_force: Vector3  # m/s², sensor axes
    angular_rate: Vector3  # rad/s, sensor axes


class _Pose(NamedTuple):
    """One sample, as far as it has come."""

    number: int
    time_ns: int
    since_s: float  # the sample before; 0: it follows on none
    orientation: Quaternion
    turn: Vector3  # rotation vector since the sample before, sensor axes, rad


class UnfusedSensor:
    """Orientations of one sensor, in order, to what its gyroscope and accelerometer felt."""

    def __init__(self) -> None:
        self.acceleration: Vector3 | None = None
        """The newest, linear, m/s², sensor axes; None: it sends none."""
        self.line = ArrivalLine()
        self.clock = ArrivalClock(self.line)
        self.leaps = 0
        """Orientations that nothing can have turned to since the one before."""
        self._number = -1
        self.begin()

    def begin(self) -> None:
        """Follow on nothing: the device counts from anew."""
        self._missed = 0
        self._newest: _Pose | None = None

    def arrived(self, missed: int, arrived_ns: int) -> Arrival:
        """Count a sample. missed: packets of the device that have not come, since it began to count.

        Of packets that hold samples or else, as many were samples as the time allows.
        """
        anew = max(missed - self._missed, 0)
        # Some of the missing packets may have held no samples: no more are taken for samples than fit the
        # time.
        step = 1 + min(anew, self.line.intervals_since(arrived_ns) - 1)
        self._missed = missed
        self._number += step
        return Arrival(self._number, step, self.line.instant(step, arrived_ns) // 1000 % 2**32)

    def complete(self, arrival: Arrival, time_ns: int, q_es: Quaternion) -> Felt | None:
        """Take the orientation of a sample; return what was felt at the one before, where that is known.

        time_ns: of the sample; q_es: w x y z, its norm near 1, to any level reference e.
        """
        q, before = _unit(q_es), self._newest
        since_s = arrival.intervals * self.line.interval_ns * 1e-9
        turn = (0.0, 0.0, 0.0) if before is None else _turn(before.orientation, q)
        # A leap between two orientations is the device's filter correcting itself, and no motion.
        is_leap = since_s > 0.0 and math.hypot(*turn) > _MOST_TURN * since_s
        follows = before is not None and not is_leap and arrival.intervals <= _LONGEST_GAP
        newest = _Pose(arrival.number, time_ns, since_s if follows else 0.0, q, turn)
        self._newest = newest
        self.leaps += is_leap
        if before is None or not before.since_s or not newest.since_s:
            return None
        force = _force(before.orientation, self.acceleration or (0.0, 0.0, 0.0))
        return Felt(before.number, before.time_ns, force, _rate(before, newest))


def _force(q_es: Quaternion, linear: Vector3) -> Vector3:
    w, x, y, z = q_es
    up_x, up_y, up_z = 2.0 * (x * z - w * y), 2.0 * (y * z + w * x), w * w - x * x - y * y + z * z
    return (
        linear[0] + STANDARD_GRAVITY * up_x,
        linear[1] + STANDARD_GRAVITY * up_y,
        linear[2] + STANDARD_GRAVITY * up_z,
    )


def _rate(pose: _Pose, after: _Pose) -> Vector3:
    """Return the rate at a sample from the turns to it and from it, which may take unequally long."""
    h1, h2 = pose.since_s, after.since_s
    a, b = h2 / (h1 * (h1 + h2)), h1 / (h2 * (h1 + h2))
    x1, y1, z1 = pose.turn
    x2, y2, z2 = after.turn
    return a * x1 + b * x2, a * y1 + b * y2, a * z1 + b * z2


def _turn(q_ea: Quaternion, q_eb: Quaternion) -> Vector3:
    """Return the rotation vector from a to b, in the axes of either, rad."""
    w1, x1, y1, z1 = q_ea
    w2, x2, y2, z2 = q_eb
    w = w1 * w2 + x1 * x2 + y1 * y2 + z1 * z2
    x = w1 * x2 - x1 * w2 - y1 * z2 + z1 * y2
    y = w1 * y2 + x1 * z2 - y1 * w2 - z1 * x2
    z = w1 * z2 - x1 * y2 + y1 * x2 - z1 * w2
    norm = math.sqrt(x * x + y * y + z * z)
    # q and -q are the same turn: the sign makes it the shorter one. At no turn the limit is 2.
    factor = 2.0 if norm < 1e-12 else math.copysign(2.0 * math.atan2(norm, abs(w)) / norm, w)
    return factor * x, factor * y, factor * z


def _unit(q: Quaternion) -> Quaternion:
    w, x, y, z = q
    norm = math.sqrt(w * w + x * x + y * y + z * z)
    return w / norm, x / norm, y / norm, z / norm
