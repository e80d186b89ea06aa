"""A part of a body: what is worn of it, and all between."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gateway.body.joints import WORLD
from gateway.body.skeleton import Interpolation, Skeleton


def reduced(skeleton: Skeleton, worn: list[int]) -> Skeleton:
    """Return the body without what lies beyond the worn segments: they, and all between them."""
    chains = [_ancestors(skeleton, segment) for segment in worn]
    shared = set(chains[0]).intersection(*chains[1:])
    root = max(shared)  # parents stand before their children
    keep = sorted({segment for chain in chains for segment in chain if segment >= root})
    position = {segment: i for i, segment in enumerate(keep)}
    offsets = skeleton.offsets[keep].copy()
    offsets[0] = 0.0
    joints = tuple(
        replace(joint, proximal=position.get(joint.proximal, WORLD), distal=position[joint.distal])
        for joint in skeleton.joints
        if joint.distal in position and (joint.proximal in position or joint.proximal == WORLD)
    )
    between = tuple(
        Interpolation(position[each.segment], position[each.first], position[each.second], each.fraction)
        for each in skeleton.interpolations
        if {each.segment, each.first, each.second} <= position.keys()
    )
    return replace(
        skeleton,
        name=skeleton.name if len(keep) == skeleton.n_segments else f"{skeleton.name}_part",
        segment_names=tuple(skeleton.segment_names[segment] for segment in keep),
        parents=np.array([position.get(int(skeleton.parents[s]), -1) for s in keep], dtype=np.int64),
        offsets=offsets,
        tips=skeleton.tips[keep],
        joints=joints,
        contacts=tuple((position[s], point) for s, point in skeleton.contacts if s in position),
        interpolations=between,
    )


def _ancestors(skeleton: Skeleton, segment: int) -> list[int]:
    chain = [segment]
    while (parent := int(skeleton.parents[chain[-1]])) >= 0:
        chain.append(parent)
    return chain
