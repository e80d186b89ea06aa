"""The order in which a body is gone through, outward from the segment whose acceleration is known.

The source numbers the segments from the rank-1 segment. When that is not the skeleton's own root, the
tree is re-rooted: part of it is travelled from child to parent. Every segment gets a reference point
``P``: the place where it is entered. For the root that is where its local device sits (the source's
virtual joint ``P_1``), downward it is the segment's proximal joint, upward the proximal joint of the
child one comes from. All arms are then differences to that point.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gateway.body.skeleton import Skeleton
from gateway.frames import FloatArray, IntArray


class Travel(NamedTuple):
    """The tree as seen from its root; arrays by segment unless said otherwise."""

    order: IntArray
    """(n_segments,) segments, each after the one it is entered from."""
    entered_from: IntArray
    """(n_segments,) the neighbour on the root's side, -1 for the root."""
    link: FloatArray
    """(n_segments, 3) ``L``: from the neighbour's P to this segment's P, in the neighbour's axes, m."""
    proximal: FloatArray
    """(n_segments, 3) from the segment's P to its proximal joint, own axes, m; zero when entered there."""

    def arms(self, from_proximal: FloatArray) -> FloatArray:
        """Return ``U``, from P to places given from the proximal joint.

        Both are (n_segments, 3), m, segment axes.
        """
        return from_proximal + self.proximal


def travel_from(skeleton: Skeleton, root: int, point: FloatArray) -> Travel:
    """Return the tree as gone through from ``root``.

    point: (3,) the root's P from its proximal joint, own axes, m.
    """
    n = skeleton.n_segments
    order, entered_from = [root], np.full(n, -1, np.int64)
    link, entry = np.zeros((n, 3)), np.zeros((n, 3))
    entry[root] = point
    for segment in order:  # grows while it is gone through
        for neighbour in _neighbours(skeleton, segment):
            if neighbour == entered_from[segment]:
                continue
            entered_from[neighbour] = segment
            if skeleton.parents[neighbour] == segment:
                link[neighbour] = skeleton.offsets[neighbour] - entry[segment]
            else:
                link[neighbour] = -entry[segment]
                entry[neighbour] = skeleton.offsets[segment]
            order.append(neighbour)
    return Travel(np.array(order, np.int64), entered_from, link, 0.0 - entry)


def _neighbours(skeleton: Skeleton, segment: int) -> list[int]:
    """Return the parent of a segment, if it has one, and then its children."""
    parent = int(skeleton.parents[segment])
    children = [int(child) for child in np.flatnonzero(skeleton.parents == segment)]
    return [parent, *children] if parent >= 0 else children
