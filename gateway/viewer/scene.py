"""The body on the page: bones, axes, and names of segments, of silent ones always."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
import viser

from gateway.body.bones import BONE_FACES, BONE_VERTICES, bones_of
from gateway.body.skeleton import Skeleton
from gateway.frames import FloatArray
from gateway.geometry import quaternion
from gateway.viewer.appearance import segment_colours
from gateway.viewer.posture import Posture
from gateway.viewer.stage import Stage

AXES_LENGTH_M = 0.09
_BODY = "/body"


class BodyScene:
    """One body in the scene of a viser server; made anew when the body changes."""

    def __init__(self, server: viser.ViserServer, stage: Stage, skeleton: Skeleton) -> None:
        self._server = server
        self._stage = stage
        self._skeleton = skeleton
        self._bones = bones = bones_of(skeleton)
        n, n_bones = skeleton.n_segments, len(bones.segment)
        identity, origin = np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(3)
        scene = server.scene
        self._bodies = scene.add_batched_meshes_simple(
            f"{_BODY}/bones",
            BONE_VERTICES,
            BONE_FACES,
            np.tile(identity, (n_bones, 1)),
            np.tile(origin, (n_bones, 1)),
            batched_scales=bones.scale,
            batched_colors=np.full((n_bones, 3), 140, np.uint8),
            flat_shading=True,
            lod="off",
            cast_shadow=False,
            receive_shadow=False,
        )
        self._axes = scene.add_batched_axes(
            f"{_BODY}/axes",
            np.tile(identity, (n, 1)),
            np.tile(origin, (n, 1)),
            axes_length=AXES_LENGTH_M,
            axes_radius=0.004,
            visible=False,
        )
        self._labels = [
            scene.add_label(f"{_BODY}/names/{name}", name, visible=False, anchor="bottom-left")
            for name in skeleton.segment_names
        ]
        self._colours = np.zeros((0, 3), np.uint8)
        self.shows_names = False

    def remove(self) -> None:
        """Take the body off the page."""
        for node in (self._bodies, self._axes, *self._labels):
            node.remove()

    def show_axes(self, is_wanted: bool) -> None:
        """Segment axes, or none."""
        self._axes.visible = is_wanted

    def draw(self, posture: Posture, is_stale: bool, silent: Collection[str] = ()) -> None:
        """Bring the page to a posture; the silent segments are named."""
        segment, p_w = self._bones.segment, posture.p_w - self._stage.middle
        wxyz = [
            quaternion.multiply(posture.q_wb[s], q)
            for s, q in zip(segment, self._bones.q_segment_from_bone, strict=True)
        ]
        colours = segment_colours(posture.status, posture.sigma_rad, is_stale)[segment]
        with self._server.atomic():
            self._bodies.batched_wxyzs = np.array(wxyz, np.float32)
            self._bodies.batched_positions = p_w[segment].astype(np.float32)
            if not np.array_equal(colours, self._colours):
                self._bodies.batched_colors = self._colours = colours
            if self._axes.visible:
                self._axes.batched_wxyzs = posture.q_wb.astype(np.float32)
                self._axes.batched_positions = p_w.astype(np.float32)
            self._name_segments(p_w, posture.q_wb, silent)

    def _name_segments(self, p_w: FloatArray, q_wb: FloatArray, silent: Collection[str]) -> None:
        for s, label in enumerate(self._labels):
            name = self._skeleton.segment_names[s]
            text = f"{name}: no data" if name in silent else name
            is_visible = self.shows_names or name in silent
            if label.visible != is_visible:
                label.visible = is_visible
            if is_visible:
                if label.text != text:
                    label.text = text
                label.position = p_w[s] + quaternion.rotate(q_wb[s], 0.5 * self._skeleton.tips[s])
