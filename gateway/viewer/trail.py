"""Where the root segment went in the last seconds, as points on the floor."""

from __future__ import annotations

from collections import deque

import numpy as np
import viser

from gateway.frames import FloatArray
from gateway.viewer.stage import ViewerStage

SPAN_S = 10.0
SPACING_S = 0.2
"""Between two points."""
_POINT_M, _ABOVE_M = 0.035, 0.006
COLOUR = (235, 150, 40)


class Trail:
    """Made once a page. It costs nothing while it is not wanted."""

    def __init__(self, server: viser.ViserServer, stage: ViewerStage) -> None:
        self._server, self._stage = server, stage
        self._places: deque[tuple[float, FloatArray]] = deque()
        self._points: viser.PointCloudHandle | None = None

    def draw(self, is_wanted: bool, time_s: float, place: FloatArray) -> None:
        """Take where the root is, (3,) m, and show where it was. time_s: of this pose; one before the last
        begins anew."""
        if not is_wanted:
            self._forget()
            return
        # Playback has jumped back: what was drawn is not yet.
        if self._places and time_s < self._places[-1][0]:
            self._places.clear()
        # A spacing in time bounds the number of points, however long the trail.
        if not self._places or time_s >= self._places[-1][0] + SPACING_S:
            self._places.append((time_s, np.array([place[0], place[1], _ABOVE_M])))
        while self._places[0][0] < time_s - SPAN_S:
            self._places.popleft()
        points = np.array([each for _, each in self._places]) - self._stage.middle
        shown = points.astype(np.float32)
        if self._points is None:
            self._points = self._server.scene.add_point_cloud(
                "/trail", shown, COLOUR, point_size=_POINT_M, point_shape="circle", point_shading="flat"
            )
        else:
            self._points.points = shown

    def _forget(self) -> None:
        if self._points is not None:
            self._points.remove()
            self._points = None
            self._places.clear()
