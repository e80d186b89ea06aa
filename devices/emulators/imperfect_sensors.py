"""One module's sensors: true values in, readings out."""

from __future__ import annotations

import numpy as np

from devices.emulators.bodies import FloatArray
from devices.emulators.imperfections import Imperfections, ModuleErrors, module_random

_NOISE_RATE_HZ = 100.0  # at which the settings state the noise
_PURPOSE = 11


class ImperfectSensors:
    """Distorts, biases and adds noise. The stream of noise does not depend on how it is cut into blocks."""

    def __init__(
        self, settings: Imperfections, errors: ModuleErrors, seed: int, module: int, sampling_rate_hz: float
    ) -> None:
        bandwidth = np.sqrt(sampling_rate_hz / _NOISE_RATE_HZ)
        self._noise = bandwidth * np.array(
            [settings.accelerometer_noise, settings.gyrometer_noise, settings.magnetometer_noise]
        )
        self._walk = settings.gyrometer_bias_walk / np.sqrt(sampling_rate_hz)
        self._is_noisy = bool(self._noise.any() or self._walk)
        self._errors = errors
        self._rng = module_random(seed, module, _PURPOSE)
        self.gyrometer_bias = errors.gyrometer_bias.copy()
        """(3,) rad/s, as of the last reading."""

    def read(
        self, specific_force: FloatArray, angular_rate: FloatArray, magnetic_field: FloatArray
    ) -> dict[str, FloatArray]:
        """Readings (n, 3) by the name of the sensor, from true values (n, 3), in sensor axes."""
        errors, n = self._errors, len(specific_force)
        noise = np.zeros((4, n, 3))
        gyrometer_bias = np.broadcast_to(self.gyrometer_bias, (n, 3))
        if self._is_noisy:
            noise = np.moveaxis(self._rng.standard_normal((n, 4, 3)), 1, 0)
            gyrometer_bias = self.gyrometer_bias + self._walk * np.cumsum(noise[3], axis=0)
            self.gyrometer_bias = gyrometer_bias[-1] if n else self.gyrometer_bias
        return {
            "specific_force": specific_force @ errors.accelerometer_distortion.T
            + (errors.accelerometer_bias + self._noise[0] * noise[0]),
            "angular_rate": angular_rate @ errors.gyrometer_distortion.T
            + (gyrometer_bias + self._noise[1] * noise[1]),
            "magnetic_field": magnetic_field @ errors.magnetometer_distortion.T
            + (errors.magnetometer_bias + self._noise[2] * noise[2]),
        }
