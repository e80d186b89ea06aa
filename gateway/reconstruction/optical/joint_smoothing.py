"""How a body moved through gaps: each joint's rotation and the root's place, smoothed over a whole trial by
what markers showed.

A Kalman filter on the rotation of every joint, whose rate fades and is driven by white angular acceleration,
and the smoother of Rauch, Tung and Striebel (1965, AIAA J. 3: 1445) backwards, in the tangent space of the
rotation (Solà et al. 2018, arXiv 1812.01537); the same on the root's place. A direction in which a pose was
not determined carries no information there, so that it follows from what was seen before and after.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from devices.deferred import Rotation
from gateway.frames import FloatArray, IntArray

ACCELERATION = 100.0
"""Spectral density of joints' angular acceleration, rad²/s³: 10 rad/s² that turn about every second."""
FADES_S = 1.0
"""Time constant in which a rate fades that nothing shows, s: through a long gap a joint or the root goes from
where it was last seen to where it was seen next, and swings no farther."""
_ROOT_ACCELERATION = 10.0
"""The same of the root's place, m²/s³."""
_FIRST_SIGMA, _FIRST_RATE = np.pi, 10.0  # rad, rad/s
_FIRST_PLACE, _FIRST_SPEED = 10.0, 5.0  # m, m/s
_WEAK = float(np.radians(60.0) ** -2)
"""What is known of a joint without markers, 1/rad²."""
_FORGOTTEN = 0.999
"""Share of a pose's information that its prior explains, beyond which its markers told nothing."""


class Seen(NamedTuple):
    """What one instant showed of S joints."""

    turn: FloatArray  # (S, 3, 3) distal segment in its parent's axes
    information: FloatArray  # (S, 3, 3) 1/rad², distal axes


class _State(NamedTuple):
    turn: Rotation  # S of them
    rate: FloatArray  # (S, 3) rad/s, distal axes
    P: FloatArray  # (S, 6, 6) covariance of errors of turn and rate


def joint_turns(parents: IntArray, R: FloatArray) -> FloatArray:
    """Return (S, 3, 3) every segment in its parent's axes, the root in the world's."""
    turns: FloatArray = np.where((parents >= 0)[:, None, None], np.swapaxes(R[parents], 1, 2) @ R, R)
    return turns


def from_turns(parents: IntArray, turns: FloatArray) -> FloatArray:
    """Return (S, 3, 3) segments in the world; parents stand before their children."""
    R = turns.copy()
    for s, parent in enumerate(parents.tolist()):
        if parent >= 0:
            R[s] = R[parent] @ turns[s]
    return R


def markers_covariance(factor: FloatArray, prior: float) -> FloatArray:
    """Return (3 + 3 S, 3 + 3 S) of a pose's changes by its markers, and next to nothing known of joints
    beside.

    factor: of the pose's normal matrix, see ``Pose``; prior: the stiffness in it that drew joints to a pose
    known before, 1/rad²: what it tells is not new, of its own joint or, through that, of any other.
    """
    L = np.tril(factor)
    H = L @ L.T
    joints = np.arange(6, len(H))
    H[joints, joints] -= prior - _WEAK
    covariance: FloatArray = np.asarray(np.linalg.inv(H), dtype=np.float64)
    return covariance


def information(parents: IntArray, R: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return (S, 3, 3) 1/rad²: what markers told of every joint's turn, distal axes, of
    ``markers_covariance``."""
    turns = np.stack([covariance[k : k + 3, k : k + 3] for k in range(3, len(covariance), 3)])
    values, vectors = np.linalg.eigh(np.swapaxes(R, 1, 2) @ turns @ R)
    weak = np.where(parents >= 0, _WEAK, 0.0)[:, None]
    new = np.where(weak * values < _FORGOTTEN, 1.0 / values - weak, 0.0)
    found: FloatArray = (vectors * np.maximum(new, 0.0)[:, None, :]) @ np.swapaxes(vectors, 1, 2)
    return found


def smoothed_turns(times_s: FloatArray, seen: list[Seen | None]) -> FloatArray:
    """Return (F, S, 3, 3) joints at F instants; None: nothing was seen at that one. The first must
    be seen."""
    first = seen[0]
    assert first is not None
    n = len(first.turn)
    P = np.tile(np.diag([_FIRST_SIGMA**2] * 3 + [_FIRST_RATE**2] * 3), (n, 1, 1))
    state = _updated(_State(Rotation.from_matrix(first.turn), np.zeros((n, 3)), P), first)
    states, predictions = [state], [(state, np.empty(0))]
    for step, each in zip(np.diff(times_s), seen[1:], strict=True):
        predicted, F = _predicted(state, float(step))
        state = predicted if each is None else _updated(predicted, each)
        states.append(state)
        predictions.append((predicted, F))
    turns = np.empty((len(seen), n, 3, 3))
    turns[-1] = state.turn.as_matrix()
    for f in range(len(seen) - 2, -1, -1):
        state = _looked_back(states[f], *predictions[f + 1], state)
        turns[f] = state.turn.as_matrix()
    return turns


def _predicted(state: _State, step: float) -> tuple[_State, FloatArray]:
    """Return the state a step (s) later, and how errors pass over."""
    ahead = Rotation.from_rotvec(FADES_S * (1.0 - np.exp(-step / FADES_S)) * state.rate)
    F = np.tile(_carried_on(step), (len(state.rate), 1, 1))
    F[:, :3, :3] = ahead.inv().as_matrix()
    P = F @ state.P @ np.swapaxes(F, 1, 2) + _noise(step, ACCELERATION)
    return _State(state.turn * ahead, state.rate * np.exp(-step / FADES_S), P), F


def _updated(state: _State, seen: Seen) -> _State:
    """In the form that takes information without inverse: K = P Hᵀ (1 + Λ H P Hᵀ)⁻¹ Λ."""
    apart = (state.turn.inv() * Rotation.from_matrix(seen.turn)).as_rotvec()
    PH = state.P[:, :, :3]
    K = PH @ np.linalg.solve(np.eye(3) + seen.information @ state.P[:, :3, :3], seen.information)
    change = np.einsum("sij,sj->si", K, apart)
    P = state.P - K @ state.P[:, :3, :]
    P = 0.5 * (P + np.swapaxes(P, 1, 2))
    return _State(state.turn * Rotation.from_rotvec(change[:, :3]), state.rate + change[:, 3:], P)


def _looked_back(state: _State, predicted: _State, F: FloatArray, later: _State) -> _State:
    gain = np.swapaxes(np.linalg.solve(predicted.P, F @ state.P), 1, 2)
    apart = np.concatenate(
        [(predicted.turn.inv() * later.turn).as_rotvec(), later.rate - predicted.rate], axis=1
    )
    change = np.einsum("sij,sj->si", gain, apart)
    return _State(state.turn * Rotation.from_rotvec(change[:, :3]), state.rate + change[:, 3:], state.P)


class SeenPlace(NamedTuple):
    """What one instant showed of the root's place."""

    place: FloatArray  # (3,) m
    information: FloatArray  # (3, 3) 1/m²


def smoothed_places(times_s: FloatArray, seen: list[SeenPlace | None]) -> FloatArray:
    """Return (F, 3) m: the root's place at F instants; None: nothing was seen at that one. The first must be
    seen."""
    first = seen[0]
    assert first is not None
    x, P = np.append(first.place, np.zeros(3)), np.diag([_FIRST_PLACE**2] * 3 + [_FIRST_SPEED**2] * 3)
    states = [_with_place(x, P, first)]
    predictions = [(x, P, np.eye(6))]
    for step, each in zip(np.diff(times_s), seen[1:], strict=True):
        F = _carried_on(float(step))
        x, P = F @ states[-1][0], F @ states[-1][1] @ F.T + _noise(float(step), _ROOT_ACCELERATION)
        predictions.append((x, P, F))
        states.append((x, P) if each is None else _with_place(x, P, each))
    x = states[-1][0]
    places = [x[:3]]
    for (own, P), (predicted, P_ahead, F) in zip(states[-2::-1], predictions[:0:-1], strict=True):
        x = own + np.linalg.solve(P_ahead, F @ P).T @ (x - predicted)
        places.append(x[:3])
    return np.array(places[::-1])


def _with_place(x: FloatArray, P: FloatArray, seen: SeenPlace) -> tuple[FloatArray, FloatArray]:
    """Return the state by what was seen, as ``_updated`` has it."""
    K = P[:, :3] @ np.linalg.solve(np.eye(3) + seen.information @ P[:3, :3], seen.information)
    P = P - K @ P[:3, :]
    return x + K @ (seen.place - x[:3]), 0.5 * (P + P.T)


def _carried_on(step: float) -> FloatArray:
    """Return (6, 6): how place and rate pass over a step (s)."""
    fading = np.exp(-step / FADES_S)
    both = np.array([[1.0, FADES_S * (1.0 - fading)], [0.0, fading]])
    F: FloatArray = np.asarray(np.kron(both, np.eye(3)), dtype=np.float64)
    return F


def _noise(step: float, density: float) -> FloatArray:
    """Return (6, 6) that a step (s) adds; the step is short against ``FADES_S``."""
    both = density * np.array([[step**3 / 3, step**2 / 2], [step**2 / 2, step]])
    noise: FloatArray = np.asarray(np.kron(both, np.eye(3)), dtype=np.float64)
    return noise
