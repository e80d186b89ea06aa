"""One person of a film tracked while it is looked at, so that the cameras are told where they will be."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from devices.cameras.heat_map_messages import HeatMapReceiver, encode_heat_maps, quantised
from gateway.body.skeleton import VideoSetUp
from gateway.cameras.live_crowd import AHEAD, CrowdInstant
from gateway.frames import CameraHeatMaps
from gateway.reconstruction.video.keypoint_set import load_keypoint_set
from gateway.reconstruction.video.leading import Leading
from gateway.reconstruction.video.networks.weights import keypoint_set_of
from gateway.reconstruction.video.tracker import KeypointTracker, VideoOptions
from gateway.sources.heat_maps import heat_map_frame


class Steering:
    """Sans-I/O and deterministic."""

    def __init__(self, video: VideoSetUp) -> None:
        """Begin at the first picture."""
        keypoints = load_keypoint_set(keypoint_set_of(video.network))
        self._tracker = KeypointTracker(video.cameras, keypoints, VideoOptions())
        self._leading = Leading(video.cameras, keypoints.names, video.pairs)
        self._taken = 0

    def take(self, messages: Sequence[bytes]) -> CrowdInstant:
        """Return one instant, a message a camera, as of person 1, with left and right as the body has them.

        A camera follows by itself while no pose is known.
        """
        frame = heat_map_frame(self._taken, messages)
        maps = self._tracker.put_right(frame.cameras)
        self._tracker.track(maps)
        points = self._tracker.expected_after(AHEAD)
        orders = self._leading.orders(self._taken + AHEAD, {} if points is None else {0: points})
        self._taken += 1
        put_right = [_encoded(*each) for each in zip(messages, frame.cameras, maps, strict=True)]
        return CrowdInstant(messages={1: put_right}, orders=orders)


def _encoded(message: bytes, before: CameraHeatMaps | None, after: CameraHeatMaps | None) -> bytes:
    """Return a message with the maps ``after`` in the place of its own, where they are others."""
    if after is None or after is before:
        return message
    read = HeatMapReceiver().receive(message)[0]
    return encode_heat_maps(replace(read, likelihood=quantised(after.likelihood)))
