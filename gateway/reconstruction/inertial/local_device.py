"""Local measuring device (ML): from its readings to the acceleration of the point it sits on.

By kind: a fixed point has ``a_1 = 0``; acceleration is taken as it comes; velocity is differentiated
once and position twice, by backward differences at the device's own rate and with its own time stamps.
The result is known one reading (velocity) or two readings (position) after the first; it is then
interpolated to the instant of a frame where readings lie on both sides of it, otherwise held.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from gateway.body.skeleton import LocalDevice
from gateway.frames import FloatArray, LocalReading, Quantity

_N_DERIVATIVES = {Quantity.ACCELERATION: 0, Quantity.VELOCITY: 1, Quantity.POSITION: 2}
_KEPT = 8  # readings; frames lag the newest reading by a few at most


@dataclass(frozen=True, slots=True)
class _Instant:
    time_ns: int
    value: FloatArray  # (3,)


class RootMotion:
    """Acceleration (and position, where measured) of the point ``P_1`` at the instants of the frames.

    device: None stands for a root that is fixed: ``a_1 = 0`` is assumed.
    longest_hold_s: a reading older than this is no longer held; the acceleration is then NaN, and after
    the gap the differences begin anew.
    """

    def __init__(self, device: LocalDevice | None, longest_hold_s: float) -> None:
        self._device = device
        self._longest_hold_ns = round(longest_hold_s * 1e9)
        self.reset()

    def reset(self) -> None:
        """Forget all readings."""
        self._values: deque[_Instant] = deque(maxlen=3)
        self._accelerations: deque[_Instant] = deque(maxlen=_KEPT)
        self._positions: deque[_Instant] = deque(maxlen=_KEPT)

    def add(self, readings: Iterable[LocalReading]) -> None:
        """Readings in time order; other devices' and other quantities are passed over, as are repeats."""
        device = self._device
        if device is None or device.quantity is Quantity.FIXED_POINT:
            return
        for reading in readings:
            is_ours = reading.device == device.device and reading.quantity == device.quantity
            is_newer = not self._values or reading.time_ns > self._values[-1].time_ns
            if is_ours and is_newer and np.isfinite(reading.value).all():
                self._take(device.quantity, _Instant(reading.time_ns, np.asarray(reading.value, np.float64)))

    def acceleration(self, time_ns: int) -> FloatArray:
        """a_1, (3,) world, m/s²; NaN while not known."""
        if self._device is None or self._device.quantity is Quantity.FIXED_POINT:
            return np.zeros(3)
        return self._at(self._accelerations, time_ns)

    def position(self, time_ns: int) -> FloatArray:
        """Where P_1 is, (3,) world, m: as measured (NaN while not known); the origin if it is not."""
        if self._device is None or self._device.quantity is not Quantity.POSITION:
            return np.zeros(3)
        return self._at(self._positions, time_ns)

    def _take(self, quantity: Quantity, now: _Instant) -> None:
        if self._values and now.time_ns - self._values[-1].time_ns > self._longest_hold_ns:
            self._values.clear()
        self._values.append(now)
        n_derivatives = _N_DERIVATIVES[quantity]
        if len(self._values) > n_derivatives:
            value = _latest_derivative(list(self._values)[-1 - n_derivatives :])
            self._accelerations.append(_Instant(now.time_ns, value))
        if quantity is Quantity.POSITION:
            self._positions.append(now)

    def _at(self, instants: deque[_Instant], time_ns: int) -> FloatArray:
        """Interpolated between the readings around ``time_ns``, else the last one before it."""
        later: _Instant | None = None
        for instant in reversed(instants):
            if instant.time_ns > time_ns:
                later = instant
            elif later is not None and later.time_ns - instant.time_ns <= self._longest_hold_ns:
                fraction = (time_ns - instant.time_ns) / (later.time_ns - instant.time_ns)
                return instant.value + fraction * (later.value - instant.value)
            else:
                is_fresh = time_ns - instant.time_ns <= self._longest_hold_ns
                return instant.value if is_fresh else np.full(3, np.nan)
        return np.full(3, np.nan)


def _latest_derivative(instants: list[_Instant]) -> FloatArray:
    """Backward difference of order len(instants) − 1; each difference stands at the middle of its step."""
    times = [instant.time_ns for instant in instants]
    steps = np.diff(times) * 1e-9
    values = np.array([instant.value for instant in instants])
    while len(values) > 1:
        values = np.diff(values, axis=0) / steps[:, None]
        steps = 0.5 * (steps[1:] + steps[:-1])
    return np.asarray(values[0], np.float64)
