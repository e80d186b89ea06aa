"""From a published pose to arrays that can be drawn: nothing undefined is left in them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gateway.body.kinematics import joint_positions, lowest_point
from gateway.body.skeleton import Skeleton
from gateway.contract.messages import BodyMessage, PoseMessage
from gateway.frames import FloatArray


@dataclass(frozen=True)
class DrawnPose:
    """A pose as drawn: every array by segment."""

    q_wb: FloatArray  # (s, 4)
    p_w: FloatArray  # (s, 3) m
    place: FloatArray  # (3,) m, of the root's joint
    is_placed: bool
    """Whether the pose says where the body is; else it stands on the floor, always above the same point."""
    status: tuple[str, ...]
    """As it is shown: see ``LastingStatus``."""
    sigma_rad: tuple[float | None, ...]


def skeleton_of(body: BodyMessage) -> Skeleton:
    """Return the skeleton that a gateway has published."""
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


LASTS_S = 0.2
"""From then on a status other than measured is shown: one lost sample would let a limb flash."""


class LastingStatus:
    """The status of each segment as it is shown: measured at once, any other when it has lasted."""

    def __init__(self, n_segments: int) -> None:
        self._since_ns: list[int | None] = [None] * n_segments
        self._shown: list[str | None] = [None] * n_segments

    def take(self, t_ns: int, status: Sequence[str]) -> tuple[str, ...]:
        """Return what is shown of the status at an instant; one before the last begins anew."""
        return tuple(self._of(s, t_ns, each) for s, each in enumerate(status))

    def _of(self, s: int, t_ns: int, status: str) -> str:
        shown, since_ns = self._shown[s], self._since_ns[s]
        # An instant before the last one is of a recording that begins again.
        is_first = shown is None or (since_ns is not None and t_ns < since_ns)
        if status == "measured" or is_first:
            self._since_ns[s] = None if status == "measured" else t_ns
            self._shown[s] = status
            return status
        assert shown is not None
        if since_ns is None:
            self._since_ns[s] = t_ns
        elif shown != "measured" or t_ns - since_ns >= LASTS_S * 1e9:
            self._shown[s] = shown = status
        return shown


class PostureKeeper:
    """Keeps the last known orientation of every segment, so that a silent one stays in the picture."""

    def __init__(self, skeleton: Skeleton) -> None:
        self._skeleton = skeleton
        self._lasting = LastingStatus(skeleton.n_segments)
        self._q_wb = np.tile(skeleton.neutral, (skeleton.n_segments, 1))
        self._root = int(np.flatnonzero(skeleton.parents < 0)[0])

    def before_any(self) -> DrawnPose:
        """Return the neutral posture on the floor, for the time before the first pose."""
        n, p_w = self._skeleton.n_segments, self._positions(None)
        return DrawnPose(self._q_wb.copy(), p_w, p_w[self._root], False, ("missing",) * n, (None,) * n)

    def take(self, pose: PoseMessage) -> DrawnPose:
        """Return a pose as it is drawn; segments that the skeleton lacks are left out."""
        names = self._skeleton.segment_names
        for s, name in enumerate(names):
            # An unknown segment keeps its last orientation, and is shown as missing by its colour.
            known = pose.segments.get(name)
            if known is not None:
                self._q_wb[s] = known
        sigma = pose.sigma or {}
        place = (pose.position or {}).get(names[self._root])
        p_w = self._positions(place)
        return DrawnPose(
            q_wb=self._q_wb.copy(),
            p_w=p_w,
            place=p_w[self._root],
            is_placed=place is not None and any(place),
            status=self._lasting.take(pose.t_ns, [pose.status.get(name, "missing") for name in names]),
            sigma_rad=tuple(sigma.get(name) for name in names),
        )

    def _positions(self, place: tuple[float, ...] | None) -> FloatArray:
        """Return joints (s, 3), m, by forward kinematics; a body without a place stands on the floor."""
        skeleton = self._skeleton
        root = np.zeros(3) if place is None else np.array(place, np.float64)
        p_w = joint_positions(skeleton.parents, skeleton.offsets, self._q_wb, root)
        if not root.any():
            p_w[:, 2] -= lowest_point(skeleton, self._q_wb, p_w)
        return p_w
