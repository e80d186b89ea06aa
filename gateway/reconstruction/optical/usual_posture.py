"""What a person's joints usually do: mean and covariance of each, from a trial of which parts were not seen.

Expectation and maximisation (Dempster, Laird & Rubin 1977, J. R. Stat. Soc. B 39: 1) over its frames: what
the markers of a frame tell of all joints together is its normal matrix, and what they do not tell is taken
from the covariance found so far.
"""

from __future__ import annotations

import numpy as np

from devices.deferred import Rotation
from gateway.frames import FloatArray
from gateway.geometry.compiled import compiled
from gateway.reconstruction.optical import kernels
from gateway.reconstruction.optical.motion_kernels import UsualTurns, joint_turns
from gateway.reconstruction.optical.pose_solver import (
    BodyModel,
    WeighedMarkers,
    marker_weights,
    normal_equations,
)

INDEPENDENT_S = 1.0
"""Time after which a posture counts as another one, s: about that in which a rate is forgotten. A gap of half
a second is so hardly half a draw: markers seen on either side of it tell more, where they tell anything."""
FIRST_SIGMA = np.radians(10.0)
"""Of every joint, before anything is known of it, rad: counts as one posture."""
_MOST_FRAMES = 500
_ROUNDS = 20
_ROOT = 6
_UNSEEN = 1e-6
"""Added to the diagonal, 1/m² and 1/rad²."""


def unknown_posture(n_segments: int, n_frames: int) -> UsualTurns:
    """Return a posture that draws nothing."""
    return UsualTurns(
        np.tile(np.eye(3), (n_segments, 1, 1)), np.zeros((n_segments, 3, 3)), np.zeros(n_frames)
    )


def usual_posture(
    model: BodyModel,
    times_s: FloatArray,
    observed: FloatArray,
    motion: tuple[FloatArray, FloatArray],
    scale: float,
) -> UsualTurns:
    """Return what joints do in a trial.

    observed: (F, M, 3) m, NaN where not seen; motion: R (F, S, 3, 3) and the root's places (F, 3) m, as far
    as they are known; scale: m, as in ``WeighedMarkers``.
    """
    R, roots = motion
    chosen = np.arange(0, len(times_s), -(-len(times_s) // _MOST_FRAMES))
    turns = joint_turns(model.parents, R[chosen])
    joints = np.flatnonzero(model.parents >= 0)
    mean = np.tile(np.eye(3), (len(model.parents), 1, 1))
    z = np.empty((len(chosen), len(joints), 3))
    for k, s in enumerate(joints.tolist()):
        mean[s] = Rotation.from_matrix(turns[:, s]).mean().as_matrix()
        z[:, k] = Rotation.from_matrix(mean[s].T @ turns[:, s]).as_rotvec()

    # What joints are allowed is no observation of what they did.
    free = model._replace(stiffness=np.zeros_like(model.stiffness), limit_stiffness=0.0)
    shown = np.array([_shown(free, observed[f], R[f], roots[f], scale) for f in chosen])
    rows = np.concatenate([3 + 3 * joints[:, None] + np.arange(3)], axis=1).ravel()
    step_s = float(np.median(np.diff(times_s[chosen]))) if len(chosen) > 1 else 1.0
    centre, covariance = _learned(_of_joints(shown, rows), z.reshape(len(chosen), -1), INDEPENDENT_S / step_s)
    precision = np.zeros((len(model.parents), 3, 3))
    postures = 1.0 + (times_s[-1] - times_s[0]) / INDEPENDENT_S
    precision[joints] = np.linalg.inv(_predicted(postures) * covariance)
    mean[joints] = mean[joints] @ Rotation.from_rotvec(centre).as_matrix()
    return UsualTurns(mean, precision, np.gradient(times_s) / INDEPENDENT_S)


def _predicted(n: float) -> float:
    """Return by how much one more posture is spread wider than n postures, of which mean and covariance are
    learned: the scale of Student's distribution in three dimensions (Gelman et al., Bayesian Data Analysis,
    2013, section 3.6)."""
    return (n + 1.0) / max(n - 2.0, 1.0)


@compiled
def _shown(
    model: BodyModel, observed: FloatArray, R: FloatArray, root: FloatArray, scale: float
) -> FloatArray:
    """Return the normal matrix (3 + 3 S, 3 + 3 S) of a frame, turns in the segments' axes."""
    p = kernels.places(model.parents, model.offsets, R, root)
    y = kernels.marker_places(model.segments, model.positions, R, p)
    robust_weights = marker_weights(model, WeighedMarkers(observed, np.ones(len(observed)), scale), y)
    H, _, _ = normal_equations(model, observed, robust_weights, R, p)
    kernels.mirrored(H)
    turned = np.eye(len(H))
    for s in range(len(R)):
        turned[3 + 3 * s : 6 + 3 * s, 3 + 3 * s : 6 + 3 * s] = R[s]
    return turned.T @ H @ turned


def _of_joints(shown: FloatArray, rows: FloatArray) -> FloatArray:
    """Return what the markers of each frame tell of the joints, wherever the root is: a Schur complement."""
    H = shown + _UNSEEN * np.eye(shown.shape[1])
    across = H[:, :_ROOT][:, :, rows]
    own: FloatArray = H[:, rows][:, :, rows] - np.swapaxes(across, 1, 2) @ np.linalg.solve(
        H[:, :_ROOT, :_ROOT], across
    )
    return own


def _learned(shown: FloatArray, z: FloatArray, first: float) -> tuple[FloatArray, FloatArray]:
    """Return mean (J, 3) and covariance (J, 3, 3) of joints of which F frames tell z (F, 3 J) with so much
    information (F, 3 J, 3 J). first: frames that ``FIRST_SIGMA`` counts as."""
    n = z.shape[1]
    own = np.arange(n).reshape(-1, 3)
    blocks = own[:, :, None], own[:, None, :]
    evidence = np.einsum("fij,fj->fi", shown, z)
    centre = z.mean(axis=0)
    covariance = np.tile(FIRST_SIGMA**2 * np.eye(3), (n // 3, 1, 1))
    for _ in range(_ROUNDS):
        prior = np.zeros((n, n))
        prior[blocks] = np.linalg.inv(covariance)
        left = np.linalg.inv(shown + prior)
        expected = np.einsum("fij,fj->fi", left, evidence + prior @ centre)
        centre = expected.mean(axis=0)
        away = (expected - centre).reshape(len(z), -1, 3)
        squares = np.einsum("fji,fjk->jik", away, away) + left.sum(axis=0)[blocks]
        covariance = (squares + first * FIRST_SIGMA**2 * np.eye(3)) / (len(z) + first)
    return centre.reshape(-1, 3), covariance
