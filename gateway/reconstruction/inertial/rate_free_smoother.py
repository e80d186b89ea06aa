"""Fixed-lag smoothing of ``rate_free_filter``: what was seen later corrects what was said before. Compiled.

The modified Bryson–Frazier smoother (Bierman 1973): an adjoint ``λ`` runs backward through the rows and
transitions that the filter has written down, and the orientation some time ago is corrected by ``−P λ``. Only
products of matrices with vectors; nothing is inverted.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gateway.frames import FloatArray, IntArray
from gateway.geometry import rotation_matrix
from gateway.geometry.compiled import compiled
from gateway.reconstruction.inertial.rate_free_filter import MOST_ROWS, RATE, SPIN, N, Rows, SegmentState


class Log(NamedTuple):
    """The last instants of one segment in a ring; changed in place."""

    head: IntArray  # (2,) slot to be written next, instants kept
    F: FloatArray  # (L, N, N) transition to the instant
    P: FloatArray  # (L, 6, N) covariance after the instant: rows of orientation and rate
    R: FloatArray  # (L, 3, 3)
    rate: FloatArray  # (L, 3) world
    n_rows: FloatArray  # (L,)
    gain: FloatArray  # (L, MOST_ROWS, N)
    H: FloatArray  # (L, MOST_ROWS, N)
    innovation: FloatArray  # (L, MOST_ROWS, 2)


def empty_log(length: int) -> Log:
    """For ``length`` instants."""
    return Log(
        np.zeros(2, np.int64),
        np.zeros((length, N, N)),
        np.zeros((length, 6, N)),
        np.zeros((length, 3, 3)),
        np.zeros((length, 3)),
        np.zeros(length),
        np.zeros((length, MOST_ROWS, N)),
        np.zeros((length, MOST_ROWS, N)),
        np.zeros((length, MOST_ROWS, 2)),
    )


@compiled
def note(log: Log, state: SegmentState, F: FloatArray, rows: Rows) -> None:
    """Writes an instant down."""
    k, n = log.head[0], int(rows.n_rows[0])
    log.F[k], log.P[k], log.R[k] = F, state.P[:6], state.R
    log.rate[k] = state.values[RATE:SPIN]
    log.n_rows[k] = n
    log.gain[k, :n], log.H[k, :n] = rows.gain[:n], rows.H[:n]
    log.innovation[k, :n] = rows.innovation[:n]
    log.head[0] = (k + 1) % len(log.n_rows)
    log.head[1] = min(log.head[1] + 1, len(log.n_rows))


@compiled
def smoothed(log: Log) -> tuple[FloatArray, FloatArray]:
    """Orientation (3, 3) and rate (3,), world, of the oldest instant kept, with all seen since."""
    length = len(log.n_rows)
    adjoint = np.zeros(N)
    oldest = (log.head[0] - log.head[1]) % length
    for back in range(log.head[1] - 1):
        k = (log.head[0] - 1 - back) % length
        for row in range(int(log.n_rows[k]) - 1, -1, -1):
            along = 0.0
            for i in range(N):
                along += log.gain[k, row, i] * adjoint[i]
            scale = along + log.innovation[k, row, 0] / log.innovation[k, row, 1]
            for i in range(N):
                adjoint[i] -= log.H[k, row, i] * scale
        earlier = np.zeros(N)
        for i in range(N):
            if adjoint[i] != 0.0:
                for j in range(N):
                    earlier[j] += log.F[k, i, j] * adjoint[i]
        adjoint = earlier
    correction = np.zeros(6)
    for i in range(6):
        for j in range(N):
            correction[i] -= log.P[oldest, i, j] * adjoint[j]
    R = rotation_matrix.multiply(rotation_matrix.from_rotation_vector(correction[:3]), log.R[oldest])
    return R, log.rate[oldest] + correction[3:]
