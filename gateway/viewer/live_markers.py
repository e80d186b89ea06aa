"""Markers that a gateway publishes, beside the pose that they belong to."""

from __future__ import annotations

from collections import OrderedDict

import numpy as np
import viser

from gateway.contract.messages import MarkersMessage
from gateway.outputs.subscriber import ReceivedPose
from gateway.viewer.marker_points import NO_MARKERS, MarkerInstant, MarkerScene, instant_of
from gateway.viewer.stage import ViewerStage
from gateway.viewer.texts import ENGLISH

_KEPT_POSES = 128
_LONGEST_NS = 500_000_000
"""Markers that are older than the latest pose by more are not shown."""
_UNSEEN = (float("nan"),) * 3


class LiveMarkers:
    """Fewer messages of markers come than poses: the pose of the newest one is drawn, not the newest pose."""

    def __init__(self, server: viser.ViserServer, stage: ViewerStage) -> None:
        self._server = server
        self._stage = stage
        self._scene: MarkerScene | None = None
        self._language = ENGLISH
        self._poses: OrderedDict[int, ReceivedPose] = OrderedDict()

    def set_language(self, language: str) -> None:
        """Say everything in that language from now on."""
        self._language = language
        if self._scene is not None:
            self._scene.set_language(language)

    def add(self, received: ReceivedPose) -> None:
        """Keep a pose, and drop the oldest beyond ``_KEPT_POSES``."""
        self._poses[received.pose.t_ns] = received
        while len(self._poses) > _KEPT_POSES:
            self._poses.popitem(last=False)

    def pose_of(
        self, message: MarkersMessage | None, latest: ReceivedPose
    ) -> tuple[ReceivedPose, MarkerInstant | None]:
        """Return what is to be drawn: the latest pose alone, or the newest markers with their pose."""
        # Markers and pose of different instants would show distances that nobody measured.
        if message is None or abs(latest.pose.t_ns - message.t_ns) > _LONGEST_NS:
            return latest, None
        pose = self._poses.get(message.t_ns)
        return (latest, None) if pose is None else (pose, _instant(message))

    def draw(self, instant: MarkerInstant | None) -> None:
        """Bring the page to it; None: there are none, or none any more."""
        if self._scene is None:
            if instant is None:
                return
            self._scene = MarkerScene(self._server, self._stage, self._language)
        self._scene.draw(NO_MARKERS if instant is None else instant)


def _instant(message: MarkersMessage) -> MarkerInstant:
    markers = message.markers.values()
    return instant_of(
        tuple(message.markers),
        np.array([marker.position or _UNSEEN for marker in markers], np.float64).reshape(-1, 3),
        np.array([marker.expected for marker in markers], np.float64).reshape(-1, 3),
        np.array([marker.used for marker in markers], bool),
        np.array(message.unlabelled, np.float64).reshape(-1, 3),
    )
