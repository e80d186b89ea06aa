"""Sensors at the end of a range that they do not report: values that stay where they are largest.

An axis that is clipped comes to the end of its range by large steps and then stays there while the others go
on changing: exactly, or by the few percent of what the others change by that the makers' correction of skewed
axes mixes into it. A sensor that turns evenly changes by noise, on all axes alike; a smooth peak is entered
by steps hardly larger than those on it; one that sends old values again changes on no axis; one at rest gives
small values. So all of these are left alone.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gateway.body.skeleton import SensorRanges
from gateway.frames import ANGULAR_RATE, INERTIAL_SAMPLE, SPECIFIC_FORCE, Clipped, FloatArray, IntArray
from gateway.geometry.compiled import compiled, for_types_of
from gateway.sources.module_rows import MOST_MODULES

FORCE_BIT, RATE_BIT = Clipped.SPECIFIC_FORCE.value, Clipped.ANGULAR_RATE.value
FLAT_STEPS = 7
"""In a row, each next to nothing beside what another axis changed by: fewer occur by chance."""
CROSS_AXIS = 0.03
"""Of what the others change by: what correcting skewed axes moves a clipped one by."""
ENTRY_STEPS = 8.0
"""The step before them, in the largest of them: at a smooth peak it is two or three."""
ENTRY_QUANTA = 20.0
"""The same in the smallest step of any axis so far: at a peak of coarse values it is one or two."""
END = 0.99
"""Of the end that was found, from where a value counts as clipped."""
SKEWED_END = 0.96
"""Of the largest value so far, from where an axis may be at its end: skewed axes move that to either side."""
BEYOND = 1.06
"""Times the end that was found: two values in a row there show that it was none."""
SMALLEST_RANGES = (15.0, 2.0)
"""m/s², rad/s: below the smallest ranges of sensors, ± 2 g and ± 125 °/s; nothing smaller is taken for an
end."""

_NEVER_SEEN = -1

_AXIS = np.dtype(
    [
        ("last", np.float64),
        ("step", np.float64),  # magnitude of the newest step
        ("flat", np.int64),  # flat steps in a row
        ("entry", np.float64),  # the larger of the two steps before them
        ("entry_next", np.float64),  # the larger of the two newest steps; 0: the magnitude has not grown
        ("widest", np.float64),  # of the flat steps
        ("quantum", np.float64),  # the smallest step so far
        ("largest", np.float64, (2,)),  # magnitude that two samples in a row reached, by sign
        ("limit", np.float64, (2,)),  # end of the range, by sign; infinite: not found
    ],
    align=True,
)
_WATCHED = np.dtype(
    [
        ("sequence", np.int64),
        ("stated", np.float64, (2,)),  # end of the range by the rig; infinite: not stated
        ("axes", _AXIS, (2, 3)),
        ("clipped", np.int64, (2,)),  # samples so far
    ],
    align=True,
)
"""Of one module; all by sensor: specific force, angular rate."""


@dataclass(frozen=True)
class FoundRange:
    """Where a sensor of a module was found clipped."""

    limit: float
    """Smallest magnitude of any axis, m/s² or rad/s."""
    samples: int
    """Clipped so far."""


class RangeWatch:
    """Samples in, the same samples out, those marked ``clipped`` that are at the end of a range, stated or
    found."""

    def __init__(self, ranges: Mapping[int, SensorRanges]) -> None:
        """Watch modules for clipping; ``ranges`` are those that the rig states, by module id."""
        self._ranges = ranges
        self._rows = np.full(MOST_MODULES, _NEVER_SEEN, np.int64)  # of ``_watched``, by module id
        self._watched = np.zeros(0, _WATCHED)
        nothing = np.zeros(0, INERTIAL_SAMPLE), self._rows, self._watched, np.zeros(0, np.uint8)
        self._watch = for_types_of(_watch, *nothing)

    def add(self, samples: NDArray[np.void]) -> NDArray[np.void]:
        """Return samples (n,) ``INERTIAL_SAMPLE`` as sent, sensor axes: the same array where nothing is
        clipped."""
        clipped = np.zeros(len(samples), np.uint8)
        if not samples.flags.carray:
            samples = samples.copy()
        while (found := self._watch(samples, self._rows, self._watched, clipped)) < 0:
            self._begin(-1 - found)
        if not found:
            return samples
        marked = samples.copy()
        marked["clipped"] |= clipped
        return marked

    def found(self) -> dict[int, dict[str, FoundRange]]:
        """Return where sensors have been clipped, by module and sensor."""
        result: dict[int, dict[str, FoundRange]] = {}
        for module in np.flatnonzero(self._rows != _NEVER_SEEN).tolist():
            row = self._rows[module]
            for sensor, name in ((SPECIFIC_FORCE, "specific_force"), (ANGULAR_RATE, "angular_rate")):
                count = int(self._watched["clipped"][row, sensor])
                if count:
                    found = float(self._watched["axes"]["limit"][row, sensor].min())
                    limit = min(found, float(self._watched["stated"][row, sensor]))
                    result.setdefault(module, {})[name] = FoundRange(limit, count)
        return result

    def summary(self) -> dict[str, dict[str, float]]:
        """Return clipped samples and the limits found, m/s² and °/s, by module, for the health message."""
        figures: dict[str, dict[str, float]] = {}
        for module, sensors in self.found().items():
            values = figures.setdefault(str(module), {})
            for name, each in sensors.items():
                is_rate = name == "angular_rate"
                limit = math.degrees(each.limit) if is_rate else each.limit
                values[f"{name}_samples"] = each.samples
                if math.isfinite(limit):
                    values["angular_rate_dps" if is_rate else "specific_force_ms2"] = round(limit, 2)
        return figures

    def _begin(self, module: int) -> None:
        """Make room for a module that has not been heard before."""
        self._rows[module] = len(self._watched)
        fresh = np.zeros(1, _WATCHED)
        fresh["sequence"] = -2
        axes = fresh["axes"]
        axes["last"], axes["quantum"], axes["limit"] = np.nan, np.inf, np.inf
        stated = self._ranges.get(module, SensorRanges())
        fresh["stated"] = stated.specific_force, stated.angular_rate
        self._watched = np.concatenate((self._watched, fresh))


@compiled
def _watch(
    samples: NDArray[np.void], rows: IntArray, watched: NDArray[np.void], clipped: NDArray[np.uint8]
) -> int:
    """Write the clipped sensors of samples (n,); rows: (MOST_MODULES,) of ``watched``, by module.

    Return how many samples have some; of a module without a row −1 − its id, and nothing is changed."""
    for index in range(len(samples)):
        # Before anything is changed, as the caller makes a row and begins again.
        if rows[samples[index].module] == _NEVER_SEEN:
            return -1 - int(samples[index].module)
    found = 0
    for index in range(len(samples)):
        sample = samples[index]
        module, is_clipped = watched[rows[sample.module]], False
        is_next = sample.sequence == module.sequence + 1
        module.sequence = sample.sequence
        for sensor in range(2):
            values = sample.measured[sensor]
            is_found = _at_end(module.axes[sensor], values, SMALLEST_RANGES[sensor], is_next)
            if is_found or np.max(np.abs(values)) >= module.stated[sensor]:
                clipped[index] |= FORCE_BIT if sensor == SPECIFIC_FORCE else RATE_BIT
                module.clipped[sensor] += 1
                is_clipped = True
        found += is_clipped
    return found


@compiled
def _at_end(axes: Any, values: FloatArray, smallest: float, is_next: bool) -> bool:
    """Return whether a sensor's values (3,) are at the end of its range; its axes (3,) remember them."""
    if not is_next:
        _forget(axes)
    is_clipped = False
    steps = np.abs(values - np.array((axes[0].last, axes[1].last, axes[2].last)))  # NaN: not known
    elsewhere = _largest_found(axes)
    for i in range(3):
        axis, value = axes[i], values[i]
        side, magnitude = int(value < 0.0), abs(value)
        if value * axis.last > 0.0:
            axis.largest[side] = max(axis.largest[side], min(magnitude, abs(axis.last)))
        if axis.largest[side] > BEYOND * axis.limit[side]:
            axis.limit[side] = np.inf  # it was none
        _note_step(axis, steps[i], max(steps[i - 2], steps[i - 1]), value)
        quantum = min(axes[0].quantum, axes[1].quantum, axes[2].quantum)
        is_flat = axis.flat >= FLAT_STEPS and magnitude >= max(smallest, SKEWED_END * axis.largest[side])
        if is_flat and axis.entry > max(ENTRY_STEPS * axis.widest, ENTRY_QUANTA * quantum):
            axis.limit[side] = min(axis.limit[side], END * magnitude)
        is_same = axis.limit[side] == np.inf and axis.largest[side] <= BEYOND * elsewhere
        is_clipped |= magnitude >= (elsewhere if is_same else axis.limit[side])
        axis.last = value
    return is_clipped


@compiled
def _largest_found(axes: Any) -> float:
    """Return the largest end that was found of any axis (3,), either way; infinite: none.

    The axes of a sensor have one range, so it holds for those whose own has not been found, as long as they
    do not go beyond it.
    """
    largest = 0.0
    for i in range(3):
        for side in range(2):
            limit = axes[i].limit[side]
            if math.isfinite(limit):
                largest = max(largest, limit)
    return largest if largest > 0.0 else np.inf


@compiled
def _note_step(axis: Any, step: float, of_others: float, value: float) -> None:
    """Take one axis' step to a value into account, the largest of the other axes beside it."""
    if not math.isfinite(step + of_others) or max(step, of_others) == 0.0:
        return  # begun, or sent again
    if step > CROSS_AXIS * of_others:
        axis.flat = 0
    else:
        if axis.flat == 0:  # this step may still lead to the end
            axis.entry, axis.widest = axis.entry_next, 0.0
        else:
            axis.widest = max(axis.widest, step)
        axis.flat += 1
    has_grown = abs(value) > abs(axis.last)
    axis.entry_next = max(axis.step, step) if has_grown else 0.0
    axis.step = step
    if step > 0.0:
        axis.quantum = min(axis.quantum, step)


@compiled
def _forget(axes: Any) -> None:
    """Forget the last step of every axis: samples were lost since."""
    for i in range(3):
        axes[i].last, axes[i].flat, axes[i].step, axes[i].entry_next = np.nan, 0, 0.0, 0.0
