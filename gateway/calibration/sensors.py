"""Gyroscope, accelerometer and magnetometer of one module: what is wrong, and how well it is known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gateway.calibration.coverage import SIDES, evenly, missing_sides
from gateway.calibration.ellipsoid import EllipsoidFit, Shape, fit_ellipsoid
from gateway.calibration.quality import Quality, QualityAspect, graded, judged
from gateway.calibration.rest import RestStretch
from gateway.frames import FloatArray

POSITIONS_FOR_ALL = 12
"""Rest positions from which on the accelerometer's nine parameters are estimated; with fewer six of them."""
FEWEST_POSITIONS = 6
ENOUGH_COVERAGE = 0.8
"""Share of directions at which the magnetometer has seen enough: a little more than what counts as good."""
_GOOD_COVERAGE = 0.75
_SYMMETRIC_COVERAGE = 0.4  # below it the ellipsoid is not determined: a sphere is fitted
_LARGEST_SCALE = 2.0  # a sphere of another size is a patch of one that was guessed
_A_CELL = 12  # readings of each cell that are used
_NEW_POSITION = np.cos(np.radians(15.0))


@dataclass(frozen=True, eq=False)
class GyroscopeResult:
    """Bias at rest."""

    bias: FloatArray  # (3,) rad/s
    rest_s: float
    quality: Quality


@dataclass(frozen=True, eq=False)
class EllipsoidResult:
    """Bias and matrix of an accelerometer or a magnetometer."""

    fit: EllipsoidFit
    used: int
    """Positions or readings that it rests on."""
    quality: Quality


def gyroscope_bias(stretches: Sequence[RestStretch], wanted_s: float = 3.0) -> GyroscopeResult:
    """Return the bias from all stretches at rest. Raises ``ValueError`` when there is none."""
    if not stretches:
        raise ValueError("the module never lay still for a second")
    # A long stretch says more than a short one.
    weights = [stretch.duration_s for stretch in stretches]
    rates = np.stack([stretch.angular_rate for stretch in stretches])
    bias = np.average(rates, axis=0, weights=weights)
    wander = _wander(stretches, bias)
    rest_s = float(sum(weights))
    return GyroscopeResult(
        bias,
        rest_s,
        judged(
            QualityAspect(
                graded(rest_s, wanted_s, 0.5),
                f"lay still for only {rest_s:.1f} s: leave it untouched for {wanted_s:.0f} s",
            ),
            QualityAspect(
                graded(np.degrees(wander), 0.15, 1.5),
                f"angular rate at rest changed by {np.degrees(wander):.2f}°/s: it was moved, or warms up",
            ),
            QualityAspect(
                graded(float(np.degrees(np.abs(bias).max())), 5.0, 12.0),
                f"a bias of {np.degrees(np.abs(bias).max()):.1f}°/s is unusual: was it really at rest?",
            ),
        ),
    )


def _wander(stretches: Sequence[RestStretch], bias: FloatArray) -> float:
    """Return the largest departure of half-second means from the bias, the noise of a mean left out,
    rad/s."""
    windows = [rate for stretch in stretches for _, _, rate in stretch.windows]
    smoothed = [np.mean(windows[i : i + 3], axis=0) for i in range(max(len(windows) - 2, 1))]
    return float(np.abs(np.array(smoothed) - bias).max())


def rest_positions(stretches: Sequence[RestStretch]) -> FloatArray:
    """Return (n, 3) mean specific forces of different positions; stretches within 15° count as one."""
    positions: list[tuple[float, FloatArray]] = []
    for stretch in stretches:
        force, weight = stretch.specific_force, stretch.duration_s
        for i, (before, mean) in enumerate(positions):
            if mean @ force > _NEW_POSITION * np.linalg.norm(mean) * np.linalg.norm(force):
                total = before + weight
                positions[i] = total, mean + (force - mean) * (weight / total)
                break
        else:
            positions.append((weight, force))
    return np.array([mean for _, mean in positions]).reshape(-1, 3)


def accelerometer_ellipsoid(positions: FloatArray, gravity: float) -> EllipsoidResult:
    """Calibrate an accelerometer from rest in positions (n, 3), m/s², in any directions.

    Twelve or more give nine parameters, six or more biases and scales. Raises ``ValueError`` for fewer.
    """
    if len(positions) < FEWEST_POSITIONS:
        raise ValueError(
            f"lay still in only {len(positions)} positions: six are needed, on each side once, better twelve"
        )
    shape = Shape.TRIANGULAR if len(positions) >= POSITIONS_FOR_ALL else Shape.DIAGONAL
    fit = fit_ellipsoid(positions, gravity, shape)
    return EllipsoidResult(fit, len(positions), _accelerometer_quality(fit, positions, gravity))


def six_positions(positions: FloatArray, gravity: float) -> EllipsoidResult:
    """Calibrate an accelerometer on the sides of a levelled cube (n, 3): twelve parameters, housing axes.

    The classical six-position test (IEEE Std 517): each position is taken as gravity exactly along the
    nearest axis. Raises ``ValueError`` when a side is missing or a position lies askew by more than 10°.
    """
    missing = missing_sides(positions)
    if missing:
        raise ValueError(f"it never lay with {', '.join(missing)} up")
    sides = np.array(list(SIDES.values()), dtype=np.float64)
    unit = positions / np.linalg.norm(positions, axis=1, keepdims=True)
    cosines = unit @ sides.T
    askew = np.degrees(np.arccos(np.clip(cosines.max(axis=1), -1.0, 1.0))).max()
    if askew > 10.0:
        raise ValueError(f"one position lay askew by {askew:.0f}°: a levelled surface and a cube are needed")
    # Gravity exactly along an axis of the cube is taken for granted: the table must be level.
    truth = gravity * sides[np.argmax(cosines, axis=1)]
    design = np.column_stack([truth, np.ones(len(truth))])
    distortion = np.linalg.lstsq(design, positions, rcond=None)[0]
    bias, matrix = distortion[3], np.linalg.inv(distortion[:3].T)
    corrected = (positions - bias) @ matrix.T

    left = np.linalg.norm(corrected, axis=1) / gravity - 1.0
    lengths = np.linalg.norm(positions, axis=1)
    fit = EllipsoidFit(
        matrix,
        bias,
        np.full(3, gravity * float(np.sqrt(np.mean(left**2)))),
        float(np.sqrt(np.mean(left**2))),
        float(lengths.std() / lengths.mean()),
        float(np.linalg.norm(corrected, axis=1).std() / gravity),
        1.0,
    )
    return EllipsoidResult(fit, len(positions), _accelerometer_quality(fit, positions, gravity))


def _accelerometer_quality(fit: EllipsoidFit, positions: FloatArray, gravity: float) -> Quality:
    missing = missing_sides(positions, fit.bias)
    residual = gravity * fit.residual
    scale = float(np.abs(np.linalg.svd(fit.matrix, compute_uv=False) - 1.0).max())
    return judged(
        QualityAspect(
            graded(len(positions), POSITIONS_FOR_ALL, 3),
            f"only {len(positions)} positions: axes' misalignment needs {POSITIONS_FOR_ALL}",
        ),
        QualityAspect(
            1.0 - 0.35 * len(missing), f"it never lay with {', '.join(missing)} up: turn it to that side too"
        ),
        QualityAspect(
            graded(residual, 0.05, 0.5),
            f"|f| is still off by {residual:.2f} m/s² at rest: it was touched, or the table shakes",
        ),
        QualityAspect(
            graded(scale, 0.08, 0.25), f"a scale error of {100 * scale:.0f} % is unusual: is the range right?"
        ),
    )


def magnetometer_ellipsoid(readings: FloatArray, strength: float) -> EllipsoidResult:
    """Return hard and soft iron from readings (n, 3) µT of a module turned in all directions.

    strength: of the undisturbed field, µT. Raises ``ValueError`` when the module was hardly turned.
    """
    readings = readings[np.isfinite(readings).all(axis=1)]
    if len(readings) < Shape.SYMMETRIC.parameters:
        raise ValueError("no readings of a magnetometer")
    # A first centre between the extremes is good enough to sort readings by direction.
    centre = 0.5 * (readings.min(axis=0) + readings.max(axis=0))
    chosen = evenly(readings, centre, _A_CELL)
    fit = fit_ellipsoid(chosen, strength, Shape.SCALE)
    if not 1.0 / _LARGEST_SCALE < fit.matrix[0, 0] < _LARGEST_SCALE:
        raise ValueError(
            "it was turned too little, or in a field that varies: turn it about all its axes, away from iron"
        )
    # Soft iron needs all directions: with fewer, nine parameters would follow noise.
    if fit.coverage >= _SYMMETRIC_COVERAGE:
        fit = fit_ellipsoid(evenly(readings, fit.bias, _A_CELL), strength)
    return EllipsoidResult(fit, len(chosen), _magnetometer_quality(fit, chosen, strength))


def _magnetometer_quality(fit: EllipsoidFit, readings: FloatArray, strength: float) -> Quality:
    missing = missing_sides(fit.corrected(readings))
    hint = f": the field never came from {', '.join(missing)}" if missing else ": turn it about all its axes"
    axes = np.linalg.svd(fit.matrix, compute_uv=False)
    uncertain = float(fit.bias_sigma.max())
    return judged(
        QualityAspect(
            graded(fit.coverage, _GOOD_COVERAGE, 0.2),
            f"only {100 * fit.coverage:.0f} % of directions seen{hint}",
        ),
        QualityAspect(
            graded(fit.residual, 0.03, 0.2),
            f"the field still varies by {100 * fit.residual:.1f} %: go away from iron and cables",
        ),
        QualityAspect(
            graded(uncertain / strength, 0.02, 0.2),
            f"hard iron is uncertain by {uncertain:.1f} µT: turn it more",
        ),
        QualityAspect(
            graded(float(axes[0] / axes[-1]), 2.0, 4.0),
            f"axes differ by a factor {axes[0] / axes[-1]:.1f}: iron sits right beside the module",
        ),
    )
