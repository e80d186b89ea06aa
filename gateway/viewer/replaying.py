"""A recording played in the place of what comes live."""

from __future__ import annotations

import bisect

from gateway.body.joint_angles import JointAngles
from gateway.body.skeleton import Skeleton
from gateway.contract.messages import PoseMessage
from gateway.errors import GatewayError
from gateway.frames import SkeletonFrame
from gateway.outputs.pose_encoding import PoseEncoder
from gateway.outputs.settings import PoseMap
from gateway.recording import SkeletonArrays
from gateway.viewer.texts import ENGLISH, translated


class RecordedPoses:
    """The poses of a recording as messages, by the time since its beginning."""

    def __init__(self, arrays: SkeletonArrays) -> None:
        self._arrays = arrays
        self.times_s: list[float] = arrays.time_s.tolist()
        skeleton = arrays.skeleton
        self._encoder = PoseEncoder(skeleton.segment_names, None, frozenset(PoseMap), JointAngles(skeleton))

    def index_at(self, position_s: float) -> int:
        """Return the index of the last pose up to a time, s; of the first one before that."""
        return max(0, bisect.bisect_right(self.times_s, position_s) - 1)

    def pose(self, index: int) -> PoseMessage:
        """Return the pose of an index as the message that would have been published."""
        return PoseMessage.model_validate_json(self._encoder.encode(self._frame(index)))

    def _frame(self, index: int) -> SkeletonFrame:
        arrays = self._arrays
        return SkeletonFrame(
            sequence=int(arrays.sequence[index]),
            time_ns=int(arrays.time_ns[index]),
            q_wb=arrays.q_wb[index],
            angular_rate=arrays.angular_rate[index],
            joint_acceleration=arrays.joint_acceleration[index],
            p_w=arrays.p_w[index],
            sigma=arrays.sigma[index],
            status=arrays.status[index],
            root=0,
        )


class ReplayedTake:
    """Plays a recording over and over, at the pace at which it was made."""

    def __init__(
        self, arrays: SkeletonArrays, name: str, shown: Skeleton | None, language: str = ENGLISH
    ) -> None:
        """Play on the body that is shown. Raises ``GatewayError`` where the recording is of another body."""
        if shown is None or arrays.skeleton.segment_names != shown.segment_names:
            raise GatewayError(translated(language, "replay_other", file=name, body=arrays.skeleton.name))
        self.name = name
        self._poses = RecordedPoses(arrays)
        self._begun_s: float | None = None

    def at(self, now_s: float) -> PoseMessage:
        """Return the pose to show at ``now_s`` of any clock that runs evenly; the first call begins."""
        if self._begun_s is None:
            self._begun_s = now_s
        return self._poses.pose(self._poses.index_at(self._position_s(now_s)))

    def text(self, now_s: float, language: str = ENGLISH) -> str:
        """Return position and length of the recording as text."""
        seconds, length = f"{self._position_s(now_s):.1f}", f"{self._poses.times_s[-1]:.1f}"
        return translated(language, "replay_at", seconds=seconds, length=length)

    def _position_s(self, now_s: float) -> float:
        length_s = max(self._poses.times_s[-1], 1e-3)
        return (now_s - (self._begun_s or now_s)) % length_s
