"""Velocity of pressure tubes (Pitot) through still air.

A tube that points along its motion feels ``Δp = ½ ρ v |v|``; the air's density is ``ρ = p / (R T)``. Near
rest the root makes much of little pressure, which the standard deviation shows: ``σ_v = σ_p / (ρ |v|)``, at
most ``√(2 σ_p / ρ)``.
"""

from __future__ import annotations

import math

import numpy as np

from gateway.frames import FloatArray, Vector3

GAS_CONSTANT = 287.05
"""J/(kg K), of dry air."""
ABSOLUTE_ZERO_C = -273.15
USUAL_TEMPERATURE_C = 15.0
"""Where the device does not send it: 20 K beside it are 3.5 % of the velocity."""
PRESSURE_SIGMA = 0.2
"""Pa, of a differential sensor for ±500 Pa."""
LOWEST_PRESSURE, HIGHEST_PRESSURE = 20_000.0, 120_000.0


def air_velocity(
    differential_pressure: Vector3, static_pressure: float, temperature_celsius: float | None
) -> tuple[FloatArray, FloatArray]:
    """Return the velocity along the tubes' axes and its standard deviation, (3,) each, m/s.

    Pressures in Pa. NaN where people could not breathe such air: the reading is damaged.
    """
    celsius = USUAL_TEMPERATURE_C if temperature_celsius is None else temperature_celsius
    if not (LOWEST_PRESSURE < static_pressure < HIGHEST_PRESSURE and -90.0 < celsius < 60.0):
        return np.full(3, np.nan), np.full(3, np.inf)
    density = static_pressure / (GAS_CONSTANT * (celsius - ABSOLUTE_ZERO_C))
    pressure = np.asarray(differential_pressure, np.float64)
    speed = np.sqrt(2.0 * np.abs(pressure) / density)
    at_rest = math.sqrt(2.0 * PRESSURE_SIGMA / density)
    # dv = dp / (density v), up to the speed that the pressure's own noise would show at rest.
    sigma = PRESSURE_SIGMA / (density * np.maximum(speed, PRESSURE_SIGMA / (density * at_rest)))
    return np.copysign(speed, pressure), sigma
