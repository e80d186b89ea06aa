"""Markers of an optical recording as points on the page, coloured by their distance from the body."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import viser
from numpy.typing import NDArray

from devices.link import Chunk
from gateway.body.skeleton import BodyMarkers
from gateway.frames import FloatArray, MarkerFrame
from gateway.geometry import quaternion
from gateway.recording import Recording, SkeletonArrays
from gateway.recording.arrays import MarkerArrays
from gateway.sources.markers import MarkerFrames
from gateway.viewer.appearance import Colour, chips
from gateway.viewer.stage import ViewerStage
from gateway.viewer.texts import ENGLISH, translated

NEAR_M, FAR_M = 0.005, 0.03
"""Up to the first a marker is where the body has it, from the second on it is far off."""
NEAR: Colour = (90, 235, 130)
FAR: Colour = (255, 60, 40)
NAMELESS: Colour = (150, 150, 160)
LEFT_OUT: Colour = (200, 80, 255)
WORST = 3
"""So many markers are named."""
POINT_M = 0.022
_POINTS, _LINES = "/markers/points", "/markers/residuals"


@dataclass(frozen=True)
class MarkerInstant:
    """Markers of one pose, as it was made of them."""

    labels: tuple[str, ...]
    """Of those seen."""
    positions: FloatArray
    """(m, 3) m, those seen."""
    virtual: FloatArray
    """(m, 3) m: where the body has them."""
    used: NDArray[np.bool_]
    """(m,) had a say in the pose."""
    unlabelled: FloatArray
    """(k, 3) m."""

    @property
    def residuals(self) -> FloatArray:
        """(m,) m."""
        apart: FloatArray = np.linalg.norm(self.positions - self.virtual, axis=1)
        return apart

    def summary(self, language: str = ENGLISH) -> tuple[str, ...]:
        """Return ``39 markers, 2.8 mm RMS from the body, 1 left out``, and those farthest off."""
        residuals, used = self.residuals, self.used
        if not len(residuals):
            return (translated(language, "markers_count", count=0),)
        parts = [translated(language, "markers_count", count=len(residuals))]
        if used.any():
            rms_mm = 1e3 * np.sqrt(np.mean(residuals[used] ** 2))
            parts.append(translated(language, "markers_off", mm=f"{rms_mm:.1f}"))
        if not used.all():
            parts.append(translated(language, "markers_left_out", count=(~used).sum()))
        farthest = np.argsort(-residuals)[:WORST]
        worst = ", ".join(f"{self.labels[m]} {1e3 * residuals[m]:.0f}" for m in farthest.tolist())
        return ", ".join(parts), translated(language, "markers_worst", worst=worst)


NO_MARKERS = MarkerInstant((), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0, bool), np.zeros((0, 3)))


def instant_of(
    labels: tuple[str, ...],
    positions: FloatArray,
    virtual: FloatArray,
    used: NDArray[np.bool_],
    unlabelled: FloatArray,
) -> MarkerInstant:
    """Return the markers of one instant that were seen and have a pose; NaN marks the others."""
    seen: NDArray[np.bool_] = np.logical_and.reduce(np.isfinite(positions + virtual), axis=1)
    known = np.isfinite(unlabelled).all(axis=1)
    names = tuple(label for label, is_there in zip(labels, seen.tolist(), strict=True) if is_there)
    return MarkerInstant(names, positions[seen], virtual[seen], used[seen], unlabelled[known])


class FittedMarkers:
    """The markers of a recording that says what became of them."""

    def __init__(self, markers: MarkerArrays) -> None:
        self._markers = markers

    def at(self, index: int) -> MarkerInstant:
        """Return the markers of one pose; none if it was made of something else."""
        m = self._markers
        return instant_of(m.labels, m.positions[index], m.virtual[index], m.used[index], m.unlabelled[index])


class ReceivedMarkers:
    """The markers of a recording that has only what came over its links: names are not put right, and all
    count as used."""

    def __init__(self, markers: BodyMarkers, frames: Iterable[MarkerFrame], arrays: SkeletonArrays) -> None:
        self._markers = markers
        self._frames = {frame.time_ns: frame for frame in frames}
        self._arrays = arrays

    def at(self, index: int) -> MarkerInstant:
        """Return the markers of one pose; none if it was made of something else."""
        arrays, segments = self._arrays, self._markers.segments
        frame = self._frames.get(int(arrays.time_ns[index]))
        q_wb, p_w = arrays.q_wb[index][segments], arrays.p_w[index][segments]
        if frame is None:
            return NO_MARKERS
        turned = [quaternion.rotate(q, place) for q, place in zip(q_wb, self._markers.positions, strict=True)]
        used = np.ones(len(segments), bool)
        return instant_of(
            self._markers.labels, frame.positions, p_w + np.array(turned), used, frame.unlabelled
        )


def recorded_markers(recording: Recording, arrays: SkeletonArrays) -> FittedMarkers | ReceivedMarkers | None:
    """Return the markers of a recording; None where no link carried any."""
    if arrays.markers is not None:
        return FittedMarkers(arrays.markers)
    links = {name for name, content in recording.meta.links.items() if content == "markers"}
    if not links or recording.meta.suit.markers is None:
        return None
    markers = recording.meta.suit.markers
    receivers = {name: MarkerFrames(markers) for name in links}
    return ReceivedMarkers(markers, _frames(recording.chunks(), receivers), arrays)


def _frames(chunks: Iterable[Chunk], receivers: dict[str, MarkerFrames]) -> Iterable[MarkerFrame]:
    for chunk in chunks:
        if chunk.link in receivers:
            yield from receivers[chunk.link].receive(chunk)


def residual_colours(residuals: FloatArray) -> NDArray[np.uint8]:
    """Return colours (m, 3), RGB, from ``NEAR`` to ``FAR``."""
    part = np.clip((residuals - NEAR_M) / (FAR_M - NEAR_M), 0.0, 1.0)[:, None]
    colours: NDArray[np.uint8] = np.round((1.0 - part) * np.array(NEAR) + part * np.array(FAR)).astype(
        np.uint8
    )
    return colours


def marker_colours(instant: MarkerInstant) -> NDArray[np.uint8]:
    """Return colours (m, 3), RGB: by residual, with a colour of their own for those left out."""
    colours = residual_colours(instant.residuals)
    colours[~instant.used] = LEFT_OUT
    return colours


class MarkerScene:
    """Points where markers were, and from each a line to where the body has it."""

    def __init__(self, server: viser.ViserServer, stage: ViewerStage, language: str = ENGLISH) -> None:
        self._server = server
        self._stage = stage
        self._is_wanted = server.gui.add_checkbox(translated(language, "markers"), True)
        self._is_wanted.on_update(lambda _: self._show())
        self._legend = server.gui.add_html(_legend(language))
        nothing = np.zeros((0, 3))
        self._points = self._new_points(nothing, nothing.astype(np.uint8))
        self._lines = self._new_lines(nothing.reshape(0, 2, 3), nothing.reshape(0, 2, 3).astype(np.uint8))

    def set_language(self, language: str) -> None:
        """Say everything in that language from now on."""
        self._is_wanted.label = translated(language, "markers")
        self._legend.content = _legend(language)

    def draw(self, instant: MarkerInstant) -> None:
        """Bring the page to an instant."""
        middle = self._stage.middle
        points = np.vstack([instant.positions, instant.unlabelled]) - middle
        by_residual = marker_colours(instant)
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
        """Show what the check box asks for; hide empty sets, of which the page cannot compute a size."""
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


def _legend(language: str) -> str:
    meanings = (
        (translated(language, "marker_near", mm=f"{1e3 * NEAR_M:.0f}"), NEAR),
        (translated(language, "marker_far", mm=f"{1e3 * FAR_M:.0f}"), FAR),
        (translated(language, "marker_left_out"), LEFT_OUT),
        (translated(language, "marker_nameless"), NAMELESS),
    )
    return chips(meanings)
