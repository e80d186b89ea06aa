"""A second body beside the one that is shown, pale: another recording, or another method on the same one."""

from __future__ import annotations

import numpy as np
import viser

from gateway.body.bones import BONE_FACES, BONE_VERTICES, bones_of
from gateway.errors import GatewayError
from gateway.recording import SkeletonArrays
from gateway.viewer.posture import DrawnPose, PostureKeeper
from gateway.viewer.replaying import RecordedPoses
from gateway.viewer.stage import ViewerStage
from gateway.viewer.texts import ENGLISH, translated

COLOUR = (120, 170, 235)
OPACITY = 0.45


class Ghost:
    """The bones of a recording, at the instants of the one that it is compared with."""

    def __init__(
        self, server: viser.ViserServer, stage: ViewerStage, arrays: SkeletonArrays, of: SkeletonArrays
    ) -> None:
        """Add a body beside ``of``, the recording on the page.

        Raises ``GatewayError`` if they share no segment.
        """
        names, others = arrays.skeleton.segment_names, of.skeleton.segment_names
        if not set(names) & set(others):
            raise GatewayError(
                f"nothing to compare: the one body has the segments {', '.join(names)}, the other "
                f"{', '.join(others)}"
            )

        self._stage, self._poses = stage, RecordedPoses(arrays)
        self._keeper = PostureKeeper(arrays.skeleton)
        self._later_s = later_s(arrays, of)
        self._bones = bones = bones_of(arrays.skeleton)
        n = len(bones.segment)
        self._bodies = server.scene.add_batched_meshes_simple(
            "/ghost",
            BONE_VERTICES,
            BONE_FACES,
            np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)),
            np.zeros((n, 3)),
            batched_scales=bones.scale,
            batched_colors=np.tile(np.array(COLOUR, np.uint8), (n, 1)),
            opacity=OPACITY,
            flat_shading=True,
            lod="off",
            cast_shadow=False,
            receive_shadow=False,
        )
        self._is_wanted = server.gui.add_checkbox(translated(ENGLISH, "compared"), initial_value=True)
        self._is_apart = server.gui.add_checkbox(translated(ENGLISH, "compared_apart"), initial_value=False)

    def set_language(self, language: str) -> None:
        """Say everything in that language from now on."""
        self._is_wanted.label = translated(language, "compared")
        self._is_apart.label = translated(language, "compared_apart")

    def draw(self, time_s: float, beside: DrawnPose) -> None:
        """Show it at a time of the recording on the page, s; hidden where its own recording has nothing.

        It stands where ``beside`` does, unless its own place is wanted: two walks that were added up from
        steps are soon apart, and then no posture can be compared.
        """
        has = self._poses.times_s[0] <= time_s - self._later_s <= self._poses.times_s[-1]
        is_visible = has and self._is_wanted.value
        if self._bodies.visible != is_visible:
            self._bodies.visible = is_visible
        if not is_visible:
            return

        posture = self._keeper.take(self._poses.pose(self._poses.index_at(time_s - self._later_s)))
        p_w = posture.p_w - self._stage.middle
        # Only where both places are known can the distance between the bodies mean anything.
        if not (self._is_apart.value and posture.is_placed and beside.is_placed):
            p_w = p_w + beside.place - posture.place
        self._bodies.batched_wxyzs = self._bones.turned(posture.q_wb).astype(np.float32)
        self._bodies.batched_positions = p_w[self._bones.segment].astype(np.float32)


def later_s(arrays: SkeletonArrays, of: SkeletonArrays) -> float:
    """Return by how much a recording began after another one, s.

    It is 0 where the two were not made at the same time: then both are shown from their beginnings.
    """
    first, last = int(arrays.time_ns[0]), int(arrays.time_ns[-1])
    if last < int(of.time_ns[0]) or first > int(of.time_ns[-1]):
        return 0.0
    return (first - int(of.time_ns[0])) * 1e-9
