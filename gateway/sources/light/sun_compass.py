"""Light readings to directions of the sun by frame; cloud, shadow and reflections turned away. Sans-I/O.

A direction serves until a newer one comes, turned along by the module's gyroscopes, for ``CARRIED_S`` at
most; for longer it is remembered to recognise what jumps.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from enum import Enum

import numpy as np
from astral import Observer
from astral.sun import zenith_and_azimuth

from gateway.body.skeleton import WornSuit
from gateway.frames import FloatArray, ImuFrame, LightReading, SunSight
from gateway.geometry import rotation_matrix
from gateway.sources.light.cells import CellArray, CellSolution

CARRIED_S = 0.05
SILENT_S = 3.0
STEP_NS = 10_000_000_000
"""The sun moves 0.04° in that time: it is placed once in it, at the middle."""

FULL_SCALE = 0.999
LEAST_LIGHT = 0.02
"""Share of full scale."""
LEAST_DIRECT_SHARE = 0.7
"""Direct light in all of it: 0.9 in a clear sky, 0.5 under thin cloud, less in shadow."""
LEAST_OF_BRIGHTEST = 0.8
BRIGHTEST_MEMORY_S = 1800.0
"""The sun sinks: what it was hours ago is no measure."""
LARGEST_RESIDUAL = 0.12
"""Of the direct light. Sky and ground that differ leave 0.05."""
LARGEST_JUMP = math.radians(10.0)
JUMP_MEMORY_S = 10.0
"""For so long the gyroscopes predict where the sun must be; a direction that lasts longer is believed."""
LARGEST_MISPLACEMENT = math.radians(15.0)
"""Height above the horizon, where the module's specific force gives it."""
STILL = 0.5
"""m/s² from g: then the specific force points up."""
LOWEST, HIGHEST = math.radians(5.0), math.radians(75.0)
"""Higher up, the heading is lost in the tilt's error; lower, in haze and shadows."""
CELL_SIGMA = 0.03
"""rad: cells' gains and normals that differ."""
READING_NOISE = 0.004
"""Share of full scale."""


class Rejected(Enum):
    """Why a light reading gave no heading."""

    SUN_LOW = "the sun is below 5° or set"
    SUN_HIGH = "the sun is above 75°: no heading in it"
    SATURATED = "a cell at the end of its range"
    DARK = "hardly any light: covered"
    DIFFUSE = "little direct light: cloud, or shadow"
    DIMMED = "direct light weaker than before: thin cloud, or part in shadow"
    INCONSISTENT = "cells contradict each other: part in shadow, or a second light"
    JUMPED = "not where it was, carried along by the gyroscopes: a shadow's edge, or another light"
    MISPLACED = "not at the sun's height: a reflection, or a lamp"


@dataclass
class _Module:
    """One module's cells and what they saw."""

    cells: CellArray
    direction: FloatArray = field(default_factory=lambda: np.full(3, np.nan))
    sigma: float = math.nan
    sighted_ns: int = 0
    received_ns: int = 0
    brightest: float = 0.0
    counts: Counter[str] = field(default_factory=Counter)
    state: str = "silent"


class SunCompass:
    """Deterministic: the same frames give the same sights, bit for bit."""

    def __init__(self, suit: WornSuit) -> None:
        """Prepare the cells of a suit. Raises ``ValueError`` without ``sun``, or if the cells do not span
        space.
        """
        if suit.sun is None:
            raise ValueError("the suit has no photoelectric cells: its rig names no place for the sun")
        self._sun = suit.sun
        self._modules = [_Module(CellArray(normals)) for normals in suit.sun.normals]
        self._rows = {module: row for row, module in enumerate(suit.module_ids)}
        self._gravity = float(np.linalg.norm(suit.gravity))
        self._time_ns = self._step = -1
        self._world = np.full(3, np.nan)

    def sighted(self, frame: ImuFrame) -> ImuFrame:
        """Return the frame with where each module sees the sun, and without its magnetic field if the sun is
        in the place of it."""
        self._place_sun(frame.time_ns)
        dt = (frame.time_ns - self._time_ns) * 1e-9 if self._time_ns >= 0 else 0.0
        self._time_ns = frame.time_ns
        for row, module in enumerate(self._modules):
            # Between two readings the gyroscope carries the direction on.
            _turn_along(module, frame.angular_rate[row], dt)
        for reading in frame.light:
            self._take(reading, frame)
        oldest_ns = frame.time_ns - CARRIED_S * 1e9
        is_seen = np.array([module.sighted_ns >= oldest_ns for module in self._modules])
        directions = np.array([module.direction for module in self._modules])
        sigmas = np.array([module.sigma for module in self._modules])
        sight = SunSight(
            self._world, np.where(is_seen[:, None], directions, np.nan), np.where(is_seen, sigmas, np.nan)
        )
        if self._sun.beside_magnetometer:
            return replace(frame, sun=sight)
        return replace(frame, sun=sight, magnetic_field=np.full_like(frame.magnetic_field, np.nan))

    def statistics(self) -> dict[str, object]:
        """Return what each module sees now and how its readings were judged, for the health message."""
        elevation = math.degrees(math.asin(self._world[2])) if np.isfinite(self._world[2]) else None
        modules = {
            str(number): {"state": self._state(self._modules[row]), **self._modules[row].counts}
            for number, row in self._rows.items()
        }
        return {
            "sun_elevation_deg": None if elevation is None else round(elevation, 2),
            "modules": modules,
        }

    def totals(self) -> Counter[str]:
        """Return readings of all modules by what they gave: ``sun``, or why nothing."""
        return sum((module.counts for module in self._modules), Counter[str]())

    def _state(self, module: _Module) -> str:
        is_silent = self._time_ns - module.received_ns > SILENT_S * 1e9
        return "silent" if is_silent else module.state

    # Where cells are in place of the magnetometer, what modules send as a field is void.

    def _place_sun(self, time_ns: int) -> None:
        step = time_ns // STEP_NS
        if step != self._step:
            self._step = step
            middle_ns = step * STEP_NS + STEP_NS // 2
            self._world = sun_direction(middle_ns, self._sun.latitude_deg, self._sun.longitude_deg)

    def _take(self, reading: LightReading, frame: ImuFrame) -> None:
        row = self._rows[reading.module]
        module = self._modules[row]
        solution = module.cells.solve(reading.intensity)
        reason = self._fault(module, reading, solution, frame.specific_force[row])
        since_s = (reading.time_ns - module.received_ns) * 1e-9
        module.received_ns = reading.time_ns
        module.state = "sun" if reason is None else reason.name.lower()
        module.counts[module.state] += 1
        if reason is not None:
            return
        # The brightest light seen is forgotten over time, as the day may become overcast.
        faded = module.brightest * math.exp(-max(since_s, 0.0) / BRIGHTEST_MEMORY_S)
        module.brightest = max(faded, solution.direct)
        module.direction, module.sighted_ns = solution.direction, reading.time_ns
        module.sigma = math.hypot(CELL_SIGMA, READING_NOISE / solution.direct)
        _turn_along(module, frame.angular_rate[row], (frame.time_ns - reading.time_ns) * 1e-9)

    def _fault(
        self, module: _Module, reading: LightReading, solution: CellSolution, force: FloatArray
    ) -> Rejected | None:
        """Return why a reading gives no heading; None: it gives one."""
        # Diffuse light may come out negative by noise; it must not enlarge the share of direct light.
        elevation = math.asin(self._world[2])
        direct, all_light = solution.direct, solution.direct + max(solution.diffuse, 0.0)
        tests = {
            Rejected.SUN_LOW: elevation < LOWEST,
            Rejected.SUN_HIGH: elevation > HIGHEST,
            Rejected.SATURATED: float(np.max(reading.intensity)) >= FULL_SCALE,
            Rejected.DARK: float(np.max(reading.intensity)) < LEAST_LIGHT,
            Rejected.DIFFUSE: direct < max(LEAST_DIRECT_SHARE * all_light, LEAST_LIGHT),
            Rejected.DIMMED: direct < LEAST_OF_BRIGHTEST * module.brightest,
            Rejected.INCONSISTENT: solution.residual > LARGEST_RESIDUAL * direct,
            Rejected.JUMPED: _has_jumped(module, reading.time_ns, solution.direction),
            Rejected.MISPLACED: self._is_misplaced(solution.direction, force, elevation),
        }
        return next((reason for reason, failed in tests.items() if failed), None)

    def _is_misplaced(self, direction: FloatArray, force: FloatArray, elevation: float) -> bool:
        length = float(np.linalg.norm(force))
        if not abs(length - self._gravity) < STILL:  # NaN too: nothing to compare with
            return False
        seen = math.asin(min(1.0, max(-1.0, float(direction @ force) / length)))
        return abs(seen - elevation) > LARGEST_MISPLACEMENT


def _has_jumped(module: _Module, time_ns: int, direction: FloatArray) -> bool:
    is_remembered = time_ns - module.sighted_ns < JUMP_MEMORY_S * 1e9
    return is_remembered and float(direction @ module.direction) < math.cos(LARGEST_JUMP)


def _turn_along(module: _Module, rate: FloatArray, dt: float) -> None:
    """Turn a module's direction, fixed in the world, into sensor axes that turned at ``rate`` (rad/s) for
    ``dt`` s.
    """
    if dt != 0.0 and np.isfinite(module.direction[0]) and np.isfinite(rate).all():
        module.direction = rotation_matrix.from_rotation_vector(-rate * dt) @ module.direction


def sun_direction(time_ns: int, latitude_deg: float, longitude_deg: float) -> FloatArray:
    """Return (3,) unit vector to the apparent sun, ENU; up is negative at night.

    By the library astral (NOAA's equations after Meeus, with refraction): within 0.02° of NREL's solar
    position algorithm at the published example.

    time_ns: UTC since 1970. latitude_deg: north; longitude_deg: east.
    """
    when = datetime.fromtimestamp(time_ns * 1e-9, UTC)
    zenith, azimuth = zenith_and_azimuth(Observer(latitude_deg, longitude_deg), when)
    up, around = math.radians(90.0 - zenith), math.radians(azimuth)
    return np.array([math.cos(up) * math.sin(around), math.cos(up) * math.cos(around), math.sin(up)])
