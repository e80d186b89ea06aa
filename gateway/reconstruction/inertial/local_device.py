"""Local measuring device (ML): from its readings to the acceleration of the point it sits on.

By kind: a fixed point has ``a_1 = 0``; acceleration is taken as it comes; velocity is differentiated once and
position twice by ``differentiation``, over the window asked for or, with a window of 0, by backward
differences at the device's own rate. What is found belongs to the middle of the window; it is interpolated
to the instant of a frame where such instants lie on both sides of it, otherwise the last one is held.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gateway.body.skeleton import LocalDevice
from gateway.frames import FloatArray, LocalReading, Quantity
from gateway.geometry import quaternion
from gateway.reconstruction.inertial.differentiation import Differentiator

_N_DERIVATIVES = {Quantity.ACCELERATION: 0, Quantity.VELOCITY: 1, Quantity.POSITION: 2}
WANTED_SIGMA = 1.0
"""m/s²: readings that allow it are differentiated over a shorter window."""
_KEPT = 8  # readings; frames lag the newest reading by a few at most


def in_segment_axes(device: LocalDevice, value: FloatArray) -> FloatArray:
    """(3,) as read: turned into its segment's axes if the device measures along its own, else as it is."""
    if device.quantity is Quantity.AIR_VELOCITY:
        return quaternion.rotate(device.orientation, value)
    return value


@dataclass(frozen=True, slots=True)
class _Instant:
    time_ns: int
    value: FloatArray  # (3,)


class RootMotion:
    """Acceleration (and position, where measured) of the point ``P_1`` at the instants of the frames.

    device: None stands for a root that is fixed: ``a_1 = 0`` is assumed.
    longest_hold_s: a reading older than this is no longer held; the acceleration is then NaN, and after
    the gap the differences begin anew.
    window_s: over which readings are differentiated at the most; 0: over as few as can be.
    """

    def __init__(self, device: LocalDevice | None, longest_hold_s: float, window_s: float = 0.0) -> None:
        self._device = device
        self._longest_hold_ns = round(longest_hold_s * 1e9)
        n_derivatives = _N_DERIVATIVES.get(device.quantity, 0) if device else 0
        self._differentiator = (
            Differentiator(n_derivatives, window_s, longest_hold_s, WANTED_SIGMA) if n_derivatives else None
        )
        self.reset()

    def reset(self) -> None:
        """Forget all readings."""
        self._last_ns: int | None = None
        if self._differentiator is not None:
            self._differentiator.reset()
        self._accelerations: deque[_Instant] = deque(maxlen=_KEPT)
        self._positions: deque[_Instant] = deque(maxlen=_KEPT)

    def add(self, readings: Iterable[LocalReading]) -> None:
        """Readings in time order; other devices' and other quantities are passed over, as are repeats."""
        device = self._device
        if device is None or device.quantity is Quantity.FIXED_POINT:
            return
        for reading in readings:
            is_ours = reading.device == device.device and reading.quantity == device.quantity
            is_newer = self._last_ns is None or reading.time_ns > self._last_ns
            if is_ours and is_newer and np.isfinite(reading.value).all():
                self._take(device.quantity, reading)

    def places(self) -> dict[str, NDArray[np.generic]]:
        """Return the measured places that are remembered, as arrays: all there is of a device that measures
        positions, but for the acceleration found from them."""
        times, values = np.full(_KEPT, -1, np.int64), np.full((_KEPT, 3), np.nan)
        for k, instant in enumerate(self._positions):
            times[k], values[k] = instant.time_ns, instant.value
        return {"places.time_ns": times, "places.value": values}

    def set_places(self, state: Mapping[str, NDArray[np.generic]]) -> None:
        """Go on from what ``places`` has returned."""
        self.reset()
        for time_ns, value in zip(state["places.time_ns"], state["places.value"], strict=True):
            if time_ns >= 0:
                self._last_ns = int(time_ns)
                self._positions.append(_Instant(int(time_ns), np.array(value, np.float64)))

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

    def _take(self, quantity: Quantity, reading: LocalReading) -> None:
        self._last_ns = reading.time_ns
        value = np.array(reading.value, np.float64)  # of a read-only one, kernels are compiled once more
        if self._differentiator is None:
            self._accelerations.append(_Instant(reading.time_ns, value))
        else:
            found = self._differentiator.add(reading.time_ns, value, np.asarray(reading.sigma, np.float64))
            if found is not None:
                self._accelerations.append(_Instant(found.time_ns, found.value))
        if quantity is Quantity.POSITION:
            self._positions.append(_Instant(reading.time_ns, value))

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
