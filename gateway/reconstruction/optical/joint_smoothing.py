"""How joints turned through gaps: each joint's rotation smoothed over a whole trial, by what markers showed.

A Kalman filter with constant rate and white angular acceleration on the rotation of every joint, and the
smoother of Rauch, Tung and Striebel (1965, AIAA J. 3: 1445) backwards, in the tangent space of the rotation
(Solà et al. 2018, arXiv 1812.01537). A direction in which a pose was not determined carries no information
there, so that it follows from what was seen before and after.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from devices.deferred import Rotation
from gateway.frames import FloatArray, IntArray

ACCELERATION = 100.0
"""Spectral density of joints' angular acceleration, rad²/s³: 10 rad/s² that turn about every second."""
_FIRST_SIGMA, _FIRST_RATE = np.pi, 10.0  # rad, rad/s
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
    """(S, 3, 3) every segment in its parent's axes, the root in the world's."""
    turns: FloatArray = np.where((parents >= 0)[:, None, None], np.swapaxes(R[parents], 1, 2) @ R, R)
    return turns


def from_turns(parents: IntArray, turns: FloatArray) -> FloatArray:
    """(S, 3, 3) segments in the world; parents stand before their children."""
    R = turns.copy()
    for s, parent in enumerate(parents.tolist()):
        if parent >= 0:
            R[s] = R[parent] @ turns[s]
    return R


def information(parents: IntArray, R: FloatArray, factor: FloatArray, prior: float) -> FloatArray:
    """(S, 3, 3) 1/rad²: what markers told of every joint's turn, distal axes.

    factor: of a pose's normal matrix, see ``Pose``; prior: the stiffness in it that drew joints to a pose
    known before, 1/rad², which tells nothing new.
    """
    inverse = np.linalg.inv(np.tril(factor))
    n = len(parents)
    blocks = inverse[:, 3:].reshape(len(factor), n, 3)
    covariance = np.einsum("ksi,ksj->sij", blocks, blocks)
    local = np.swapaxes(R, 1, 2) @ covariance @ R
    values, vectors = np.linalg.eigh(local)
    told = np.where(parents >= 0, prior, 0.0)[:, None]
    new = np.where(told * values < _FORGOTTEN, 1.0 / values - told, 0.0)
    found: FloatArray = (vectors * np.maximum(new, 0.0)[:, None, :]) @ np.swapaxes(vectors, 1, 2)
    return found


def smoothed_turns(times_s: FloatArray, seen: list[Seen | None]) -> FloatArray:
    """(F, S, 3, 3) joints at F instants; None: nothing was seen at that one. The first must be seen."""
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
    """The state a step (s) later, and how errors pass over."""
    ahead = Rotation.from_rotvec(step * state.rate)
    F = np.tile(np.eye(6), (len(state.rate), 1, 1))
    F[:, :3, :3] = ahead.inv().as_matrix()
    F[:, :3, 3:] = step * np.eye(3)
    noise = np.kron([[step**3 / 3, step**2 / 2], [step**2 / 2, step]], ACCELERATION * np.eye(3))
    P = F @ state.P @ np.swapaxes(F, 1, 2) + noise
    return _State(state.turn * ahead, state.rate, P), F


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
