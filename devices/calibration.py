"""What is wrong with a module's sensors, and how readings are put right.

    specific force  A (f − b_a)        angular rate  ω − b_g        magnetic field  S (m − h)

The same 30 numbers that a module can keep in its flash as the setting ``calibration``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
Vector3 = tuple[float, float, float]

NUMBERS = 30
"""Length of the setting ``calibration``."""

REFERENCE_TEMPERATURE_C = 25.0


def _identity() -> FloatArray:
    return np.eye(3)


def _zero() -> FloatArray:
    return np.zeros(3)


@dataclass(frozen=True, eq=False)
class SensorCalibration:
    """Corrections of the three sensors of one module, sensor axes."""

    accelerometer_matrix: FloatArray = field(default_factory=_identity)
    """(3, 3) A, dimensionless."""
    accelerometer_bias: FloatArray = field(default_factory=_zero)
    """(3,) b_a, m/s²."""
    gyroscope_bias: FloatArray = field(default_factory=_zero)
    """(3,) b_g, rad/s."""
    magnetometer_matrix: FloatArray = field(default_factory=_identity)
    """(3, 3) S, soft iron and scale, dimensionless."""
    magnetometer_bias: FloatArray = field(default_factory=_zero)
    """(3,) h, hard iron, µT."""
    temperature_c: float = REFERENCE_TEMPERATURE_C
    """At which it was measured, °C."""

    def specific_force(self, reading: Sequence[float] | FloatArray) -> FloatArray:
        """Return it corrected; shapes (3,) or (n, 3), m/s²."""
        return (np.asarray(reading) - self.accelerometer_bias) @ self.accelerometer_matrix.T

    def angular_rate(self, reading: Sequence[float] | FloatArray) -> FloatArray:
        """Return it corrected; shapes (3,) or (n, 3), rad/s."""
        return np.asarray(reading) - self.gyroscope_bias

    def magnetic_field(self, reading: Sequence[float] | FloatArray) -> FloatArray:
        """Return it corrected; shapes (3,) or (n, 3), µT."""
        return (np.asarray(reading) - self.magnetometer_bias) @ self.magnetometer_matrix.T

    def after(self, first: SensorCalibration) -> SensorCalibration:
        """Return one correction that does ``first``, then this one.

        For a module that corrects on board already, and was measured so.
        """
        return SensorCalibration(
            accelerometer_matrix=self.accelerometer_matrix @ first.accelerometer_matrix,
            # A₂(A₁(y - b₁) - b₂) = A₂A₁(y - (b₁ + A₁⁻¹b₂)).
            accelerometer_bias=first.accelerometer_bias
            + np.linalg.solve(first.accelerometer_matrix, self.accelerometer_bias),
            gyroscope_bias=first.gyroscope_bias + self.gyroscope_bias,
            magnetometer_matrix=self.magnetometer_matrix @ first.magnetometer_matrix,
            magnetometer_bias=first.magnetometer_bias
            + np.linalg.solve(first.magnetometer_matrix, self.magnetometer_bias),
            temperature_c=self.temperature_c,
        )

    def to_setting(self) -> tuple[float, ...]:
        """Return the 30 numbers of the setting ``calibration``."""
        numbers = np.concatenate(
            [
                self.accelerometer_matrix.ravel(),
                self.accelerometer_bias,
                self.gyroscope_bias,
                self.magnetometer_matrix.ravel(),
                self.magnetometer_bias,
                [self.temperature_c, 0.0, 0.0],
            ]
        )
        return tuple(numbers.tolist())

    @classmethod
    def from_setting(cls, numbers: Sequence[float]) -> SensorCalibration:
        """Make a calibration of the 30 numbers of the setting. Raises ``ValueError`` for any other list."""
        c = np.asarray(numbers, dtype=np.float64)
        if c.shape != (NUMBERS,) or not np.isfinite(c).all():
            raise ValueError(f"a calibration is {NUMBERS} finite numbers, not {len(numbers)}")
        return cls(c[:9].reshape(3, 3), c[9:12], c[12:15], c[15:24].reshape(3, 3), c[24:27], float(c[27]))
