"""The body on the page: a mannequin or bones, axes, and names of segments, of silent ones always."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from gateway.body.bones import BONE_FACES, BONE_VERTICES, Bones, bones_of
from gateway.body.mannequin import SPINDLE_FACES, SPINDLE_VERTICES, Mannequin, mannequin_of
from gateway.body.skeleton import Skeleton
from gateway.frames import FloatArray
from gateway.geometry import quaternion
from gateway.viewer.appearance import COLOURS, FACE, MOST_NAMED, segment_colours, side_of
from gateway.viewer.posture import DrawnPose
from gateway.viewer.stage import ViewerStage
from gateway.viewer.texts import ENGLISH, segment_name, translated

AXES_LENGTH_M = 0.09
_BODY = "/body"


def _at_rest(count: int) -> tuple[FloatArray, FloatArray]:
    """Return orientations (count, 4), none turned, and places (count, 3), all at the origin."""
    return np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)), np.zeros((count, 3))


def _bone_meshes(scene: viser.SceneApi, bones: Bones, name: str) -> viser.BatchedMeshHandle:
    """Add one mesh a bone to a scene."""
    count = len(bones.segment)
    return scene.add_batched_meshes_simple(
        name,
        BONE_VERTICES,
        BONE_FACES,
        *_at_rest(count),
        batched_scales=bones.scale,
        batched_colors=np.full((count, 3), 140, np.uint8),
        flat_shading=True,
        lod="off",
        cast_shadow=False,
        receive_shadow=False,
    )


class BodyScene:
    """One body in the scene of a viser server; made anew when the body changes."""

    def __init__(
        self,
        server: viser.ViserServer,
        stage: ViewerStage,
        skeleton: Skeleton,
        clicked: Callable[[str], None] | None = None,
        root: str = _BODY,
    ) -> None:
        """Add a body; ``clicked`` is called with the segment of a limb that is clicked.

        root: of the names in the scene; each body has its own.
        """
        self._server = server
        self._stage = stage
        self._skeleton = skeleton
        self._bones = bones = bones_of(skeleton)
        self._bodies = _bone_meshes(server.scene, bones, f"{root}/bones")

        self._sides = [side_of(name) for name in skeleton.segment_names]
        mannequin = mannequin_of(skeleton)
        self._figure = None if mannequin is None else Figure(server, mannequin, root)
        if self._figure is not None and clicked is not None:
            names = skeleton.segment_names
            self._figure.on_click(lambda segment: clicked(names[segment]))
        self.marked = ""
        """A segment whose name is shown."""
        self.shows_bones = mannequin is None
        self._bodies.visible = self.shows_bones

        self._axes = server.scene.add_batched_axes(
            f"{root}/axes",
            *_at_rest(skeleton.n_segments),
            axes_length=AXES_LENGTH_M,
            axes_radius=0.004,
            visible=False,
        )
        self._labels = [
            server.scene.add_label(f"{root}/names/{name}", name, visible=False, anchor="bottom-left")
            for name in skeleton.segment_names
        ]

        self._colours = np.zeros((0, 3), np.uint8)
        self.shows_names = False
        self.language = ENGLISH
        """Of the names."""

    def remove(self) -> None:
        """Take the body off the page."""
        for node in (self._bodies, self._axes, *self._labels):
            node.remove()
        if self._figure is not None:
            self._figure.remove()

    def show_bones(self, are_wanted: bool) -> None:
        """Show bones in place of the mannequin; bodies without a mannequin always have bones."""
        self.shows_bones = are_wanted or self._figure is None
        if self._bodies.visible != self.shows_bones:
            self._bodies.visible = self.shows_bones
            self._colours = np.zeros((0, 3), np.uint8)
        if self._figure is not None:
            self._figure.show(not self.shows_bones)

    def show_axes(self, is_wanted: bool) -> None:
        """Show the segments' axes, or hide them."""
        self._axes.visible = is_wanted

    def draw(
        self,
        posture: DrawnPose,
        is_stale: bool,
        silent: Collection[str] = (),
        red: Collection[str] = (),
    ) -> None:
        """Bring the page to a posture; the silent segments are named, those in ``red`` are red."""
        p_w = posture.p_w - self._stage.middle
        colours = segment_colours(posture.status, posture.sigma_rad, is_stale, self._sides)
        for name in red:
            colours[self._skeleton.index(name)] = COLOURS["missing"]
        # In one message, so that no page shows half of a new posture.
        with self._server.atomic():
            if self.shows_bones:
                self._draw_bones(posture, p_w, colours)
            if self._figure is not None:
                self._figure.draw(posture, p_w, colours)
            if self._axes.visible:
                self._axes.batched_wxyzs = posture.q_wb.astype(np.float32)
                self._axes.batched_positions = p_w.astype(np.float32)
            self._name_segments(p_w, posture.q_wb, silent)

    def _draw_bones(self, posture: DrawnPose, p_w: FloatArray, of_segments: NDArray[np.uint8]) -> None:
        segment = self._bones.segment
        self._bodies.batched_wxyzs = self._bones.turned(posture.q_wb).astype(np.float32)
        self._bodies.batched_positions = p_w[segment].astype(np.float32)
        colours = of_segments[segment]
        if not np.array_equal(colours, self._colours):
            self._bodies.batched_colors = self._colours = colours

    def _name_segments(self, p_w: FloatArray, q_wb: FloatArray, silent: Collection[str]) -> None:
        names = self._skeleton.segment_names
        named = {name for k, name in enumerate(n for n in names if n in silent) if k < MOST_NAMED}
        shown = [s for s, n in enumerate(names) if self.shows_names or n == self.marked or n in named]
        places = {s: p_w[s] + quaternion.rotate(q_wb[s], 0.5 * self._skeleton.tips[s]) for s in shown}
        heights = dict(zip(shown, apart([places[s][2] for s in shown], LABEL_M), strict=True))
        for s, label in enumerate(self._labels):
            is_visible = s in places
            # Each assignment is a message to every page, so what stays as it is is not assigned.
            if label.visible != is_visible:
                label.visible = is_visible
            if is_visible:
                text = segment_name(self.language, names[s])
                if names[s] in silent:
                    text = translated(self.language, "no_data_label", segment=text)
                if label.text != text:
                    label.text = text
                label.position = (*places[s][:2], heights[s])


LABEL_M = 0.07
"""Height of a name at the distance from which the body is usually seen."""


def apart(heights: Sequence[float], least: float) -> list[float]:
    """Return heights moved as little as possible, so that any two differ by ``least``; their order stays."""
    order = np.argsort(heights, kind="stable")
    groups: list[list[float]] = []  # middle, number: of names that stand close above each other
    for height in np.asarray(heights, np.float64)[order].tolist():
        groups.append([height, 1])
        # Two groups that touch move together, each by its weight, as the squares of all moves are to be
        # least.
        while len(groups) > 1 and _gap(groups[-2], groups[-1], least) < 0.0:
            (upper, n), (lower, m) = groups.pop(), groups.pop()
            groups.append([(upper * n + lower * m) / (n + m), n + m])
    moved = [middle + (k - 0.5 * (n - 1)) * least for middle, n in groups for k in range(int(n))]
    found = np.empty(len(moved))
    found[order] = moved
    placed: list[float] = found.tolist()
    return placed


def _gap(lower: list[float], upper: list[float], least: float) -> float:
    """Return the gap between two groups, beyond what they need."""
    return (upper[0] - lower[0]) - 0.5 * (lower[1] + upper[1]) * least


DISC_M = 0.16
"""Radius of the shade below a foot that stands."""
_SHADE_GONE_M = 0.25
_AROUND = 2.0 * np.pi * np.arange(16) / 16
_DISC_VERTICES = np.vstack([np.zeros(3), np.column_stack([np.cos(_AROUND), np.sin(_AROUND), 0.0 * _AROUND])])
_DISC_FACES = np.array([(0, 1 + k, 1 + (k + 1) % 16) for k in range(16)])


class Figure:
    """The mannequin, and a shade on the floor below each foot."""

    def __init__(self, server: viser.ViserServer, mannequin: Mannequin, root: str) -> None:
        self._parts = mannequin
        n, n_soles = len(mannequin.segment), len(mannequin.soles)
        level = np.array([1.0, 0.0, 0.0, 0.0])
        self._limbs = server.scene.add_batched_meshes_simple(
            f"{root}/mannequin",
            SPINDLE_VERTICES,
            SPINDLE_FACES,
            np.tile(level, (n, 1)),
            np.zeros((n, 3)),
            batched_scales=mannequin.half,
            material="toon5",  # without a graphics processor a picture costs a fifth less than lit as usual
            batched_colors=np.full((n, 3), 140, np.uint8),
            lod="off",
            cast_shadow=False,
            receive_shadow=False,
        )
        self._shades = server.scene.add_batched_meshes_simple(
            f"{root}/shades",
            _DISC_VERTICES,
            _DISC_FACES,
            np.tile(level, (n_soles, 1)),
            np.zeros((n_soles, 3)),
            batched_scales=np.full((n_soles, 3), DISC_M),
            batched_colors=np.zeros((n_soles, 3), np.uint8),
            opacity=0.35,
            lod="off",
            cast_shadow=False,
            receive_shadow=False,
        )
        self._is_face = np.array([side == "face" for side in mannequin.side])
        self._colours = np.zeros((0, 3), np.uint8)

    def remove(self) -> None:
        """Take it off the page."""
        self._limbs.remove()
        self._shades.remove()

    def on_click(self, clicked: Callable[[int], None]) -> None:
        """Call a listener with the segment of a limb that is clicked."""

        def of_limb(event: viser.SceneNodePointerEvent[Any]) -> None:
            if event.instance_index is not None:
                clicked(int(self._parts.segment[event.instance_index]))

        self._limbs.on_click(of_limb)

    def show(self, is_wanted: bool) -> None:
        """Show or hide the limbs; their shadows are always there."""
        if self._limbs.visible != is_wanted:
            self._limbs.visible = is_wanted

    def draw(self, posture: DrawnPose, p_w: FloatArray, of_segments: NDArray[np.uint8]) -> None:
        """Bring it to a posture. p_w: (s, 3) m, as drawn; of_segments: (s, 3) RGB."""
        parts = self._parts
        if self._limbs.visible:
            q_wb = posture.q_wb[parts.segment]
            pairs = list(zip(q_wb, parts.q_segment_from_part, parts.centre, strict=True))
            centres = p_w[parts.segment] + [quaternion.rotate(q, centre) for q, _, centre in pairs]
            turns = [quaternion.multiply(q, turn) for q, turn, _ in pairs]
            self._limbs.batched_wxyzs = np.array(turns, np.float32)
            self._limbs.batched_positions = centres.astype(np.float32)
            colours = of_segments[parts.segment]
            colours[self._is_face] = FACE
            if not np.array_equal(colours, self._colours):
                self._limbs.batched_colors = self._colours = colours
        self._draw_shades(posture, p_w)

    def _draw_shades(self, posture: DrawnPose, p_w: FloatArray) -> None:
        """Draw the shade of each foot on the floor, at zero: smaller as the foot is lifted."""
        soles = self._parts.soles
        ahead = [quaternion.rotate(posture.q_wb[s], np.array([0.06, 0.0, 0.0])) for s in soles]
        below = p_w[soles] + ahead
        standing = np.clip(1.0 - np.maximum(below[:, 2] - 0.1, 0.0) / _SHADE_GONE_M, 0.0, 1.0)
        # Just above the floor, or both would flicker through each other.
        below[:, 2] = 0.004
        self._shades.batched_positions = below.astype(np.float32)
        sizes = (0.3 + 0.7 * standing) * DISC_M
        self._shades.batched_scales = np.tile(sizes[:, None], (1, 3)).astype(np.float32)
