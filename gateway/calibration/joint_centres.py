"""Where the joint between two segments lies in both modules' coordinates, from motion.

The joint's acceleration is the same seen from either side (Seel, Schauer & Raisch 2012, IEEE CCA: 219–224):

    R₁ (f₁ − Γ₁ ρ₁) = R₂ (f₂ − Γ₂ ρ₂),      Γ = [ω̇]× + [ω]×[ω]×

with ρ the vector from the joint to the module, sensor axes, and R the modules' orientations, whose headings
may differ by an unknown Δ (Weygers & Kok 2020, IEEE Sensors J. 20(14)).

The equations of thousands of instants are folded once into a triangle of 16 × 16 numbers that says the same
of any ρ₁, ρ₂ and Δ.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gateway.frames import FloatArray

FEATURES = 16
_LEVEL = np.diag([1.0, 1.0, 0.0])
_QUARTER = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
_UP = np.diag([0.0, 0.0, 1.0])
_SMOOTH = 7  # samples of the smoothing that derivative and readings share


def lever_matrix(angular_rate: FloatArray, angular_acceleration: FloatArray) -> FloatArray:
    """Return Γ (n, 3, 3): Γ ρ is the acceleration of a point at ρ minus that of the joint."""
    return _skew(angular_acceleration) + _skew(angular_rate) @ _skew(angular_rate)


def _skew(v: FloatArray) -> FloatArray:
    zero = np.zeros(len(v))
    x, y, z = v.T
    rows = [[zero, -z, y], [z, zero, -x], [-y, x, zero]]
    return np.moveaxis(np.array(rows), 2, 0)


@dataclass(frozen=True, eq=False)
class ModuleView:
    """One module's view, evenly sampled."""

    force: FloatArray
    """(n, 3) specific force, sensor axes, m/s²."""
    gamma: FloatArray
    """(n, 3, 3), see ``lever_matrix``."""
    R_es: FloatArray
    """(n, 3, 3) sensor axes to a level world of the module's own heading."""


def side(force: FloatArray, rate: FloatArray, R_es: FloatArray, interval_s: float) -> ModuleView:
    """Return force and rate (n, 3) smoothed alike, so that the derivative belongs to both."""
    smooth_rate, smooth_force = _smoothed(rate), _smoothed(force)
    derivative = np.gradient(smooth_rate, interval_s, axis=0)
    return ModuleView(smooth_force, lever_matrix(smooth_rate, derivative), R_es)


def _smoothed(values: FloatArray) -> FloatArray:
    """Return values (n, 3) after a running mean, twice."""
    kernel = np.convolve(np.full(_SMOOTH // 2 + 1, 1.0), np.full(_SMOOTH // 2 + 1, 1.0))
    kernel /= kernel.sum()
    pad = len(kernel) // 2
    padded = np.pad(values, ((pad, pad), (0, 0)), mode="edge")
    return np.stack([np.convolve(column, kernel, "valid") for column in padded.T], axis=1)


@dataclass(frozen=True, eq=False)
class JointEquations:
    """All instants' equations of one joint, folded."""

    triangle: FloatArray
    """(16, 16) with ‖triangle @ features‖² the sum of squares over all instants."""
    n: int
    """Instants."""

    def residuals(self, rho_1: FloatArray, rho_2: FloatArray, heading: float) -> FloatArray:
        """Return (16,) m/s², squares summing up to all instants'; heading: the second's against the
        first's."""
        folded: FloatArray = self.triangle @ features(rho_1, rho_2, heading)
        return folded

    def rms(self, rho_1: FloatArray, rho_2: FloatArray, heading: float) -> float:
        """Return the RMS of an instant's vector difference, m/s², with lever arms (3,) in m."""
        return float(np.sqrt(np.sum(self.residuals(rho_1, rho_2, heading) ** 2) / max(self.n, 1)))


def features(rho_1: FloatArray, rho_2: FloatArray, heading: float) -> FloatArray:
    """Return (16,) what the folded equations are linear in; arms from both modules to the joint (3,), m."""
    second = np.concatenate([[1.0], rho_2])
    turn = np.array([np.cos(heading), np.sin(heading), 1.0])
    return np.concatenate([[1.0], rho_1, np.outer(turn, second).ravel()])


def relative_heading(equations: JointEquations) -> float:
    """Return the heading Δ, rad, of the second module's level world against the first's, by the best fit."""
    # The error may have several minima over the circle, so a coarse search of all of it comes first.
    angles = np.linspace(-np.pi, np.pi, 72, endpoint=False)
    left = [_left_at(equations, angle) for angle in angles]
    best = float(angles[int(np.argmin(left))])
    width = float(angles[1] - angles[0])
    finer = np.linspace(best - width, best + width, 41)
    return float(finer[int(np.argmin([_left_at(equations, angle) for angle in finer]))])


def _left_at(equations: JointEquations, heading: float) -> float:
    """Return sum of squares left with the best ρ₁ and ρ₂."""
    origin = features(np.zeros(3), np.zeros(3), heading)
    units = [features(unit[:3], unit[3:], heading) - origin for unit in np.eye(6)]
    design = equations.triangle @ np.stack(units, axis=1)
    target = -(equations.triangle @ origin)
    # joints lie within the body: a little stiffness keeps what motion does not determine near the module
    stiff = np.sqrt(1e-4 * max(equations.n, 1)) * np.eye(6)
    rho = np.linalg.lstsq(np.vstack([design, stiff]), np.concatenate([target, np.zeros(6)]), rcond=None)[0]
    return float(np.sum((design @ rho - target) ** 2))


def joint_equations(first: ModuleView, second: ModuleView) -> JointEquations:
    """Fold the equations of all instants at which both modules were heard."""
    ours = np.concatenate([first.force[:, :, None], -first.gamma], axis=2)  # (n, 3, 4)
    theirs = np.concatenate([second.force[:, :, None], -second.gamma], axis=2)
    ours, theirs = first.R_es @ ours, second.R_es @ theirs
    parts = [ours, *(-(turn @ theirs) for turn in (_LEVEL, _QUARTER, _UP))]
    rows = np.concatenate(parts, axis=2)  # (n, 3, 16)
    rows = rows[np.isfinite(rows).all(axis=(1, 2))]
    if not len(rows):
        return JointEquations(np.zeros((FEATURES, FEATURES)), 0)
    stacked = rows.reshape(-1, FEATURES)
    triangle = np.zeros((FEATURES, FEATURES))
    r = np.linalg.qr(stacked, mode="r")
    triangle[: len(r)] = r
    return JointEquations(triangle, len(rows))
