"""Everything that poses, axes, fields and joints say of how modules sit, in one least-squares problem.

Unknown are of every module its rotation on the segment (θ), its place (U) and the heading of its own level
world (δ), of every joint its place on the parent (L), and the wearer's heading (ψ). What is known of them:

    pose        Rz(ψ) R_neutral P  =  Rz(δ) R_es R_bsᵀ              nobody stands as drawn: some degrees
    movement    R_bs a  =  z                                        a: axis found in sensor coordinates
    field       δ  =  δ_field                                       where it can be trusted
    joint       R₁ (f₁ − Γ₁ ρ₁)  =  R₂ (f₂ − Γ₂ ρ₂)                 ρ₁ = R_bsᵀ (U₁ − L), ρ₂ = R_bsᵀ U₂
    beforehand  U, L as in the rig and the body file                some centimetres

weighted by how far each can be trusted. Simultaneous estimation in this way: Taetz, Bleser & Miezal 2016
(FUSION: 1751–1759), Kok, Hol & Schön 2014 (IFAC: 79–84). Gauss–Newton with steps held in check (trust
region).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from devices.deferred import Rotation, least_squares
from gateway.calibration.joint_centres import JointEquations, relative_heading
from gateway.frames import FloatArray, IntArray

POSE_SIGMA = np.radians(3.0)
"""Of a segment against a pose, about each axis."""
ARMS_UP_SIGMA = np.radians(6.0)
"""The same of arms in the T-pose."""
AXIS_SIGMA = np.radians(1.5)
"""Of the axis of a movement; more where it was not repeated well."""
FIELD_SIGMA = np.radians(3.0)
PLACE_SIGMA = 0.02
"""Of a module against its place in the rig, each component, m."""
LENGTH_SIGMA = 0.02
"""Of a joint against the body file, each component, m."""
_SLOWNESS = 30.0  # samples in a row say the same: smoothing, soft tissue
_FORCE_SIGMA = 0.3  # m/s², least that two views of a joint's acceleration differ


@dataclass(frozen=True, eq=False)
class PoseTerm:
    """One module in one pose."""

    segment: int
    R_es: FloatArray  # (3, 3)
    posture: FloatArray  # (3, 3) segment to the wearer's axes: R_neutral P
    sigma: float  # rad


@dataclass(frozen=True, eq=False)
class AxisTerm:
    """One movement of one module."""

    segment: int
    axis: FloatArray  # (3,) sensor axes
    sign: int
    """Of the segment's z axis along it."""
    sigma: float  # rad


@dataclass(frozen=True, eq=False)
class Problem:
    """All that is known. S segments; those without evidence keep what was known beforehand."""

    parents: IntArray  # (S,)
    places: FloatArray  # (S, 3) U beforehand
    joints: FloatArray  # (S, 3) L of the joint to the parent, parent's axes, beforehand
    poses: list[PoseTerm]
    axes: list[AxisTerm]
    fields: Mapping[int, tuple[float, float]]
    """By segment: heading of its own level world, and sigma, rad."""
    equations: Mapping[int, JointEquations] = field(default_factory=dict)
    """By the child of the joint."""
    start: FloatArray | None = None
    """(S, 4) ``q_bs`` to begin with; None: from the poses."""


@dataclass(frozen=True, eq=False)
class Solution:
    """What fits best; NaN where there was nothing to go by."""

    sensor_to_segment: FloatArray  # (S, 4)
    places: FloatArray  # (S, 3) m
    joints: FloatArray  # (S, 3) m
    headings: FloatArray  # (S,) rad
    facing: float  # rad
    rotation_sigma: FloatArray  # (S,) rad
    place_sigma: FloatArray  # (S,) m
    residual_force: FloatArray  # (S,) m/s² by the child of the joint; NaN without equations


def solve_body(problem: Problem) -> Solution:
    """Return the calibration that fits all terms best.

    Raises ``ValueError`` when no module was in a pose, or nothing gives the headings.
    """
    used = sorted({term.segment for term in problem.poses})
    if not used:
        raise ValueError("no pose was held: a body calibration needs the N-pose or the T-pose")
    unknowns = _Unknowns(problem, used)
    solved = least_squares(unknowns.residuals, np.zeros(unknowns.size), x_scale=unknowns.scales, ftol=1e-3)
    # The noise of the accelerations is not known beforehand: the first solution measures it for the second.
    sharper = unknowns.with_measured_noise(solved.x)
    solved = least_squares(sharper.residuals, solved.x, x_scale=unknowns.scales, ftol=1e-4)
    return sharper.solution(solved.x, np.asarray(solved.jac, dtype=np.float64))


class _Unknowns:
    """Numbers of the optimiser to quantities and residuals."""

    def __init__(
        self, problem: Problem, used: list[int], force_sigma: Mapping[int, float] | None = None
    ) -> None:
        self.problem, self.used = problem, used
        self.row = {segment: k for k, segment in enumerate(used)}
        n, j = len(used), len(problem.equations)
        self.joined = list(problem.equations)
        # Rotation, place and heading of each module, a vector for each joint, and the wearer's heading.
        self.size = n * 7 + j * 3 + 1
        self._cuts = np.cumsum([3 * n, 3 * n, n, 3 * j])
        self.scales = np.concatenate(
            [np.full(3 * n, 0.1), np.full(3 * n, 0.03), np.full(n, 0.1), np.full(3 * j, 0.02), [0.1]]
        )

        self.facing, self.headings, self.R_bs = _start(problem, used)
        self.force_sigma = dict(force_sigma or dict.fromkeys(self.joined, 0.5))
        self._pose_rows = np.array([self.row[t.segment] for t in problem.poses])
        self._pose_R = np.stack([t.R_es for t in problem.poses])
        self._postures = np.stack([t.posture for t in problem.poses])
        self._pose_sigma = np.array([t.sigma for t in problem.poses])[:, None]

    def unpack(self, x: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, float]:
        """Return R_bs (n, 3, 3), places (n, 3), headings δ (n,), joints (j, 3) and facing ψ."""
        theta, places, headings, joints, facing = np.split(x, self._cuts)
        R_bs = Rotation.from_rotvec(theta.reshape(-1, 3)).as_matrix() @ self.R_bs
        return (
            R_bs,
            self.problem.places[self.used] + places.reshape(-1, 3),
            self.headings + headings,
            self.problem.joints[self.joined].reshape(-1, 3) + joints.reshape(-1, 3),
            self.facing + float(facing[0]),
        )

    def residuals(self, x: FloatArray) -> FloatArray:
        """Return all residuals (k,), each divided by its standard deviation, of unknowns x (``size``,)."""
        R_bs, places, headings, joints, facing = self.unpack(x)
        wearer = Rotation.from_rotvec([0.0, 0.0, facing]).as_matrix()
        worlds = _turns(headings)
        rows = self._pose_rows
        error = np.swapaxes(wearer @ self._postures, 1, 2) @ (
            worlds[rows] @ self._pose_R @ np.swapaxes(R_bs[rows], 1, 2)
        )
        parts = [(Rotation.from_matrix(error).as_rotvec() / self._pose_sigma).ravel()]
        for term in self.problem.axes:
            z = R_bs[self.row[term.segment]] @ term.axis * term.sign
            parts.append(np.array([z[0], z[1], min(z[2], 0.0)]) / term.sigma)
        for segment, (heading, sigma) in self.problem.fields.items():
            parts.append(np.array([_wrapped(headings[self.row[segment]] - heading) / sigma]))
        parts.append(((places - self.problem.places[self.used]) / PLACE_SIGMA).ravel())
        parts.append(((joints - self.problem.joints[self.joined].reshape(-1, 3)) / LENGTH_SIGMA).ravel())
        # These two keep the problem of full rank: only differences of headings are seen without a field.
        parts.append(np.array([x[-1], 1e-3 * np.sum(headings - self.headings)]))
        parts += [self._joint(k, R_bs, places, headings, joints) for k in range(len(self.joined))]
        return np.concatenate(parts)

    def _joint(
        self, k: int, R_bs: FloatArray, places: FloatArray, headings: FloatArray, joints: FloatArray
    ) -> FloatArray:
        child = self.joined[k]
        equations = self.problem.equations[child]
        c, p = self.row[child], self.row[int(self.problem.parents[child])]
        rho_1 = R_bs[p].T @ (places[p] - joints[k])
        rho_2 = R_bs[c].T @ places[c]
        # The worst of the three axes: the verdict is about the module as a whole.
        folded = equations.residuals(rho_1, rho_2, float(headings[c] - headings[p]))
        weighed: FloatArray = folded / (self.force_sigma[child] * np.sqrt(_SLOWNESS))
        return weighed

    def forces(self, x: FloatArray) -> dict[int, float]:
        """Return by joint the RMS of what is left of the accelerations' difference, m/s²."""
        R_bs, places, headings, joints, _ = self.unpack(x)
        found = {}
        for k, child in enumerate(self.joined):
            scale = self.force_sigma[child] * np.sqrt(_SLOWNESS)
            folded = self._joint(k, R_bs, places, headings, joints) * scale
            found[child] = float(np.sqrt(np.sum(folded**2) / max(self.problem.equations[child].n, 1)))
        return found

    def with_measured_noise(self, x: FloatArray) -> _Unknowns:
        """Return the same problem, joints weighted by what was left of them."""
        sigma = {child: max(rms, _FORCE_SIGMA) for child, rms in self.forces(x).items()}
        return _Unknowns(self.problem, self.used, sigma)

    def solution(self, x: FloatArray, jacobian: FloatArray) -> Solution:
        """Return the unknowns as arrays over all segments, with standard deviations from the Jacobian
        (k, ``size``) of the residuals."""
        R_bs, places, headings, joints, facing = self.unpack(x)
        problem, n, s = self.problem, len(self.used), len(self.problem.places)
        variance = np.diag(np.linalg.pinv(jacobian.T @ jacobian))
        theta, place, *_ = np.split(variance, self._cuts)
        q = np.full((s, 4), np.nan)
        q[self.used] = Rotation.from_matrix(R_bs).as_quat(canonical=True, scalar_first=True)
        found_places, found_joints = problem.places.copy(), problem.joints.copy()
        found_places[self.used], found_joints[self.joined] = places, joints
        sigmas = np.full((3, s), np.nan)
        sigmas[0, self.used] = np.sqrt(theta.reshape(n, 3).max(axis=1))
        sigmas[1, self.used] = np.sqrt(place.reshape(n, 3).max(axis=1))
        for child, rms in self.forces(x).items():
            sigmas[2, child] = rms

        own = np.full(s, np.nan)
        own[self.used] = headings
        return Solution(q, found_places, found_joints, own, _wrapped(facing), *sigmas)


def _start(problem: Problem, used: list[int]) -> tuple[float, FloatArray, FloatArray]:
    """Return the wearer's heading, and headings and rotations of modules, close enough for Gauss-Newton.

    Each module's axis, level in the pose, points to the right of the wearer (the z axis of the neutral
    segment): from that and the field's headings the wearer's heading; without a field it is set to 0, and the
    axes give the headings of the modules.
    """
    first = {term.segment: term for term in reversed(problem.poses)}
    seen = {s: _bearing_of_axis(problem, first[s]) for s in used}
    right = {s: bearing for s, bearing in seen.items() if bearing is not None}
    known = [problem.fields[s][0] + right[s] for s in right if s in problem.fields]
    # Angles are averaged on the circle: 359° and 1° have the mean 0°, not 180°.
    facing = float(np.angle(np.mean(np.exp(1j * np.array(known))))) if known else 0.0
    heading_of = {s: facing - bearing for s, bearing in right.items()}
    # Where the field is trusted, it is better than the assumption that axes are level.
    heading_of |= {s: heading for s, (heading, _) in problem.fields.items()}
    heading_of = _spread(heading_of, problem)
    if set(used) - set(heading_of):
        raise ValueError("a module has neither a field nor a movement that tells its heading")
    headings = [heading_of[s] for s in used]
    wearer = Rotation.from_rotvec([0.0, 0.0, facing]).as_matrix()
    R_bs = [
        (wearer @ first[s].posture).T @ _turns(np.array([heading]))[0] @ first[s].R_es
        for s, heading in zip(used, headings, strict=True)
    ]
    return facing, np.array(headings), np.stack(R_bs)


def _spread(known: Mapping[int, float], problem: Problem) -> dict[int, float]:
    """Return headings of further modules, from neighbour to neighbour, by their joints' accelerations."""
    found = dict(known)
    for _ in problem.equations:
        for child, equations in problem.equations.items():
            parent = int(problem.parents[child])
            if (child in found) != (parent in found):
                turn = relative_heading(equations)
                if child in found:
                    found[parent] = found[child] - turn
                else:
                    found[child] = found[parent] + turn
    return found


def _bearing_of_axis(problem: Problem, pose: PoseTerm) -> float | None:
    """Return how far the wearer is turned against the module's own level world, rad; None without an axis."""
    found = []
    for term in problem.axes:
        if term.segment == pose.segment:
            seen, drawn = pose.R_es @ term.axis * term.sign, pose.posture[:, 2]
            found.append(np.exp(1j * (np.arctan2(seen[1], seen[0]) - np.arctan2(drawn[1], drawn[0]))))
    return float(np.angle(np.mean(found))) if found else None


def _turns(angles: FloatArray) -> FloatArray:
    """Return (n, 3, 3) about the vertical."""
    c, s, z, o = np.cos(angles), np.sin(angles), np.zeros_like(angles), np.ones_like(angles)
    return np.moveaxis(np.array([[c, -s, z], [s, c, z], [z, z, o]]), 2, 0)


def _wrapped(angle: float) -> float:
    return float((angle + np.pi) % (2.0 * np.pi) - np.pi)
