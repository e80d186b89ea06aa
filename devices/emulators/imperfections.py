"""What real modules and links do wrong, as plain settings; 0 is ideal. All draws are seeded."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.random import Generator

from devices.deferred import Rotation
from devices.emulators.bodies import FloatArray


@dataclass(frozen=True)
class Imperfections:
    """Standard deviations of what is drawn once a module, noise of each sample, and faults of the link."""

    accelerometer_noise: float = 0.0
    """White noise of an axis at 100 Hz, m/s² RMS. At other rates it goes with the root of the rate."""
    gyroscope_noise: float = 0.0
    """As above, rad/s RMS."""
    magnetometer_noise: float = 0.0
    """As above, µT RMS."""
    accelerometer_bias: float = 0.0
    """Constant bias of an axis, m/s²."""
    gyroscope_bias: float = 0.0
    """Constant bias of an axis, rad/s."""
    magnetometer_bias: float = 0.0
    """Hard iron of an axis, µT."""
    gyroscope_bias_walk: float = 0.0
    """Random walk of the bias, rad/s per √s."""
    scale: float = 0.0
    """Relative scale error of every axis of every sensor."""
    misalignment: float = 0.0
    """Rotation of each sensor's axes against the module's, about each axis, rad."""
    placement: float = 0.0
    """Error of the lever arm, each component, m."""
    placement_angle: float = 0.0
    """Rotation of the module against where it should sit on its segment, about each axis, rad."""
    fused_orientation: float = 0.0
    """Error of an orientation fused on board, about each axis, rad RMS."""
    fused_displacement: float = 0.0
    """Error of a displacement between two uploads, each component, m RMS."""
    has_random_heading: bool = False
    """The level references of modules that fuse on board face anywhere; otherwise east is their x."""

    clock_skew_ppm: float = 0.0
    """Module clocks run fast by a part drawn evenly between minus and plus this."""
    has_random_clock_start: bool = False
    """Counters start anywhere in 32 bits, so that one in 70 wraps within a minute; otherwise at 0."""
    wraps_after_s: float | None = None
    """All counters wrap about this long after the start (overrules ``has_random_clock_start``)."""
    has_random_phase: bool = False
    """Modules sample at a random phase of their interval; otherwise all at once."""

    latency: float = 0.0
    """Shortest time from sampling to arrival, s."""
    jitter: float = 0.0
    """Mean of the exponential delay on top, s. Order within a link is kept."""
    reception: float = 0.0
    """Mean of the exponential time from a trigger's coming on the air to a module's sampling, s. Besides it
    all modules hear a broadcast trigger at once."""
    batching: float = 0.0
    """The link hands over what it has at multiples of this (USB), s."""
    loss: float = 0.0
    """Share of packets lost."""
    corruption: float = 0.0
    """Share of wire frames with one byte changed."""
    duplication: float = 0.0
    """Share of packets that come twice."""


IDEAL = Imperfections()

TYPICAL = Imperfections(
    accelerometer_noise=0.03,
    gyroscope_noise=math.radians(0.1),
    magnetometer_noise=0.5,
    accelerometer_bias=0.05,
    gyroscope_bias=math.radians(0.3),
    magnetometer_bias=0.3,
    gyroscope_bias_walk=math.radians(0.005),
    scale=0.002,
    misalignment=math.radians(0.2),
    fused_orientation=math.radians(0.5),
    fused_displacement=0.001,
    has_random_heading=True,
    clock_skew_ppm=50.0,
    has_random_clock_start=True,
    has_random_phase=True,
    latency=0.002,
    jitter=0.001,
    reception=20e-6,
    loss=0.002,
)
"""Consumer MEMS modules over a decent radio."""

ROUGH = Imperfections(
    accelerometer_noise=0.08,
    gyroscope_noise=math.radians(0.3),
    magnetometer_noise=1.5,
    accelerometer_bias=0.15,
    gyroscope_bias=math.radians(1.0),
    magnetometer_bias=2.0,
    gyroscope_bias_walk=math.radians(0.02),
    scale=0.01,
    misalignment=math.radians(1.0),
    placement=0.01,
    placement_angle=math.radians(3.0),
    fused_orientation=math.radians(2.0),
    fused_displacement=0.004,
    has_random_heading=True,
    clock_skew_ppm=200.0,
    has_random_clock_start=True,
    has_random_phase=True,
    latency=0.003,
    jitter=0.008,
    reception=100e-6,
    batching=0.016,
    loss=0.03,
    corruption=0.002,
    duplication=0.005,
)
"""Cheap modules, loosely strapped, on a crowded radio band behind a USB adapter with a 16 ms timer."""

UNCALIBRATED = replace(
    TYPICAL,
    accelerometer_bias=0.3,
    gyroscope_bias=math.radians(1.0),
    magnetometer_bias=15.0,
    scale=0.03,
)
"""Modules as they come from the soldering iron: what `calibrate sensors` is for."""

PRESETS = {"ideal": IDEAL, "typical": TYPICAL, "rough": ROUGH, "uncalibrated": UNCALIBRATED}


@dataclass(frozen=True)
class ModuleErrors:
    """What was drawn once for one module. A sensor reads ``distortion @ true + bias + noise``."""

    accelerometer_distortion: FloatArray  # (3, 3)
    gyroscope_distortion: FloatArray  # (3, 3)
    magnetometer_distortion: FloatArray  # (3, 3)
    accelerometer_bias: FloatArray  # (3,) m/s²
    gyroscope_bias: FloatArray  # (3,) rad/s, at the start
    magnetometer_bias: FloatArray  # (3,) µT
    placement: FloatArray  # (3,) m, segment axes, added to the lever arm
    placement_rotation: FloatArray  # (3, 3) true sensor axes to those assumed


Seconds = TypeVar("Seconds", float, FloatArray)


@dataclass(frozen=True)
class ModuleClock:
    """A module's counter: ``start_us`` when it was switched on, running fast by ``skew``."""

    start_us: int
    skew: float
    """Relative, dimensionless."""
    phase_s: float
    """Clock time of the first sample."""
    origin_s: float = 0.0
    """True time at which the module was switched on."""

    def count_us(self, elapsed: float) -> int:
        """Return the 32-bit counter after so many seconds of its own."""
        return (self.start_us + round(elapsed * 1e6)) % 2**32

    def true_time(self, elapsed: Seconds) -> Seconds:
        """Return the true time, s, at which the clock has run for so long."""
        return self.origin_s + elapsed / (1.0 + self.skew)

    def elapsed(self, true_time: float) -> float:
        """Return how long the clock has run at a true time, s."""
        return (true_time - self.origin_s) * (1.0 + self.skew)

    def restarted(self, at_s: float) -> ModuleClock:
        """Return the same crystal after a loss of power: the counter begins at 0."""
        return replace(self, start_us=0, origin_s=at_s)


def module_random(seed: int, module: int, purpose: int) -> Generator:
    """Return independent random numbers: a module behaves the same whatever other modules there are."""
    return np.random.default_rng([seed, module, purpose])


def draw_errors(settings: Imperfections, rng: Generator) -> ModuleErrors:
    """Draw the constant errors of one module."""

    def distortion() -> FloatArray:
        scale = np.eye(3) + settings.scale * np.diag(rng.standard_normal(3))
        turn: FloatArray = Rotation.from_rotvec(settings.misalignment * rng.standard_normal(3)).as_matrix()
        product: FloatArray = scale @ turn
        return product

    placement_turn = settings.placement_angle * rng.standard_normal(3)
    return ModuleErrors(
        accelerometer_distortion=distortion(),
        gyroscope_distortion=distortion(),
        magnetometer_distortion=distortion(),
        accelerometer_bias=settings.accelerometer_bias * rng.standard_normal(3),
        gyroscope_bias=settings.gyroscope_bias * rng.standard_normal(3),
        magnetometer_bias=settings.magnetometer_bias * rng.standard_normal(3),
        placement=settings.placement * rng.standard_normal(3),
        placement_rotation=Rotation.from_rotvec(placement_turn).as_matrix(),
    )


def draw_clock(settings: Imperfections, rng: Generator, interval_s: float) -> ModuleClock:
    """Draw the clock of one module that samples every ``interval_s``."""
    skew, anywhere, phase = rng.uniform(-1.0, 1.0), int(rng.integers(2**32)), rng.uniform()
    start_us = anywhere if settings.has_random_clock_start else 0
    if settings.wraps_after_s is not None:
        start_us = (2**32 - round(settings.wraps_after_s * 1e6)) % 2**32
    phase_s = phase * interval_s if settings.has_random_phase else 0.0
    return ModuleClock(start_us, 1e-6 * settings.clock_skew_ppm * skew, phase_s)
