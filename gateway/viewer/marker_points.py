"""Markers of an optical recording as points on the page, coloured by their distance from the body."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import viser
from numpy.typing import NDArray

from devices.link import Chunk, Framing
from gateway.body.markers import BodyMarkers
from gateway.frames import FloatArray, MarkerFrame
from gateway.geometry import quaternion
from gateway.marker_frames import MarkerFrames
from gateway.recording import Recording, SkeletonArrays
from gateway.viewer.appearance import Colour, chips
from gateway.viewer.stage import Stage

NEAR_M, FAR_M = 0.005, 0.03
"""Up to the first a marker is where the body has it, from the second on it is far off."""
NEAR: Colour = (90, 235, 130)
FAR: Colour = (255, 60, 40)
NAMELESS: Colour = (150, 150, 160)
POINT_M = 0.022
_POINTS, _LINES = "/markers/points", "/markers/residuals"


@dataclass(frozen=True)
class MarkerInstant:
    """Markers of one pose, as they were sent: names are not put right."""

    positions: FloatArray
    """(m, 3) m, those seen."""
    virtual: FloatArray
    """(m, 3) m: where the body has them."""
    unlabelled: FloatArray
    """(k, 3) m."""

    @property
    def residuals(self) -> FloatArray:
        """(m,) m."""
        apart: FloatArray = np.linalg.norm(self.positions - self.virtual, axis=1)
        return apart

    def summary(self) -> str:
        """``39 markers, 2.8 mm RMS from the body, 1 beyond 30 mm``."""
        residuals = self.residuals
        if not len(residuals):
            return "no markers"
        rms, far = 1e3 * np.sqrt(np.mean(residuals**2)), int((residuals > FAR_M).sum())
        beyond = f", {far} beyond {1e3 * FAR_M:.0f} mm" if far else ""
        return f"{len(residuals)} markers, {rms:.1f} mm RMS from the body{beyond}"


class RecordedMarkers:
    """All markers of a recording, from the bytes that came over its links, beside its poses."""

    def __init__(self, markers: BodyMarkers, frames: Iterable[MarkerFrame], arrays: SkeletonArrays) -> None:
        self._markers = markers
        self._frames = {frame.time_ns: frame for frame in frames}
        self._arrays = arrays

    def at(self, index: int) -> MarkerInstant:
        """Those that the pose of that index was made of; none where it was made of something else."""
        arrays, segments = self._arrays, self._markers.segments
        frame = self._frames.get(int(arrays.time_ns[index]))
        q_wb, p_w = arrays.q_wb[index][segments], arrays.p_w[index][segments]
        if frame is None:
            return MarkerInstant(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3)))
        turned = [quaternion.rotate(q, place) for q, place in zip(q_wb, self._markers.positions, strict=True)]
        virtual = p_w + np.array(turned)
        seen = np.isfinite(frame.positions + virtual).all(axis=1)
        known = np.isfinite(frame.unlabelled).all(axis=1)
        return MarkerInstant(frame.positions[seen], virtual[seen], frame.unlabelled[known])


def recorded_markers(recording: Recording, arrays: SkeletonArrays) -> RecordedMarkers | None:
    """The markers of a recording; None where no link carried any."""
    links = {name for name, framing in recording.meta.links.items() if framing is Framing.MARKERS}
    if not links or recording.meta.suit.markers is None:
        return None
    markers = recording.meta.suit.markers
    receivers = {name: MarkerFrames(markers) for name in links}
    return RecordedMarkers(markers, _frames(recording.chunks(), receivers), arrays)


def _frames(chunks: Iterable[Chunk], receivers: dict[str, MarkerFrames]) -> Iterable[MarkerFrame]:
    for chunk in chunks:
        if chunk.link in receivers:
            yield from receivers[chunk.link].receive(chunk)


def residual_colours(residuals: FloatArray) -> NDArray[np.uint8]:
    """(m, 3) RGB from ``NEAR`` to ``FAR``."""
    part = np.clip((residuals - NEAR_M) / (FAR_M - NEAR_M), 0.0, 1.0)[:, None]
    colours: NDArray[np.uint8] = np.round((1.0 - part) * np.array(NEAR) + part * np.array(FAR)).astype(
        np.uint8
    )
    return colours


class MarkerScene:
    """Points where markers were, and from each a line to where the body has it."""

    def __init__(self, server: viser.ViserServer, stage: Stage) -> None:
        self._server = server
        self._stage = stage
        self._is_wanted = server.gui.add_checkbox("Markers", True)
        self._is_wanted.on_update(lambda _: self._show())
        server.gui.add_html(_legend())
        nothing = np.zeros((0, 3))
        self._points = self._new_points(nothing, nothing.astype(np.uint8))
        self._lines = self._new_lines(nothing.reshape(0, 2, 3), nothing.reshape(0, 2, 3).astype(np.uint8))

    def draw(self, instant: MarkerInstant) -> None:
        """Bring the page to an instant."""
        middle = self._stage.middle
        points = np.vstack([instant.positions, instant.unlabelled]) - middle
        by_residual = residual_colours(instant.residuals)
        nameless = np.tile(np.array(NAMELESS, np.uint8), (len(instant.unlabelled), 1))
        colours = np.vstack([by_residual, nameless])
        lines = np.stack([instant.positions, instant.virtual], axis=1) - middle
        ends = np.repeat(by_residual[:, None], 2, axis=1)
        with self._server.atomic():
            # Nodes are kept while their size allows it: one made anew may be gone for a picture.
            if len(points) == len(self._points.points):
                self._points.points, self._points.colors = points.astype(np.float32), colours
            else:
                self._points = self._new_points(points, colours)
            if len(lines) == len(self._lines.points):
                self._lines.points, self._lines.colors = lines.astype(np.float32), ends
            else:
                self._lines = self._new_lines(lines, ends)
            self._show()

    def _show(self) -> None:
        """As the check box says; what has no points is hidden, for a page cannot measure it."""
        for node in (self._points, self._lines):
            node.visible = self._is_wanted.value and len(node.points) > 0

    def _new_points(self, points: FloatArray, colours: NDArray[np.uint8]) -> viser.PointCloudHandle:
        return self._server.scene.add_point_cloud(
            _POINTS,
            points.astype(np.float32),
            colours,
            point_size=POINT_M,
            point_shape="circle",
            precision="float32",
        )

    def _new_lines(self, lines: FloatArray, colours: NDArray[np.uint8]) -> viser.LineSegmentsHandle:
        return self._server.scene.add_line_segments(
            _LINES, lines.astype(np.float32), colours, thickness=2.0, thickness_units="screen"
        )


def _legend() -> str:
    meanings = (
        (f"marker within {1e3 * NEAR_M:.0f} mm of its place", NEAR),
        (f"{1e3 * FAR_M:.0f} mm off and more", FAR),
        ("without a name", NAMELESS),
    )
    return chips(meanings)
