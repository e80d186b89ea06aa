"""Samples of modules put right by the rig file's calibrations, as they enter the gateway."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from devices.calibration import SensorCalibration
from gateway.frames import ANGULAR_RATE, MAGNETIC_FIELD, SPECIFIC_FORCE


class SensorCorrections:
    """By module id; a module without a calibration passes as it is."""

    def __init__(self, calibrations: Mapping[int, SensorCalibration]) -> None:
        self._calibrations = dict(calibrations)

    def apply(self, samples: NDArray[np.void]) -> NDArray[np.void]:
        """Return samples (n,) ``INERTIAL_SAMPLE`` as faultless modules would have sent them."""
        if not self._calibrations:
            return samples
        corrected = samples.copy()
        for sample in corrected:
            calibration = self._calibrations.get(int(sample["module"]))
            if calibration is not None:
                _correct(sample["measured"], calibration)
        return corrected


def _correct(measured: NDArray[np.float64], calibration: SensorCalibration) -> None:
    for sensor, correct in (
        (SPECIFIC_FORCE, calibration.specific_force),
        (ANGULAR_RATE, calibration.angular_rate),
        (MAGNETIC_FIELD, calibration.magnetic_field),
    ):
        if not np.isnan(measured[sensor, 0]):
            measured[sensor] = correct(measured[sensor].copy())
