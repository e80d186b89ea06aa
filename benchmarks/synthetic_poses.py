"""Poses without a suit, for measuring outputs and the page: a person, or a chain of any length."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from devices.link import gateway_time_ns
from gateway.body.rig import load_rig
from gateway.body.skeleton import Skeleton
from gateway.contract.messages import BridgeInfo
from gateway.frames import SkeletonFrame
from gateway.geometry import quaternion

RATE_HZ = 100.0
GATEWAY = "bench"
_POSES = 200
"""A turn about the vertical in two seconds; made beforehand."""
INFO = BridgeInfo(version="0", gateway=GATEWAY, reconstructor="none", frame_rate=RATE_HZ)


def skeleton_of_size(n: int) -> Skeleton:
    """The person for 17 segments, else a chain."""
    person = load_rig("suit_17").skeleton
    if n == person.n_segments:
        return person
    offsets = np.tile([0.0, -0.1, 0.0], (n, 1))
    return Skeleton("chain", tuple(f"segment_{i}" for i in range(n)), np.arange(n) - 1, offsets, offsets)


def frames_of(skeleton: Skeleton) -> Callable[[int], SkeletonFrame]:
    """Makes the k-th frame, of this instant; orientations are not simpler than real ones, and all turn."""
    n = skeleton.n_segments
    start = np.random.default_rng(1).normal(size=(n, 4))
    half_turns = 2 * np.pi * np.arange(_POSES) / _POSES / 2
    turns = np.column_stack([np.cos(half_turns), np.zeros((_POSES, 2)), np.sin(half_turns)])
    q_wb = np.array([[quaternion.multiply(turn, q) for q in start] for turn in turns])
    q_wb *= np.copysign(1.0, q_wb[..., :1]) / np.linalg.norm(q_wb, axis=-1, keepdims=True)
    zeros = np.zeros((n, 3))
    status = np.zeros(n, np.uint8)

    def frame(k: int) -> SkeletonFrame:
        turned = q_wb[k % _POSES]
        return SkeletonFrame(k, gateway_time_ns(), turned, zeros, zeros, zeros, zeros[:, 0], status, 0)

    return frame
