"""Heat-map messages of several cameras to skeleton frames: put together by instant, solved in order."""

from __future__ import annotations

from collections import Counter
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

NO_CAMERAS = "the rig has no cameras: 'rig' must name a subject that `mocap-gateway video solve` wrote"
PATIENCE = 3
"""Instants by which the other cameras may be ahead of one before it counts as silent."""


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
        self._waiting: dict[int, dict[int, HeatMapMessage]] = {}
        self._done = -1
        self._offset_ns: int | None = None
        self.dropped: Counter[str] = Counter()
        """unknown_camera, other_network, too_late."""
        self.incomplete = 0
        """Instants solved without every camera."""

    def receive(self, chunk: Chunk) -> list[SkeletonFrame]:
        """The smoothed poses that a chunk completes."""
        receiver = self._receivers.setdefault(chunk.link, HeatMapReceiver())
        frames = []
        for message in receiver.receive(chunk.data):
            self._take(message, chunk.arrived_ns)
            frames += [pose for frame in self._complete() if (pose := self._solved(frame)) is not None]
        return frames

    def statistics(self) -> dict[str, object]:
        """What became of the messages."""
        dropped = Counter(self.dropped)
        for receiver in self._receivers.values():
            dropped += receiver.dropped
        return {
            "received": sum(receiver.received for receiver in self._receivers.values()),
            "dropped": dict(dropped),
            "incomplete": self.incomplete,
        }

    def _solved(self, frame: HeatMapFrame) -> SkeletonFrame | None:
        self.last = self.reconstructor.update(frame)
        return self.last.skeleton

    def _take(self, message: HeatMapMessage, arrived_ns: int) -> None:
        row = self._row.get(message.camera)
        if row is None:
            self.dropped["unknown_camera"] += 1
        elif message.network != self._network:
            self.dropped["other_network"] += 1
        elif message.sequence <= self._done:
            self.dropped["too_late"] += 1
        else:
            # the senders share a clock; what it is offset by, the least delayed message tells
            offset = arrived_ns - message.time_ns
            self._offset_ns = offset if self._offset_ns is None else min(self._offset_ns, offset)
            self._waiting.setdefault(message.sequence, {})[row] = message

    def _complete(self) -> list[HeatMapFrame]:
        """Instants that all cameras have told of, or that are given up waiting for, in order."""
        frames = []
        while self._waiting:
            first, newest = min(self._waiting), max(self._waiting)
            messages = self._waiting[first]
            if len(messages) < len(self._row) and newest - first < PATIENCE:
                break
            self.incomplete += len(messages) < len(self._row)
            del self._waiting[first]
            self._done = first
            frames.append(self._frame(first, messages))
        return frames

    def _frame(self, sequence: int, messages: dict[int, HeatMapMessage]) -> HeatMapFrame:
        assert self._offset_ns is not None
        time_ns = messages[min(messages)].time_ns + self._offset_ns
        cameras = tuple(heat_maps_of(messages.get(row)) for row in range(len(self._row)))
        return HeatMapFrame(sequence, time_ns, cameras)


def heat_maps_of(message: HeatMapMessage | None) -> CameraHeatMaps | None:
    """What a message shows; None: nobody, or there is no message."""
    if message is None or message.likelihood is None:
        return None
    return CameraHeatMaps(message.likelihood.astype(np.float32) / np.float32(255), message.map_from_pixel)
