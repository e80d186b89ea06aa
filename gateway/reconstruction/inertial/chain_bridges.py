"""Chains go on over segments without module: where two modules see the joint between them.

Between a segment and the nearest one towards the root that carries a module, others may lie that have none,
like the spine between pelvis and thorax. The body's rules say how those turn: by a share φ of the bend
between two segments. To first order their lengths ``o`` then split, ``R o ≈ (1 − φ) R_a o + φ R_s o``: one
part turns with either end, and there is one joint between the two again, as if nothing else lay there. In
truth the bend may happen anywhere on the way: where that joint is remains uncertain by half the way.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gateway.body.skeleton import Interpolation, WornSuit
from gateway.frames import FloatArray, IntArray
from gateway.reconstruction.inertial.tuning import Tuning


class Bridges(NamedTuple):
    """By segment."""

    parents: IntArray  # (n,) nearest one towards the root with a module; −1: none, or has none itself
    before: FloatArray  # (n, 3) that one's proximal joint to the joint between, its axes, m
    beyond: FloatArray  # (n, 3) the joint between to the own proximal joint, own axes, m
    slack: FloatArray  # (n,) standard deviation of where that joint is, m
    is_bridged: IntArray  # (n,) 1 where segments lie between


def bridges_of(suit: WornSuit, tuning: Tuning) -> Bridges:
    """Of all segments of a suit. A segment without module is in no chain."""
    skeleton, n = suit.skeleton, suit.skeleton.n_segments
    rules = {rule.segment: rule for rule in skeleton.interpolations}
    parents, is_bridged = np.full(n, -1, np.int64), np.zeros(n, np.int64)
    before, beyond, slack = np.zeros((n, 3)), np.zeros((n, 3)), np.zeros(n)
    for s in np.flatnonzero(suit.module_of_segment >= 0):
        between = _without_module(suit, int(s))
        a = int(skeleton.parents[between[-1] if between else s])
        if a < 0:
            continue
        parents[s], is_bridged[s] = a, int(bool(between))
        before[s] = skeleton.offsets[between[-1] if between else s]
        for child, segment in zip([int(s), *between], between, strict=False):
            length, rule = skeleton.offsets[child], rules.get(segment)
            share = _share(rule, a, int(s))
            before[s] += (1.0 - share) * length
            beyond[s] += share * length
            bends = tuning.joint_slack if share == 0.0 else tuning.joint_half_slack
            slack[s] += bends * float(np.linalg.norm(length))
    return Bridges(parents, before, beyond, slack, is_bridged)


def _without_module(suit: WornSuit, s: int) -> list[int]:
    """The segments between s and the nearest with a module, from s towards the root."""
    between, p = [], int(suit.skeleton.parents[s])
    while p >= 0 and suit.module_of_segment[p] < 0:
        between.append(p)
        p = int(suit.skeleton.parents[p])
    return between


def _share(rule: Interpolation | None, a: int, s: int) -> float:
    """Of the bend from a to s that a segment between them turns by; one that has no such rule goes with a."""
    return rule.fraction if rule is not None and (rule.first, rule.second) == (a, s) else 0.0
