"""Heat-map messages of several cameras to skeleton frames: put together by instant, solved in order."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from devices.cameras.heat_map_messages import HeatMapMessage, HeatMapReceiver
from devices.link import Chunk
from gateway.body.skeleton import WornSuit
from gateway.frames import SkeletonFrame
from gateway.reconstruction.video.heat_maps import CameraHeatMaps, HeatMapFrame
from gateway.reconstruction.video.keypoint_set import load_keypoint_set
from gateway.reconstruction.video.networks.weights import weights_of
from gateway.reconstruction.video.reconstructor import VideoOptions, VideoPose, VideoReconstructor

NO_CAMERAS = (
    "the rig has no cameras: 'rig' must name a subject that `mocap-gateway video solve` wrote, or a rig with "
    "'cameras'"
)
PATIENCE = 3
PATIENCE_NS = 250_000_000
"""An instant waits for a camera that lags behind: so many instants and so long, at the least."""
SILENT_NS = 1_000_000_000
"""A camera of which nothing has come for so long is not waited for."""

_BEGUN_ANEW = 8
"""Pictures by which a camera's numbers must fall: less is a message that comes twice or late."""


class HeatMapFrames:
    """Chunks of all links with cameras. Sans-I/O and deterministic."""

    def __init__(self, suit: WornSuit) -> None:
        assert suit.video is not None
        assert suit.markers is not None
        self._row = {camera.name: row for row, camera in enumerate(suit.video.cameras)}
        self._network = suit.video.network
        keypoints = load_keypoint_set(weights_of(suit.video.network).keypoint_set)
        keypoints = replace(keypoints, skeleton=suit.skeleton, markers=suit.markers)
        self.reconstructor = VideoReconstructor(suit.video.cameras, keypoints, VideoOptions(is_measured=True))
        self.last: VideoPose | None = None
        """How the last instant was explained."""
        self._receivers: dict[str, HeatMapReceiver] = {}
        self._instants = _Instants(len(self._row))
        self.dropped: Counter[str] = Counter()
        """unknown_camera, other_network, too_late."""
        self.settling = 0
        """Instants that gave no pose: the smoothing is late, and its first ones come later."""

    @property
    def instants(self) -> int:
        """Put together so far."""
        return self._instants.given

    def receive(self, chunk: Chunk) -> list[SkeletonFrame]:
        """The smoothed poses that a chunk completes."""
        return [pose.skeleton for pose in self.poses(chunk) if pose.skeleton is not None]

    def poses(self, chunk: Chunk) -> list[VideoPose]:
        """The instants that a chunk completes, smoothed and not."""
        receiver = self._receivers.setdefault(chunk.link, HeatMapReceiver())
        poses = []
        for message in receiver.receive(chunk.data):
            self._take(message, chunk.arrived_ns)
            poses += [self._solved(frame) for frame in self._instants.complete()]
        return poses

    def statistics(self) -> dict[str, object]:
        """What became of the messages."""
        dropped = Counter(self.dropped)
        for receiver in self._receivers.values():
            dropped += receiver.dropped
        return {
            "received": sum(receiver.received for receiver in self._receivers.values()),
            "dropped": dict(dropped),
            "incomplete": self._instants.incomplete,
            "begun_anew": self._instants.begun_anew,
        }

    def _solved(self, frame: HeatMapFrame) -> VideoPose:
        self.last = self.reconstructor.update(frame)
        self.settling += self.last.skeleton is None
        return self.last

    def _take(self, message: HeatMapMessage, arrived_ns: int) -> None:
        row = self._row.get(message.camera)
        if row is None:
            self.dropped["unknown_camera"] += 1
        elif message.network != self._network:
            self.dropped["other_network"] += 1
        elif not self._instants.add(row, message, arrived_ns):
            self.dropped["too_late"] += 1


class _Instants:
    """Messages of several cameras put together by their sequence numbers, given out in order.

    An instant waits for a camera that may still tell of it: not for one that has told of a later one (the
    messages of one camera keep their order), nor for one that is silent.
    """

    def __init__(self, n_cameras: int) -> None:
        self.given = 0
        self.incomplete = 0
        """Given without every camera."""
        self.begun_anew = 0
        """A camera counted from its beginning again: a file was played once more, or a clock set back."""
        self._n = n_cameras
        self._heard_ns: list[int] = []
        self._now_ns = 0
        self._forget()

    def _forget(self) -> None:
        self._last = [-1] * self._n
        self._waiting: dict[int, dict[int, HeatMapMessage]] = {}
        self._since_ns: dict[int, int] = {}
        self._done = -1
        self._offset_ns: int | None = None

    def add(self, row: int, message: HeatMapMessage, arrived_ns: int) -> bool:
        """Whether the message comes in time."""
        self._now_ns = arrived_ns
        self._heard_ns = self._heard_ns or [arrived_ns] * self._n
        self._heard_ns[row] = arrived_ns
        if message.sequence <= self._last[row] - _BEGUN_ANEW:
            self.begun_anew += 1
            self._forget()
        self._last[row] = max(message.sequence, self._last[row])
        if message.sequence <= self._done:
            return False
        # the senders share a clock; what it is offset by, the least delayed message tells
        offset = arrived_ns - message.time_ns
        self._offset_ns = offset if self._offset_ns is None else min(self._offset_ns, offset)
        self._waiting.setdefault(message.sequence, {})[row] = message
        self._since_ns.setdefault(message.sequence, arrived_ns)
        return True

    def complete(self) -> Iterator[HeatMapFrame]:
        """Instants that all cameras have told of, or that are given up waiting for, in order."""
        while self._waiting:
            first = min(self._waiting)
            if self._is_awaited(first):
                return
            messages = self._waiting.pop(first)
            del self._since_ns[first]
            self._done = first
            self.given += 1
            self.incomplete += len(messages) < self._n
            yield self._frame(first, messages)

    def _is_awaited(self, sequence: int) -> bool:
        """Whether a camera may still tell of this instant, and is waited for."""
        missing = set(range(self._n)) - self._waiting[sequence].keys()
        may_come = any(
            self._last[row] < sequence and self._now_ns - self._heard_ns[row] < SILENT_NS for row in missing
        )
        is_new = self._now_ns - self._since_ns[sequence] < PATIENCE_NS
        return may_come and (is_new or max(self._waiting) - sequence < PATIENCE)

    def _frame(self, sequence: int, messages: dict[int, HeatMapMessage]) -> HeatMapFrame:
        assert self._offset_ns is not None
        time_ns = messages[min(messages)].time_ns + self._offset_ns
        return HeatMapFrame(
            sequence, time_ns, tuple(heat_maps_of(messages.get(row)) for row in range(self._n))
        )


def heat_map_frame(sequence: int, messages: Sequence[bytes]) -> HeatMapFrame:
    """One instant of messages, in the order of the cameras; its time is that of the first."""
    read = [HeatMapReceiver().receive(message)[0] for message in messages]
    return HeatMapFrame(sequence, read[0].time_ns, tuple(map(heat_maps_of, read)))


def heat_maps_of(message: HeatMapMessage | None) -> CameraHeatMaps | None:
    """What a message shows; None: nobody, or there is no message."""
    if message is None or message.likelihood is None:
        return None
    return CameraHeatMaps(message.likelihood.astype(np.float32) / np.float32(255), message.map_from_pixel)
