"""The sensor calibration of a whole suit at once: readings in, progress and results out. Sans-I/O.

There are no phases to keep to. Whatever a module does serves: lying still gives the gyroscope's bias, lying
still in different positions the accelerometer's ellipsoid, being turned the magnetometer's.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from devices.calibration import SensorCalibration
from gateway.calibration.coverage import coverage, missing_sides
from gateway.calibration.ellipsoid import sphere
from gateway.calibration.rest import RestDetector
from gateway.calibration.sensors import (
    ENOUGH_COVERAGE,
    POSITIONS_FOR_ALL,
    EllipsoidResult,
    GyroscopeResult,
    accelerometer_ellipsoid,
    gyroscope_bias,
    magnetometer_ellipsoid,
    rest_positions,
    six_positions,
)
from gateway.frames import FloatArray, Vector3

SENSORS = ("gyroscope", "accelerometer", "magnetometer")
REST_S = 3.0
"""How long a module should lie still for its gyroscope, s."""
_SHOWN_READINGS = 1500  # of the field, thinned, that progress is judged by
_FEWEST_FOR_A_SPHERE = 20
_FEWEST_FOR_A_DIP = 100
_DIPS_AGREE_DEG = 3.0

Result = GyroscopeResult | EllipsoidResult


@dataclass
class Progress:
    """How far one module is."""

    rest_s: float = 0.0
    positions: int = 0
    sides_missing: list[str] = field(default_factory=list)
    coverage: float = 0.0
    is_at_rest: bool = False
    samples: int = 0


class ModuleSession:
    """What one module showed so far."""

    def __init__(self) -> None:
        self._rest = RestDetector()
        self._field: list[Vector3] = []
        self._at_rest: list[tuple[Vector3, Vector3]] = []
        self._samples = 0

    def add(
        self, time_ns: int, force: Vector3 | None, rate: Vector3 | None, magnetic_field: Vector3 | None
    ) -> None:
        """Add a reading, m/s², rad/s, µT; None for a sensor that was not read."""
        self._samples += 1
        if force is not None and rate is not None:
            self._rest.add(time_ns, force, rate)
        if magnetic_field is not None:
            self._field.append(magnetic_field)
            if force is not None and self._rest.is_at_rest:
                self._at_rest.append((force, magnetic_field))

    def dip_deg(self, calibration: SensorCalibration) -> float | None:
        """Return the dip of the field below the horizontal, °, from readings at rest; None: too few."""
        if len(self._at_rest) < _FEWEST_FOR_A_DIP:
            return None
        forces, fields = np.swapaxes(np.array(self._at_rest), 0, 1)
        up, field = calibration.specific_force(forces), calibration.magnetic_field(fields)
        # The median, because a reading beside iron may be far off.
        upward = np.sum(up * field, axis=1) / np.linalg.norm(up, axis=1) / np.linalg.norm(field, axis=1)
        return -float(np.degrees(np.median(np.arcsin(np.clip(upward, -1.0, 1.0)))))

    def progress(self) -> Progress:
        """Return what has been gathered so far."""
        stretches = self._rest.stretches
        positions = rest_positions(stretches)
        return Progress(
            rest_s=sum(stretch.duration_s for stretch in stretches),
            positions=len(positions),
            sides_missing=missing_sides(positions),
            coverage=self._coverage(),
            is_at_rest=self._rest.is_at_rest,
            samples=self._samples,
        )

    def result(self, sensor: str, gravity: float, field_ut: float, has_levelled_cube: bool) -> Result:
        """Return the calibration of one sensor. Raises ``ValueError`` saying what is missing."""
        stretches = self._rest.stretches
        if sensor == "gyroscope":
            return gyroscope_bias(stretches, REST_S)
        if sensor == "accelerometer":
            positions = rest_positions(stretches)
            return (six_positions if has_levelled_cube else accelerometer_ellipsoid)(positions, gravity)
        return magnetometer_ellipsoid(np.array(self._field).reshape(-1, 3), field_ut)

    def _coverage(self) -> float:
        """Return the share of directions seen from the centre of the fitted sphere; a small patch covers
        little.
        """
        if len(self._field) < _FEWEST_FOR_A_SPHERE:
            return 0.0
        readings = np.array(self._field[:: 1 + len(self._field) // _SHOWN_READINGS])
        return coverage(readings, sphere(readings)[0])


class SensorSession:
    """All modules of a suit."""

    def __init__(
        self,
        modules: Iterable[int],
        gravity: float,
        field_ut: float,
        sensors: Iterable[str] = SENSORS,
        has_levelled_cube: bool = False,
    ) -> None:
        """Begin without readings.

        gravity: local, m/s².
        field_ut: strength of the local field, µT, to which magnetometers are scaled.
        has_levelled_cube: accelerometers lie on the six sides of a cube: twelve parameters instead of nine.
        """
        self.modules = {module: ModuleSession() for module in modules}
        self.sensors = tuple(sensor for sensor in SENSORS if sensor in set(sensors))
        self._gravity, self._field_ut, self._has_cube = gravity, field_ut, has_levelled_cube

    def add(
        self,
        module: int,
        time_ns: int,
        force: Vector3 | None,
        rate: Vector3 | None,
        magnetic_field: Vector3 | None,
    ) -> None:
        """Add a reading of any module; modules that are not of the session are ignored."""
        session = self.modules.get(module)
        if session is not None:
            session.add(time_ns, force, rate, magnetic_field)

    @property
    def wanted_positions(self) -> int:
        """Rest positions that a module should have been in."""
        return 6 if self._has_cube else POSITIONS_FOR_ALL

    def is_enough(self, progress: Progress) -> bool:
        """Return whether a module has shown all that its sensors need."""
        return (
            ("gyroscope" not in self.sensors or progress.rest_s >= REST_S)
            and (
                "accelerometer" not in self.sensors
                or (progress.positions >= self.wanted_positions and not progress.sides_missing)
            )
            and ("magnetometer" not in self.sensors or progress.coverage >= ENOUGH_COVERAGE)
        )

    def dip_deg(self, calibrations: Mapping[int, SensorCalibration]) -> float | None:
        """Return by how much the field points below the horizontal, °, as calibrated modules found it.

        None where there are none or they disagree, as beside iron.
        """
        dips = [self.modules[module].dip_deg(calibration) for module, calibration in calibrations.items()]
        found = [dip for dip in dips if dip is not None]
        if not found or max(found) - min(found) > _DIPS_AGREE_DEG:
            return None
        return float(np.median(found))

    def results(self, module: int) -> dict[str, Result | str]:
        """Return, by sensor, its result or why there is none."""
        found: dict[str, Result | str] = {}
        for sensor in self.sensors:
            try:
                found[sensor] = self.modules[module].result(
                    sensor, self._gravity, self._field_ut, self._has_cube
                )
            except ValueError as error:
                found[sensor] = str(error)
        return found


def combined(results: dict[str, Result | str], kept: SensorCalibration | None = None) -> SensorCalibration:
    """Return the calibration that results add up to; sensors without one keep what ``kept`` says."""
    kept = kept or SensorCalibration()
    rate, force, magnetic = (results.get(sensor) for sensor in SENSORS)
    fields: dict[str, FloatArray] = {}
    if isinstance(rate, GyroscopeResult):
        fields["gyroscope_bias"] = rate.bias
    if isinstance(force, EllipsoidResult):
        fields |= {"accelerometer_matrix": force.fit.matrix, "accelerometer_bias": force.fit.bias}
    if isinstance(magnetic, EllipsoidResult):
        fields |= {"magnetometer_matrix": magnetic.fit.matrix, "magnetometer_bias": magnetic.fit.bias}
    return replace(kept, **fields)  # type: ignore[arg-type]  # the names are those of arrays


class NextAdvice(NamedTuple):
    """What the suit as a whole wants next."""

    key: str
    """``listen``, ``rest``, ``hold``, ``other_side``, ``turn``, ``silent`` (of ``modules``), ``enough``."""
    modules: tuple[int, ...] = ()


def advice_on(session: SensorSession, progress: Mapping[int, Progress]) -> NextAdvice:
    """Return what to do next, by how far all modules are."""
    sampled = [one for one in progress.values() if one.samples]
    if not sampled:
        return NextAdvice("listen")
    if "gyroscope" in session.sensors and any(one.rest_s < REST_S for one in sampled):
        return NextAdvice("rest")
    if "accelerometer" in session.sensors and any(
        one.positions < session.wanted_positions or one.sides_missing for one in sampled
    ):
        return NextAdvice("other_side" if all(one.is_at_rest for one in sampled) else "hold")
    if "magnetometer" in session.sensors and any(one.coverage < ENOUGH_COVERAGE for one in sampled):
        return NextAdvice("turn")
    silent = tuple(module for module, one in progress.items() if not one.samples)
    return NextAdvice("silent", silent) if silent else NextAdvice("enough")


def usable(results: dict[str, Result | str], with_poor: bool) -> dict[str, Result | str]:
    """Return those results that may be used."""
    return {
        sensor: result
        for sensor, result in results.items()
        if not isinstance(result, str) and (with_poor or result.quality.verdict != "poor")
    }


def results_as_json(found: Mapping[int, Mapping[str, Result | str]]) -> dict[str, dict[str, object]]:
    """Return results by module and sensor, for scripts and messages; SI units, µT."""
    return {str(module): {s: _as_json(r) for s, r in results.items()} for module, results in found.items()}


def _as_json(result: Result | str) -> dict[str, object]:
    if isinstance(result, str):
        return {"quality": "none", "reasons": [result]}
    quality = {
        "quality": result.quality.verdict,
        "score": round(result.quality.score, 3),
        "reasons": list(result.quality.reasons),
    }
    if isinstance(result, GyroscopeResult):
        return quality | {"bias": result.bias.tolist(), "rest_s": round(result.rest_s, 2)}
    fit = result.fit
    return quality | {
        "bias": fit.bias.tolist(),
        "matrix": fit.matrix.tolist(),
        "used": result.used,
        "coverage": round(fit.coverage, 3),
        "spread_before": fit.spread_before,
        "spread_after": fit.spread_after,
    }
