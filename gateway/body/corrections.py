"""Readings of modules put right by the rig file's calibrations, as they enter the gateway."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from devices.calibration import SensorCalibration
from gateway.frames import FloatArray, InertialReading, Vector3


class SensorCorrections:
    """By module id; a module without a calibration passes as it is."""

    def __init__(self, calibrations: Mapping[int, SensorCalibration]) -> None:
        self._calibrations = dict(calibrations)

    def apply(self, reading: InertialReading) -> InertialReading:
        """The reading as a faultless module would have sent it."""
        calibration = self._calibrations.get(reading.module)
        if calibration is None:
            return reading
        force, rate, field = reading.specific_force, reading.angular_rate, reading.magnetic_field
        return replace(
            reading,
            specific_force=None if force is None else _vector(calibration.specific_force(force)),
            angular_rate=None if rate is None else _vector(calibration.angular_rate(rate)),
            magnetic_field=None if field is None else _vector(calibration.magnetic_field(field)),
        )


def _vector(values: FloatArray) -> Vector3:
    x, y, z = values.tolist()
    return x, y, z
