"""Resets while running: a finishing step after any reconstructor, faded in, nothing jumps.

heading    the whole world is turned about the vertical, so that the root faces the asked direction
mounting   every segment is taken to be in the neutral posture now: modules that have slipped are put right
full       both
position   the root is brought above or below the world's origin: what was added up from steps begins anew

What is shown goes from where it was to where it will be within ``FADE_S``. Deterministic: a reset is an
input like a chunk, and takes effect on what was shown last.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gateway.body.kinematics import joint_positions
from gateway.body.skeleton import Skeleton
from gateway.errors import GatewayError, nearest
from gateway.frames import FloatArray, MarkerFit, SkeletonFrame
from gateway.geometry import quaternion

FADE_S = 0.5
KINDS = ("heading", "full", "mounting", "position")
_UP = np.array([0.0, 0.0, 1.0])
_UPRIGHT_RAD = np.radians(60.0)
"""A root leaning farther than this from neutral has no heading to be reset."""


@dataclass(frozen=True, eq=False)
class _Correction:
    """What is done to frames: a turn of the world about the vertical and of every segment's axes, a shift."""

    heading: float
    """rad."""
    mounting: FloatArray
    """(S, 3) rotation vectors, segment axes: new to old."""
    shift: FloatArray
    """(3,) m: of the root, from where the last reset found it shown."""


class Resets:
    """The corrections in force, and how they are faded in."""

    def __init__(self, skeleton: Skeleton) -> None:
        self._skeleton = skeleton
        none = _Correction(0.0, np.zeros((skeleton.n_segments, 3)), np.zeros(3))
        self._from = self._to = none
        self._begun_ns: int | None = None
        self._anchor = np.zeros(3), np.zeros(3)  # the root as it came, and where it is shown
        self._came: SkeletonFrame | None = None
        self._shown: SkeletonFrame | None = None
        self.count = 0

    def apply(self, frame: SkeletonFrame) -> SkeletonFrame:
        """Return the frame as it is to be shown."""
        shown = frame if self.count == 0 else self._corrected(frame)
        self._came, self._shown = frame, shown
        return shown

    def reset(self, kind: str, facing: float = 0.0) -> dict[str, object]:
        """Begin a reset, which takes effect with the next frame.

        Returns what is turned, in degrees, and moved, in m. facing: heading of the root afterwards, rad from
        east. Raises ``GatewayError`` for an unknown kind, before the first pose, where the root leans too far
        to have a heading, and where its position is unknown.
        """
        if kind not in KINDS:
            raise GatewayError(f"there is no reset '{kind}'{nearest(kind, KINDS)}")
        came, shown = self._came, self._shown
        if came is None or shown is None or not np.isfinite(shown.q_wb[shown.root]).all():
            raise GatewayError("there is no pose yet: wait until the suit is heard")

        now = self._at(came.time_ns)
        turn, mounting, shift = 0.0, self._to.mounting, self._to.shift - now.shift
        raw, fixed = came.p_w[came.root], shown.p_w[shown.root]
        is_placed = bool(np.isfinite(raw).all() and np.isfinite(fixed).all())
        if kind == "position":
            if not is_placed:
                raise GatewayError("nobody knows the place of the body: set root_motion in the configuration")
            shift = np.array([-fixed[0], -fixed[1], 0.0])
        else:
            heading = self._heading_of(shown.q_wb[shown.root])
            turn = 0.0 if kind == "mounting" else _wrapped(facing - heading)
            mounting = now.mounting if kind == "heading" else self._to_neutral(came, now, heading)

        # the fade starts from what is shown now; a new anchor has the earlier shift in it
        if is_placed:
            self._anchor = raw.copy(), fixed.copy()
        to = now.heading if kind != "position" else self._to.heading
        self._from = replace(now, shift=np.zeros(3))
        self._to = _Correction(to + turn, mounting, shift)
        self._begun_ns = came.time_ns
        self.count += 1

        changed = [
            quaternion.angle_between(_exp(before), _exp(after))
            for before, after in zip(now.mounting, mounting, strict=True)
        ]
        return {
            "turned_deg": round(float(np.degrees(turn)), 2),
            "remounted_deg": self._named(changed),
            "moved_m": round(float(np.linalg.norm(shift)), 3),
        }

    def _named(self, angles: list[float]) -> dict[str, float]:
        names = self._skeleton.segment_names
        return {
            name: round(float(np.degrees(angle)), 2)
            for name, angle in zip(names, angles, strict=True)
            if angle > 0.0
        }

    def _heading_of(self, q_wb: FloatArray) -> float:
        """Return the heading of a segment against the neutral posture, rad.

        Raises ``GatewayError`` where it leans too far.
        """
        turned = quaternion.multiply(q_wb, quaternion.conjugate(self._skeleton.neutral))
        lean = 2.0 * np.arccos(min(float(np.hypot(turned[0], turned[3])), 1.0))
        if lean > _UPRIGHT_RAD:
            raise GatewayError(
                f"the root leans by {np.degrees(lean):.0f}°, so that it has no heading: stand upright"
            )
        return float(2.0 * np.arctan2(turned[3], turned[0]))

    def _to_neutral(self, came: SkeletonFrame, now: _Correction, heading: float) -> FloatArray:
        """Return the rotation vectors that bring every segment to the neutral posture.

        Unseen segments keep theirs.
        """
        wanted = quaternion.multiply(
            quaternion.from_rotation_vector((heading - now.heading) * _UP), self._skeleton.neutral
        )
        mounting = now.mounting.copy()
        for i, q in enumerate(came.q_wb):
            if np.isfinite(q).all():
                mounting[i] = quaternion.to_rotation_vector(
                    quaternion.multiply(quaternion.conjugate(q), wanted)
                )
        return mounting

    def _at(self, time_ns: int) -> _Correction:
        """Return the correction in force at that time."""
        if self._begun_ns is None:
            return self._to
        u = min(max((time_ns - self._begun_ns) * 1e-9 / FADE_S, 0.0), 1.0)
        share = u**3 * (10.0 - 15.0 * u + 6.0 * u**2)
        if share >= 1.0:
            return self._to
        begin, end = self._from, self._to
        mounting = np.stack(
            [
                quaternion.to_rotation_vector(quaternion.slerp(_exp(a), _exp(b), share))
                for a, b in zip(begin.mounting, end.mounting, strict=True)
            ]
        )
        shift = begin.shift + share * (end.shift - begin.shift)
        return _Correction(begin.heading + share * (end.heading - begin.heading), mounting, shift)

    def _corrected(self, frame: SkeletonFrame) -> SkeletonFrame:
        now = self._at(frame.time_ns)
        turn = quaternion.from_rotation_vector(now.heading * _UP)
        q_wb, rate = np.empty_like(frame.q_wb), np.empty_like(frame.angular_rate)
        acceleration = np.empty_like(frame.joint_acceleration)
        for i in range(len(q_wb)):
            new_to_old = _exp(now.mounting[i])
            turned = quaternion.multiply(quaternion.multiply(turn, frame.q_wb[i]), new_to_old)
            q_wb[i] = quaternion.canonical(quaternion.normalise(turned))
            rate[i] = quaternion.rotate_inverse(new_to_old, frame.angular_rate[i])
            acceleration[i] = quaternion.rotate(turn, frame.joint_acceleration[i])
        return replace(
            frame,
            q_wb=q_wb,
            angular_rate=rate,
            joint_acceleration=acceleration,
            p_w=self._places(frame, q_wb, turn, now.shift),
            markers=None if frame.markers is None else self._turned(frame.markers, turn, now.shift),
        )

    def _turned(self, markers: MarkerFit, turn: FloatArray, shift: FloatArray) -> MarkerFit:
        """Return markers turned with the root, so that residuals stay as they are.

        A reset of the mounting does not move them.
        """
        raw, fixed = self._anchor
        turned = quaternion.to_matrix(turn).T
        places = {
            name: fixed + shift + (getattr(markers, name) - raw) @ turned
            for name in ("positions", "virtual", "unlabelled")
        }
        return replace(markers, **places)

    def _places(
        self, frame: SkeletonFrame, q_wb: FloatArray, turn: FloatArray, shift: FloatArray
    ) -> FloatArray:
        """Return the joints by forward kinematics from the root.

        The root turns about where it was at the reset.
        """
        if not np.isfinite(frame.p_w).any():
            return frame.p_w
        raw, fixed = self._anchor
        tree = self._skeleton
        root = fixed + shift + quaternion.rotate(turn, frame.p_w[frame.root] - raw)
        from_first = joint_positions(tree.parents, tree.offsets, q_wb, np.zeros(3))
        p_w: FloatArray = from_first + (root - from_first[frame.root])
        return p_w


def _exp(rotation_vector: FloatArray) -> FloatArray:
    return quaternion.from_rotation_vector(rotation_vector)


def _wrapped(angle: float) -> float:
    return float((angle + np.pi) % (2.0 * np.pi) - np.pi)
