"""Bodies of any size for timing: copies of the 17-segment suit, each joined to the pelvis of the last one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gateway.body.skeleton import WornSuit
from gateway.frames import ImuFrame

SIZES = (17, 64, 256, 1024)


def enlarged_suit(suit: WornSuit, n: int) -> WornSuit:
    """Of n segments; every copy moves as the first one does, so that all joints agree."""
    m, skeleton = suit.skeleton.n_segments, suit.skeleton
    rows = np.arange(n) % m
    copy = np.arange(n) // m
    root = int(np.flatnonzero(skeleton.parents < 0)[0])
    joined = np.where(copy == 0, -1, (copy - 1) * m + root)
    return replace(
        suit,
        skeleton=replace(
            skeleton,
            segment_names=tuple(f"{skeleton.segment_names[row]}_{k}" for k, row in enumerate(rows)),
            parents=np.where(skeleton.parents[rows] < 0, joined, copy * m + skeleton.parents[rows]),
            offsets=skeleton.offsets[rows],
            tips=skeleton.tips[rows],
        ),
        module_ids=tuple(range(1, n + 1)),
        module_of_segment=np.arange(n),
        sensor_to_segment=suit.sensor_to_segment[rows],
        lever_arms=suit.lever_arms[rows],
    )


def enlarged_frame(suit: WornSuit, frame: ImuFrame, n: int) -> ImuFrame:
    """The frame of one suit as that of n segments."""
    rows = suit.module_of_segment[np.arange(n) % suit.skeleton.n_segments]
    return replace(
        frame,
        specific_force=frame.specific_force[rows],
        angular_rate=frame.angular_rate[rows],
        magnetic_field=frame.magnetic_field[rows],
        status=frame.status[rows],
        gap_ns=frame.gap_ns[rows],
    )
