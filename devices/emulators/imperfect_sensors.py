"""One module's sensors: true values in, readings out."""

from __future__ import annotations

import math

import numpy as np

from devices.emulators.bodies import FloatArray
from devices.emulators.imperfections import Imperfections, ModuleErrors, module_random
from firmware_protocol.device_settings import factory_settings

_NOISE_RATE_HZ = 100.0  # at which the settings state the noise
_PURPOSE = 11
_NO_NOISE = np.zeros(4)
_CALIBRATION_KEY = 9
_NO_CALIBRATION = tuple(factory_settings()[_CALIBRATION_KEY])


class ImperfectSensors:
    """Distorts, biases and adds noise. The stream of noise does not depend on how it is cut into blocks."""

    def __init__(self, settings: Imperfections, errors: ModuleErrors, seed: int, module: int) -> None:
        self._noise = np.array(
            [settings.accelerometer_noise, settings.gyroscope_noise, settings.magnetometer_noise]
        )
        self._walk = settings.gyroscope_bias_walk
        self._is_noisy = bool(self._noise.any() or self._walk)
        self._errors = errors
        self._rng = module_random(seed, module, _PURPOSE)
        self.gyroscope_bias = errors.gyroscope_bias.copy()
        """(3,) rad/s, as of the last reading."""

    def read(
        self,
        specific_force: FloatArray,
        angular_rate: FloatArray,
        magnetic_field: FloatArray,
        sampling_rate_hz: float,
    ) -> dict[str, FloatArray]:
        """Return readings (n, 3) by the name of the sensor, from true values (n, 3), in sensor axes."""
        errors, n = self._errors, len(specific_force)
        noise = _NO_NOISE
        gyroscope_bias = self.gyroscope_bias
        sigma = self._noise * math.sqrt(sampling_rate_hz / _NOISE_RATE_HZ)
        if self._is_noisy and n:
            noise = self._rng.standard_normal((n, 4, 3)).transpose(1, 0, 2)
            # The bias wanders from sample to sample, and goes on from there with the next call.
            walk = self._walk / math.sqrt(sampling_rate_hz)
            gyroscope_bias = self.gyroscope_bias + walk * noise[3].cumsum(axis=0)
            self.gyroscope_bias = gyroscope_bias[-1]
        return {
            "specific_force": specific_force @ errors.accelerometer_distortion.T
            + (errors.accelerometer_bias + sigma[0] * noise[0]),
            "angular_rate": angular_rate @ errors.gyroscope_distortion.T
            + (gyroscope_bias + sigma[1] * noise[1]),
            "magnetic_field": magnetic_field @ errors.magnetometer_distortion.T
            + (errors.magnetometer_bias + sigma[2] * noise[2]),
        }


def calibrated(readings: dict[str, FloatArray], calibration: tuple[float, ...]) -> dict[str, FloatArray]:
    """Return readings (n, 3) by sensor, corrected by the setting ``calibration`` (30 numbers).

    Accelerometer ``A (f − b)``, gyroscope ``ω − b``, magnetometer ``S (m − h)``.
    """
    if calibration == _NO_CALIBRATION:
        return readings
    c = np.asarray(calibration)
    return {
        "specific_force": (readings["specific_force"] - c[9:12]) @ c[:9].reshape(3, 3).T,
        "angular_rate": readings["angular_rate"] - c[12:15],
        "magnetic_field": (readings["magnetic_field"] - c[24:27]) @ c[15:24].reshape(3, 3).T,
    }
