"""Marker messages to ``MarkerFrame``: the markers of the fitted body, in its order, in world axes."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Collection, Iterator, Mapping

import numpy as np

from devices.link import Chunk
from devices.marker_files.naming import spellings
from devices.marker_messages import MarkerReceiver
from devices.vendor_formats.sheets import FormatError
from gateway.body.skeleton import BodyMarkers
from gateway.contract.balances import Balance
from gateway.frames import FloatArray, MarkerFrame
from gateway.reconstruction.optical.landmarks import to_world
from gateway.sources.link_settings import MarkersLinkSettings
from gateway.sources.source import ListeningSource, SourceContext

log = logging.getLogger(__name__)

_MOST_LABELS = 2000
"""Of one link; names beyond them are not looked into for spellings."""


class _Rows:
    """Which marker of the body each label of a stream stands for, by the labels that came so far."""

    def __init__(self, labels: tuple[str, ...], person: str | None, link: str) -> None:
        self._own = labels
        self._person = person
        self._link = link
        self._came: dict[str, None] = {}
        self._warned = ""
        self.of = {label: row for row, label in enumerate(labels)} if person is None else {}

    def add_labels(self, labels: Collection[str]) -> None:
        """Take note of the labels of a message."""
        new = [label for label in labels if label not in self._came]
        if not new or len(self._came) > _MOST_LABELS:
            return
        self._came.update(dict.fromkeys(new))
        rows = {label: row for row, label in enumerate(self._own)}
        try:
            found = spellings([*self._came], self._own, person=self._person, source=self._link)
        except FormatError as error:
            if str(error) != self._warned:
                self._warned = str(error)
                log.warning("%s", self._warned.replace("--person ", "'person' of the link: "))
            return
        self.of = {label: rows[name] for label, name in found.items()}


class MarkerFrames:
    """The chunks of one link. Markers that the body does not have are left out, and counted by name."""

    def __init__(self, markers: BodyMarkers, person: str | None = None, link: str = "markers") -> None:
        """Read nothing yet. person: whose markers, as in ``spellings``; link: its name, for the log."""
        self._n_markers = len(markers.labels)
        self._rows = _Rows(markers.labels, person, link)
        self._vertical = markers.vertical
        self.receiver = MarkerReceiver()
        self.unknown: set[str] = set()
        """Labels that came and are not on the body."""

    def receive(self, chunk: Chunk) -> list[MarkerFrame]:
        """Return the frames that a chunk completes."""
        frames = []
        for message in self.receiver.receive(chunk):
            self._rows.add_labels(message.markers.keys())
            positions = np.full((self._n_markers, 3), np.nan)
            for label, place in message.markers.items():
                row = self._rows.of.get(label)
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
        self._settings = context.links
        self._links: dict[str, MarkerFrames] = {}

    def add_link(self, name: str, content: str) -> None:
        """Announce an optical system."""
        settings = self._settings.get(name)
        person = settings.person if isinstance(settings, MarkersLinkSettings) else None
        self._links[name] = MarkerFrames(self._markers, person, name)

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
