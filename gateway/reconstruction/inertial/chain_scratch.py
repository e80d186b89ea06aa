"""Arrays that an instant of the chain filters works in: made once, so that no frame makes any."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gateway.frames import FloatArray, IntArray
from gateway.reconstruction.inertial.lever_arms import Learning, learning
from gateway.reconstruction.inertial.local_rows import LocalPair, local_pair_of
from gateway.reconstruction.inertial.observations import SegmentObservations, no_observations
from gateway.reconstruction.inertial.tree_filter import Evidence, Workspace, no_evidence, workspace


class Scratch(NamedTuple):
    """Nothing in it outlives the instant."""

    observed: SegmentObservations
    sun: FloatArray  # (n + 1, 4) see ``follow_sun``
    is_valid: FloatArray  # (n,) see ``note_valid_rows``
    before: FloatArray  # (n, 3, 3) orientations of the frame before
    K: FloatArray  # (n, 3, 3) swing, 1/s², world
    motion: FloatArray  # (n,) ‖[ω̇, ω]‖, 1/s²
    turns: FloatArray  # (n, 3) world rotations that headings are given, rad
    rotations: FloatArray  # (n, 3, 3) those of a correction
    rolling: FloatArray  # (n,) rad/s²; see ``rest_rows``
    anchored: FloatArray  # (n,) 1: a device or the ground holds the chain up here
    chain: IntArray  # (n,) first segment of the chain that the segment belongs to
    sharing: FloatArray  # (n,) by first segment: how many of its chain have a sample
    U: FloatArray  # (n, 3) specific force at the proximal joint as the segment sees it, world
    U_beyond: FloatArray  # (n, 3) and, of a bridged one, at the joint beyond; see ``chain_bridges``
    U_parent: FloatArray  # (n, 3) there as its parent sees it
    learning: Learning
    pair: LocalPair
    evidence: Evidence
    tree: Workspace


def scratch(n: int) -> Scratch:
    """For a body of n segments."""

    def z(*shape: int) -> FloatArray:
        return np.zeros((n, *shape))

    return Scratch(
        no_observations(n), np.full((n + 1, 4), np.nan), z(), z(3, 3), z(3, 3), z(), z(3), z(3, 3), z(), z(),
        np.zeros(n, np.int64), z(), z(3), z(3), z(3), learning(), local_pair_of(), no_evidence(n),
        workspace(n),
    )  # fmt: skip
