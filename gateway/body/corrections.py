"""Samples of modules put right by the rig file's calibrations, as they enter the gateway."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from devices.calibration import SensorCalibration
from gateway.frames import ANGULAR_RATE, MAGNETIC_FIELD, SPECIFIC_FORCE

_TURNED = (SPECIFIC_FORCE, MAGNETIC_FIELD)
"""Sensors that have a matrix."""


class SensorCorrections:
    """By module id; a module without a calibration passes as it is."""

    def __init__(self, calibrations: Mapping[int, SensorCalibration]) -> None:
        self._ids = np.array(sorted(calibrations), np.int64)
        k = len(self._ids)
        self._bias, self._matrix = np.zeros((k, 3, 3)), np.zeros((k, 3, 3, 3))  # by sensor
        for row, module in enumerate(self._ids.tolist()):
            calibration = calibrations[module]
            self._bias[row, SPECIFIC_FORCE] = calibration.accelerometer_bias
            self._bias[row, ANGULAR_RATE] = calibration.gyroscope_bias
            self._bias[row, MAGNETIC_FIELD] = calibration.magnetometer_bias
            self._matrix[row, SPECIFIC_FORCE] = calibration.accelerometer_matrix
            self._matrix[row, MAGNETIC_FIELD] = calibration.magnetometer_matrix

    def apply(self, samples: NDArray[np.void]) -> NDArray[np.void]:
        """Return samples (n,) ``INERTIAL_SAMPLE`` as faultless modules would have sent them.

        All at once, and to the last bit what ``SensorCalibration`` makes of each.
        """
        if not len(self._ids):
            return samples
        rows = np.searchsorted(self._ids, samples["module"]) % len(self._ids)
        is_calibrated = self._ids[rows] == samples["module"]
        corrected = samples.copy()
        measured = corrected["measured"]  # (n, 3, 3)
        right = measured - self._bias[rows]
        for sensor in _TURNED:
            matrix = self._matrix[rows, sensor].transpose(0, 2, 1)  # a view, as in ``SensorCalibration``
            right[:, sensor] = (right[:, None, sensor] @ matrix)[:, 0]
        counts = is_calibrated[:, None] & ~np.isnan(measured[:, :, 0])
        measured[counts] = right[counts]
        return corrected
