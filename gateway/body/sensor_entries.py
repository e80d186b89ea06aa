"""Sensor calibrations as they stand in rig files."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import Field, field_validator

from devices.calibration import REFERENCE_TEMPERATURE_C, SensorCalibration
from gateway.support.settings_files import Strict

Finite = Annotated[float, Field(allow_inf_nan=False)]
Vector = tuple[Finite, Finite, Finite]
Matrix = tuple[Vector, Vector, Vector]

_IDENTITY: Matrix = ((1, 0, 0), (0, 1, 0), (0, 0, 1))
_ZERO: Vector = (0, 0, 0)
_LARGEST_CONDITION = 10.0


class _Ellipsoid(Strict):
    bias: Vector = Field(default=_ZERO, description="subtracted first, in the sensor's unit (m/s² or µT)")
    matrix: Matrix = Field(default=_IDENTITY, description="multiplied then, row after row")

    @field_validator("matrix")
    @classmethod
    def _is_mild(cls, value: Matrix) -> Matrix:
        condition = float(np.linalg.cond(np.array(value)))
        if not condition < _LARGEST_CONDITION:
            raise ValueError(f"no sensor is distorted so much (condition {condition:.3g}, at most 10)")
        return value


class _Bias(Strict):
    bias: Vector = Field(default=_ZERO, description="subtracted, rad/s")


class CalibrationEntry(Strict):
    """Corrections of one module's readings: matrix (reading − bias)."""

    accelerometer: _Ellipsoid = _Ellipsoid()
    gyroscope: _Bias = _Bias()
    magnetometer: _Ellipsoid = _Ellipsoid()
    temperature_c: Finite = Field(default=REFERENCE_TEMPERATURE_C, description="at which it was measured, °C")
    measured: str | None = Field(default=None, description="date of the calibration, for people")

    def model(self) -> SensorCalibration:
        """Return the calibration as the program uses it."""
        return SensorCalibration(
            np.array(self.accelerometer.matrix, dtype=np.float64),
            np.array(self.accelerometer.bias, dtype=np.float64),
            np.array(self.gyroscope.bias, dtype=np.float64),
            np.array(self.magnetometer.matrix, dtype=np.float64),
            np.array(self.magnetometer.bias, dtype=np.float64),
            self.temperature_c,
        )

    @classmethod
    def of(cls, model: SensorCalibration, measured: str | None = None, digits: int = 6) -> CalibrationEntry:
        """Return a calibration as it is written to a rig file."""

        def rounded(values: np.ndarray) -> list[object]:
            # Adding 0.0 turns -0.0 into 0.0, which reads better in a file.
            plain: list[object] = (np.round(values, digits) + 0.0).tolist()
            return plain

        return cls.model_validate(
            {
                "accelerometer": {
                    "bias": rounded(model.accelerometer_bias),
                    "matrix": rounded(model.accelerometer_matrix),
                },
                "gyroscope": {"bias": rounded(model.gyroscope_bias)},
                "magnetometer": {
                    "bias": rounded(model.magnetometer_bias),
                    "matrix": rounded(model.magnetometer_matrix),
                },
                "temperature_c": model.temperature_c,
                "measured": measured,
            }
        )
