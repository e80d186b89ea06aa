"""Local measuring device (ML): from its readings to the acceleration of the point it sits on.

By kind: a fixed point has ``a_1 = 0``; acceleration is taken as it comes; velocity is differentiated once and
position twice by ``Differentiator``, over the window asked for or, with a window of 0, by backward
differences at the device's own rate. What is found belongs to the middle of the window; it is interpolated
to the instant of a frame where such instants lie on both sides of it, otherwise the last one is held.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gateway.body.skeleton import LocalDevice
from gateway.frames import FloatArray, LocalReading, Quantity
from gateway.geometry import quaternion

_N_DERIVATIVES = {Quantity.ACCELERATION: 0, Quantity.VELOCITY: 1, Quantity.POSITION: 2}
WANTED_SIGMA = 1.0
"""m/s²: readings that allow it are differentiated over a shorter window."""
_KEPT = 8  # readings; frames lag the newest reading by a few at most


def in_segment_axes(device: LocalDevice, value: FloatArray) -> FloatArray:
    """Return a reading (3,), in its segment's axes if the device measures along its own."""
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
        """Take readings in time order.

        Those of other devices or quantities are passed over, as are repeated ones.
        """
        device = self._device
        if device is None or device.quantity is Quantity.FIXED_POINT:
            return
        for reading in readings:
            is_ours = reading.device == device.device and reading.quantity == device.quantity
            is_newer = self._last_ns is None or reading.time_ns > self._last_ns
            if is_ours and is_newer and np.isfinite(reading.value).all():
                self._take(device.quantity, reading)

    def places(self) -> dict[str, NDArray[np.generic]]:
        """Return the measured positions that are kept, as arrays.

        They are the whole state of a device that measures positions, but for the acceleration found from
        them.
        """
        times, values = np.full(_KEPT, -1, np.int64), np.full((_KEPT, 3), np.nan)
        for k, instant in enumerate(self._positions):
            times[k], values[k] = instant.time_ns, instant.value
        return {"places.time_ns": times, "places.value": values}

    def set_places(self, state: Mapping[str, NDArray[np.generic]]) -> None:
        """Set the positions that ``places`` has returned."""
        self.reset()
        for time_ns, value in zip(state["places.time_ns"], state["places.value"], strict=True):
            if time_ns >= 0:
                self._last_ns = int(time_ns)
                self._positions.append(_Instant(int(time_ns), np.array(value, np.float64)))

    def acceleration(self, time_ns: int) -> FloatArray:
        """Return a_1, (3,) world, m/s²; NaN while it is not known."""
        if self._device is None or self._device.quantity is Quantity.FIXED_POINT:
            return np.zeros(3)
        return self._at(self._accelerations, time_ns)

    def position(self, time_ns: int) -> FloatArray:
        """Return the position of P_1, (3,) world, m; NaN while it is not known.

        It is the origin if no device measures it.
        """
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
        """Return the value interpolated between the readings around ``time_ns``, else the last one before it.

        NaN if that is older than ``longest_hold_s``, or there is none.
        """
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


# Differentiation
#
# Derivatives of noisy readings with a stated bandwidth and uncertainty: local least squares over a window.
#
# A line (for one derivative) or a parabola (for two) is fitted to the readings of the last ``window_s``:
# Savitzky and Golay's method at uneven instants. Its derivative belongs to the middle of the window.
# For a parabola it is the true acceleration averaged with ``(15/16)(1 − x²)²``, x = −1…1 over the window:
# −3 dB at ``0.70 / window_s``. For a line it is the rate averaged with ``(3/4)(1 − x²)``: −3 dB at
# ``0.60 / window_s``. Independent readings of standard deviation σ, n of them evenly spaced, leave
# ``σ √(720 / n) / window_s²`` and ``σ √(12 / n) / window_s``.


BANDWIDTH = {1: 0.60, 2: 0.70}
"""−3 dB frequency times window, by number of derivatives."""


class Derivative(NamedTuple):
    """The derivative of a vector."""

    time_ns: int
    """The instant that it belongs to: the middle of the window."""
    value: FloatArray  # (3,)
    sigma: FloatArray  # (3,) standard deviation that the readings' own leave in it


class Differentiator:
    """One vector signal. n_derivatives: 1 or 2; longest_gap_s: over a longer one it begins anew.

    The window is as short as the readings' own standard deviations allow the result to be within
    ``wanted_sigma``, and never longer than ``window_s``: good readings are not made to wait.

    Readings so slow that fewer than ``n_derivatives + 1`` fall into the window are differentiated over as
    many as it takes: the plain backward difference.
    """

    def __init__(
        self, n_derivatives: int, window_s: float, longest_gap_s: float, wanted_sigma: float = 0.0
    ) -> None:
        if n_derivatives not in BANDWIDTH:
            raise ValueError(f"{n_derivatives} derivatives: 1 or 2 can be had")
        self._n_derivatives = n_derivatives
        self._wanted_sigma = wanted_sigma
        self._window_ns, self._gap_ns = round(window_s * 1e9), round(longest_gap_s * 1e9)
        self._readings: deque[tuple[int, FloatArray, FloatArray]] = deque()

    def reset(self) -> None:
        """Forget all readings."""
        self._readings.clear()

    def add(self, time_ns: int, value: FloatArray, sigma: FloatArray) -> Derivative | None:
        """Take one reading, (3,) each, later than those before; return the derivative.

        Returns None until there are enough readings.
        """
        readings = self._readings
        if readings and time_ns - readings[-1][0] > self._gap_ns:
            readings.clear()
        readings.append((time_ns, value, sigma))
        least = self._n_derivatives + 1
        while len(readings) > least and time_ns - readings[0][0] > self._window_ns:
            readings.popleft()
        return self._fit(list(readings)[-self._least_number(least) :]) if len(readings) >= least else None

    def _least_number(self, least: int) -> int:
        """Return how many of the last readings are enough for the wanted standard deviation.

        If none are, all of them count.
        """
        newest_ns, _, sigma = self._readings[-1]
        largest = float(np.max(sigma))
        factor = 720.0 if self._n_derivatives == 2 else 12.0
        for n in range(least, len(self._readings)):
            span_s = (newest_ns - self._readings[-n][0]) * 1e-9
            if largest * math.sqrt(factor / n) < self._wanted_sigma * span_s**self._n_derivatives:
                return n
        return len(self._readings)

    def _fit(self, readings: list[tuple[int, FloatArray, FloatArray]]) -> Derivative:
        first_ns = readings[0][0]
        t = np.array([time_ns - first_ns for time_ns, _, _ in readings]) * 1e-9
        middle = float(np.mean(t))
        x = t - middle
        weights = x / np.sum(x * x)
        if self._n_derivatives == 1:
            middle += 0.5 * float(np.sum(weights * x * x))  # uneven instants: where a parabola is met exactly
        if self._n_derivatives == 2:
            q = x * x - np.sum(x**3) * weights - np.mean(x * x)
            weights = 2.0 * q / np.sum(q * q)
            middle += float(np.sum(weights * x**3)) / 6.0  # likewise a cubic
        values = np.array([value for _, value, _ in readings])
        sigmas = np.array([sigma for _, _, sigma in readings])
        sigma = np.sqrt(np.sum((weights[:, None] * sigmas) ** 2, axis=0))
        return Derivative(first_ns + round(middle * 1e9), weights @ values, sigma)


# Where a place is while it is not measured
#
# Where the body is while the device that measures it is silent, and when readings come again.
#
# Meanwhile the last place stands. The next reading is further off the longer the device was silent: the body
# does not jump there but goes, e-fold within ``RETURN_S``.


RETURN_S = 0.5


class PlaceKeeper:
    """NaN until the first measurement."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget all places."""
        self._place = np.full(3, np.nan)
        self._offset = np.zeros(3)
        self._is_lost = False
        self._time_ns = -1

    def state(self) -> dict[str, NDArray[np.generic]]:
        """Return all state, as arrays by name."""
        return {
            "kept_place.place": self._place.copy(),
            "kept_place.offset": self._offset.copy(),
            "kept_place.is_lost": np.array([self._is_lost]),
            "kept_place.time_ns": np.array([self._time_ns], np.int64),
        }

    def set_state(self, state: Mapping[str, NDArray[np.generic]]) -> None:
        """Set the state that ``state`` has returned."""
        self._place = np.array(state["kept_place.place"], np.float64)
        self._offset = np.array(state["kept_place.offset"], np.float64)
        self._is_lost = bool(state["kept_place.is_lost"][0])
        self._time_ns = int(state["kept_place.time_ns"][0])

    def at(self, measured: FloatArray, time_ns: int) -> FloatArray:
        """Return the position (3,), m, at an instant not before the last one.

        measured: (3,), m; NaN while the device is silent.
        """
        dt = (time_ns - self._time_ns) * 1e-9 if self._time_ns >= 0 else 0.0
        self._time_ns = time_ns
        if not np.isfinite(measured).all():
            self._is_lost = True
            return self._place
        self._offset *= math.exp(-dt / RETURN_S)
        if self._is_lost and np.isfinite(self._place).all():
            self._offset = self._place - measured
        self._is_lost = False
        self._place = measured + self._offset
        return self._place
