"""From a published pose to arrays that can be drawn: nothing undefined is left in them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gateway.body.kinematics import joint_positions, lowest_point
from gateway.body.skeleton import Skeleton
from gateway.contract.messages import BodyMessage, PoseMessage
from gateway.frames import FloatArray


@dataclass(frozen=True)
class Posture:
    """A pose as drawn: every array by segment."""

    q_wb: FloatArray  # (s, 4)
    p_w: FloatArray  # (s, 3) m
    place: FloatArray  # (3,) m, of the root's joint
    is_placed: bool
    """Whether the pose told where the body is; else it stands on the floor, always above the same point."""
    status: tuple[str, ...]
    sigma_rad: tuple[float | None, ...]


def skeleton_of(body: BodyMessage) -> Skeleton:
    """The skeleton that a gateway has published."""
    names = [segment.name for segment in body.segments]
    return Skeleton(
        name=body.name,
        segment_names=tuple(names),
        parents=np.array(
            [-1 if s.parent is None else names.index(s.parent) for s in body.segments], np.int64
        ),
        offsets=np.array([segment.offset for segment in body.segments], np.float64),
        tips=np.array([segment.tip for segment in body.segments], np.float64),
        neutral=np.array(body.neutral, np.float64),
    )


class PostureKeeper:
    """Keeps the last known orientation of every segment, so that a silent one stays in the picture."""

    def __init__(self, skeleton: Skeleton) -> None:
        self._skeleton = skeleton
        self._q_wb = np.tile(skeleton.neutral, (skeleton.n_segments, 1))
        self._root = int(np.flatnonzero(skeleton.parents < 0)[0])

    def before_any(self) -> Posture:
        """The body in its neutral posture on the floor, of which nothing has been heard yet."""
        n, p_w = self._skeleton.n_segments, self._positions(None)
        return Posture(self._q_wb.copy(), p_w, p_w[self._root], False, ("missing",) * n, (None,) * n)

    def take(self, pose: PoseMessage) -> Posture:
        """The pose as it is drawn. Segments that the skeleton does not have are left out."""
        names = self._skeleton.segment_names
        for s, name in enumerate(names):
            known = pose.segments.get(name)
            if known is not None:
                self._q_wb[s] = known
        sigma = pose.sigma or {}
        place = (pose.position or {}).get(names[self._root])
        p_w = self._positions(place)
        return Posture(
            q_wb=self._q_wb.copy(),
            p_w=p_w,
            place=p_w[self._root],
            is_placed=place is not None and any(place),
            status=tuple(pose.status.get(name, "missing") for name in names),
            sigma_rad=tuple(sigma.get(name) for name in names),
        )

    def _positions(self, place: tuple[float, ...] | None) -> FloatArray:
        """(s, 3) by forward kinematics from the root; a body whose place nobody knows stands on the floor."""
        skeleton = self._skeleton
        root = np.zeros(3) if place is None else np.array(place, np.float64)
        p_w = joint_positions(skeleton.parents, skeleton.offsets, self._q_wb, root)
        if not root.any():
            p_w[:, 2] -= lowest_point(skeleton, self._q_wb, p_w)
        return p_w
