"""Marker messages to ``MarkerFrame``: the markers of the fitted body, in its order, in world axes."""

from __future__ import annotations

import numpy as np

from devices.link import Chunk
from devices.marker_messages import MarkerReceiver
from gateway.body.markers import BodyMarkers
from gateway.frames import FloatArray, MarkerFrame
from gateway.reconstruction.optical.landmarks import to_world


class MarkerFrames:
    """The chunks of one link. Markers that the body does not have are left out, and counted by name."""

    def __init__(self, markers: BodyMarkers) -> None:
        self._row = {label: row for row, label in enumerate(markers.labels)}
        self._vertical = markers.vertical
        self.receiver = MarkerReceiver()
        self.unknown: set[str] = set()
        """Labels that came and are not on the body."""

    def receive(self, chunk: Chunk) -> list[MarkerFrame]:
        """The frames that a chunk completes."""
        frames = []
        for message in self.receiver.receive(chunk):
            positions = np.full((len(self._row), 3), np.nan)
            for label, place in message.markers.items():
                row = self._row.get(label)
                if row is None:
                    self.unknown.add(label)
                else:
                    positions[row] = place
            nameless: FloatArray = np.array(message.unlabelled, dtype=np.float64).reshape(-1, 3)
            frames.append(
                MarkerFrame(
                    message.sequence,
                    message.time_ns,
                    to_world(positions, message.up or self._vertical),
                    to_world(nameless, message.up or self._vertical),
                )
            )
        return frames
