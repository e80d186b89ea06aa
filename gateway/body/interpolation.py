"""Segments without module: turned as the body's rules say, from segments that have one. Compiled."""

from __future__ import annotations

import math

import numpy as np

from gateway.body.skeleton import WornSuit
from gateway.frames import FloatArray, Status, StatusArray
from gateway.geometry import quaternion
from gateway.geometry.compiled import compiled
from gateway.geometry.records import Record, Records, records

PREDICTED, WARMING_UP = Status.PREDICTED.value, Status.WARMING_UP.value

BETWEEN_SIGMA = 0.1
"""rad: of a rule between two segments that are in line; a spine bends unevenly."""
BEND_SHARE = 0.25
"""Of the angle between the two, more."""
FOLLOWING_SIGMA = 0.35
"""rad: of a segment that follows its parent, such as a hand or the toes: their joints turn freely."""


class FollowingRule(Record):
    """Of a segment without module."""

    segment: int
    first: int  # the parent where there is no rule
    second: int
    fraction: float  # 0 where there is no rule
    has_rule: int


def following_rules(suit: WornSuit) -> Records[FollowingRule]:
    """Return the body's rules for segments on which this suit has no module, parents first. A root without
    module has none."""
    by_segment = {rule.segment: rule for rule in suit.skeleton.interpolations}
    rows = []
    # Segments are numbered with parents first, and so are the rules.
    for s in np.flatnonzero(suit.module_of_segment < 0):
        rule, parent = by_segment.get(int(s)), int(suit.skeleton.parents[s])
        ends = (rule.first, rule.second) if rule else ()
        # A rule needs modules on both of its ends.
        if rule and all(suit.module_of_segment[end] >= 0 for end in ends):
            rows.append((int(s), rule.first, rule.second, rule.fraction, 1))
        # Otherwise the segment turns with its parent.
        elif parent >= 0:
            rows.append((int(s), parent, parent, 0.0, 0))
    rules = records(FollowingRule, len(rows))
    for k, row in enumerate(rows):
        rules[k] = row
    return rules


@compiled
def follow(
    rules: Records[FollowingRule],
    q_wb: FloatArray,
    rate: FloatArray,
    sigma: FloatArray,
    status: StatusArray,
) -> None:
    """Write orientations (n, 4), rates (n, 3), sigma (n,) and status (n,) of segments without a module.

    A rule whose one end is not defined follows the other. status: PREDICTED, or the end's if that is worse.
    """
    for k in range(len(rules)):
        rule = rules[k]
        s, a, b, fraction = rule.segment, rule.first, rule.second, rule.fraction
        if math.isnan(q_wb[a, 0]):
            a = b
        elif math.isnan(q_wb[b, 0]):
            b = a
        status[s] = max(PREDICTED, status[a], status[b])
        if math.isnan(q_wb[a, 0]):
            q_wb[s], rate[s], sigma[s] = np.nan, np.nan, np.nan
            continue
        bend = 0.0 if a == b else quaternion.angle_between(q_wb[a], q_wb[b])
        # a copy, not an interpolation, where there is one end: bit for bit
        q_wb[s] = q_wb[a] if a == b else quaternion.canonical(quaternion.slerp(q_wb[a], q_wb[b], fraction))
        in_a, in_b = quaternion.rotate(q_wb[a], rate[a]), quaternion.rotate(q_wb[b], rate[b])
        mixed = in_a + fraction * (in_b - in_a)
        rate[s] = rate[a] if a == b else quaternion.rotate_inverse(q_wb[s], mixed)
        ends = ((1.0 - fraction) * sigma[a]) ** 2 + (fraction * sigma[b]) ** 2
        own = BETWEEN_SIGMA + BEND_SHARE * bend if rule.has_rule and a != b else FOLLOWING_SIGMA
        sigma[s] = math.sqrt(ends + own**2)
