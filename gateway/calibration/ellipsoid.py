"""A field of constant strength, read by a distorted sensor, lies on an ellipsoid: fit it, and undo it.

    ‖A (m − b)‖ = strength

Start: the least-squares ellipsoid of Li & Griffiths (2004, Geometric Modeling and Processing: 335–340), which
is always an ellipsoid, as a hyperboloid it cannot become. Then A and b are refined so that the *lengths* of
the corrected readings, not an algebraic residual, are right in the least-squares sense, outliers weighing
little. For the magnetometer A is symmetric (the part of soft iron that a single sensor can know: Kok & Schön
2016, IEEE Sensors J. 16(14): 5679–5689, add a rotation from other sensors); for the accelerometer A is upper
triangular, which fixes the axes to the x axis of the sensor (Tedaldi, Pretto & Menegatti 2014, ICRA).
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np

from devices.deferred import least_squares
from gateway.calibration.coverage import coverage
from gateway.frames import FloatArray, IntArray

_ROUNDS = 3


class Shape(Enum):
    """What the matrix may be, by the number of its parameters."""

    SCALE = 1
    """One scale for all axes: a sphere."""
    DIAGONAL = 3
    """One scale an axis."""
    SYMMETRIC = 6
    TRIANGULAR = -6
    """Upper triangular."""

    @property
    def parameters(self) -> int:
        """Parameters of matrix and bias together."""
        return abs(self.value) + 3


@dataclass(frozen=True, eq=False)
class EllipsoidFit:
    """How readings become vectors of constant length."""

    matrix: FloatArray
    """(3, 3) A, dimensionless."""
    bias: FloatArray
    """(3,) b, unit of the readings."""
    bias_sigma: FloatArray
    """(3,) standard deviation of the bias by the fit's own residuals; inf where undetermined."""
    residual: float
    """RMS of corrected lengths against the strength, relative."""
    spread_before: float
    """Standard deviation of the readings' lengths over their mean."""
    spread_after: float
    """The same of the corrected readings."""
    coverage: float
    """Share of directions seen, 0 to 1, of the corrected readings."""

    def corrected(self, readings: FloatArray) -> FloatArray:
        """Return a (m − b); shape (n, 3)."""
        corrected: FloatArray = (readings - self.bias) @ self.matrix.T
        return corrected


def fit_ellipsoid(readings: FloatArray, strength: float, shape: Shape = Shape.SYMMETRIC) -> EllipsoidFit:
    """Return the correction that gives readings (n, 3) the length ``strength`` (their unit).

    Raises ``ValueError`` when there are fewer readings than parameters, or they do not vary.
    """
    if len(readings) < shape.parameters:
        raise ValueError(f"{len(readings)} readings cannot give {shape.parameters} parameters")
    scale = float(np.sqrt(np.mean(np.sum((readings - readings.mean(axis=0)) ** 2, axis=1))))
    if not scale > 1e-9 * strength:
        raise ValueError("all readings are the same")
    start_matrix, start_bias = _start(readings, strength, shape)
    rows, columns = _positions(shape)

    def unpack(p: FloatArray) -> tuple[FloatArray, FloatArray]:
        return _matrix(p[3:], shape, rows, columns), p[:3] * strength

    def residuals(p: FloatArray) -> FloatArray:
        matrix, bias = unpack(p)
        lengths: FloatArray = np.linalg.norm((readings - bias) @ matrix.T, axis=1)
        return lengths / strength - 1.0

    start = np.concatenate([start_bias / strength, _packed(start_matrix, shape, rows, columns)])
    for _ in range(_ROUNDS):  # as the fit gets better, so does the estimate of what is an outlier
        noise = max(1.4826 * float(np.median(np.abs(residuals(start)))), 1e-4)
        solved = least_squares(
            residuals, start, loss="cauchy", f_scale=3.0 * noise, x_scale="jac", max_nfev=60
        )
        start = solved.x
    matrix, bias = unpack(solved.x)
    corrected = (readings - bias) @ matrix.T
    left = residuals(solved.x)
    return EllipsoidFit(
        matrix,
        bias,
        strength * _sigma(np.asarray(solved.jac, dtype=np.float64), left)[:3],
        float(np.sqrt(np.mean(left**2))),
        _spread(readings),
        _spread(corrected),
        coverage(corrected),
    )


def _start(readings: FloatArray, strength: float, shape: Shape) -> tuple[FloatArray, FloatArray]:
    """Return matrix and bias to begin with: the algebraic ellipsoid, or where it is no use the sphere."""
    centre, radius = sphere(readings)
    ball = np.eye(3) * (strength / radius), centre
    if abs(shape.value) < len(np.triu_indices(3)[0]):
        return ball
    form = _ellipsoid(readings)
    if form is None:
        return ball
    quadratic, bias = form
    if shape is Shape.TRIANGULAR:
        factor: FloatArray = np.asarray(strength * np.linalg.cholesky(quadratic).T, dtype=np.float64)
        return factor, bias
    values, axes = np.linalg.eigh(quadratic)
    root: FloatArray = np.asarray(strength * (axes * np.sqrt(values)) @ axes.T, dtype=np.float64)
    return root, bias


def sphere(readings: FloatArray) -> tuple[FloatArray, float]:
    """Return centre (3,) and radius of the algebraic least-squares sphere through readings (n, 3), in their
    unit."""
    middle = readings.mean(axis=0)
    m = readings - middle
    design = np.column_stack([2.0 * m, np.ones(len(m))])
    solution = np.linalg.lstsq(design, np.sum(m**2, axis=1), rcond=None)[0]
    return middle + solution[:3], float(np.sqrt(max(solution[3] + solution[:3] @ solution[:3], 1e-12)))


def _ellipsoid(readings: FloatArray) -> tuple[FloatArray, FloatArray] | None:
    """Return Q and b of (m − b)ᵀ Q (m − b) = 1 by Li & Griffiths (2004); None if the data do not determine
    them.
    """
    # Centred and scaled to about 1, or else products of unlike magnitudes ruin the scatter matrix.
    centre, radius = sphere(readings)
    x, y, z = ((readings - centre) / radius).T
    design = np.stack([x * x, y * y, z * z, 2 * y * z, 2 * x * z, 2 * x * y, 2 * x, 2 * y, 2 * z, x**0])
    scatter = design @ design.T
    constraint = np.zeros((6, 6))  # 4 J − I² with k = 4
    constraint[:3, :3] = np.ones((3, 3)) - 2.0 * np.eye(3)
    constraint[3:, 3:] = -4.0 * np.eye(3)
    linear = scatter[6:, 6:]
    if np.linalg.cond(linear) > 1e12:
        return None
    reduced = scatter[:6, :6] - scatter[:6, 6:] @ np.linalg.solve(linear, scatter[6:, :6])
    values, vectors = np.linalg.eig(np.linalg.solve(constraint, reduced))
    a = np.real(vectors[:, int(np.argmax(np.real(values)))])
    u = np.concatenate([a, -np.linalg.solve(linear, scatter[6:, :6] @ a)])
    quadratic = np.array([[u[0], u[5], u[4]], [u[5], u[1], u[3]], [u[4], u[3], u[2]]])
    if np.linalg.cond(quadratic) > 1e6:
        return None
    middle = -np.linalg.solve(quadratic, u[6:9])
    level = middle @ quadratic @ middle - u[9]
    quadratic = quadratic / level
    if not (np.linalg.eigvalsh(quadratic) > 0.0).all():
        return None
    return quadratic / radius**2, centre + radius * middle


def _positions(shape: Shape) -> tuple[IntArray, IntArray]:
    """Return rows and columns of the matrix's parameters."""
    rows, columns = np.triu_indices(3) if abs(shape.value) == 6 else (np.arange(3), np.arange(3))
    return rows.astype(np.int64), columns.astype(np.int64)


def _matrix(parameters: FloatArray, shape: Shape, rows: IntArray, columns: IntArray) -> FloatArray:
    matrix = np.zeros((3, 3))
    matrix[rows, columns] = parameters
    if shape is Shape.SYMMETRIC:
        matrix[columns, rows] = parameters
    return matrix


def _packed(matrix: FloatArray, shape: Shape, rows: IntArray, columns: IntArray) -> FloatArray:
    packed: FloatArray = matrix[rows, columns]
    return packed[:1] if shape is Shape.SCALE else packed


def _sigma(jacobian: FloatArray, residuals: FloatArray) -> FloatArray:
    """Return standard deviations of the parameters; inf where the data leave them open."""
    freedom = max(len(residuals) - jacobian.shape[1], 1)
    normal = jacobian.T @ jacobian
    if np.linalg.cond(normal) > 1e14:
        return np.full(jacobian.shape[1], np.inf)
    sigma: FloatArray = np.sqrt(np.diag(np.linalg.inv(normal)) * np.sum(residuals**2) / freedom)
    return sigma


def _spread(vectors: FloatArray) -> float:
    lengths = np.linalg.norm(vectors, axis=1)
    return float(lengths.std() / lengths.mean())
