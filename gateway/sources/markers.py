"""Marker messages to ``MarkerFrame``: the markers of the fitted body, in its order, in world axes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping

import numpy as np

from devices.link import Chunk
from devices.marker_messages import MarkerReceiver
from gateway.body.markers import BodyMarkers
from gateway.contract.balances import Balance
from gateway.frames import FloatArray, MarkerFrame
from gateway.reconstruction.optical.landmarks import to_world
from gateway.sources.source import ListeningSource, SourceContext


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


class MarkerSource(ListeningSource):
    """Optical systems, one a link."""

    observes = MarkerFrame

    def __init__(self, context: SourceContext) -> None:
        assert context.suit.markers is not None  # or it would have been refused
        self._markers = context.suit.markers
        self._links: dict[str, MarkerFrames] = {}

    def add_link(self, name: str, content: str) -> None:
        """Announce an optical system."""
        self._links[name] = MarkerFrames(self._markers)

    def receive(self, chunk: Chunk) -> list[MarkerFrame]:
        """Return the frames that a chunk completes."""
        return self._links[chunk.link].receive(chunk)

    def dropped(self) -> Mapping[str, Mapping[str, int]]:
        """Return what could not be read, by link and reason."""
        return {name: frames.receiver.dropped for name, frames in self._links.items()}

    def statistics(self) -> Mapping[str, object]:
        """Return what became of marker messages."""
        dropped: Counter[str] = Counter()
        for frames in self._links.values():
            dropped += frames.receiver.dropped
        unknown = len(set().union(*(frames.unknown for frames in self._links.values())))
        return {"markers": {"dropped": dict(dropped), "unknown_labels": unknown}}

    def balances(self) -> Iterator[Balance]:
        """Yield the frames given."""
        yield Balance("frames", sum(frames.receiver.received for frames in self._links.values()), {})
