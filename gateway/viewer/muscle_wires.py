"""Muscles on the page: wires coloured by activity, a few times a second, where they are wished for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import viser
from numpy.typing import NDArray

from gateway.analysis.body_model import require_biomech
from gateway.analysis.live import SPAN_S, LiveMuscles
from gateway.body.body_file import load_body
from gateway.body.skeleton import Skeleton
from gateway.errors import GatewayError
from gateway.frames import FloatArray
from gateway.viewer.appearance import chips
from gateway.viewer.posture import DrawnPose
from gateway.viewer.stage import ViewerStage
from gateway.viewer.step_tab import line
from gateway.viewer.texts import ENGLISH, translated

EVERY_S = 0.1
ENOUGH_S = SPAN_S + 0.1
"""Of poses, for a drawing after a jump."""
_BODIES = ("human_17", "human_23")
"""Whose joints a published body has, which is published without them."""
_STOPS = np.array([[165, 185, 205], [245, 190, 60], [215, 40, 40]], dtype=np.float64)
"""Colours of activity 0, 0.5 and 1, as they are to look."""
_GAMMA = 2.2
"""The page takes a line's colours as amounts of light: taken as they are they would be washed out."""


class MuscleWires:
    """The muscles of one body."""

    def __init__(
        self, server: viser.ViserServer, stage: ViewerStage, skeleton: Skeleton, body_kg: float
    ) -> None:
        """Show a body's muscles. Raises ``GatewayError`` if it has none, or without the extra ``biomech``."""
        require_biomech()
        self._server, self._stage = server, stage
        self._root = int(np.flatnonzero(skeleton.parents < 0)[0])
        self._muscles = LiveMuscles(_with_joints(skeleton), body_kg)
        self._lines: viser.LineSegmentsHandle | None = None
        self._due_s = -np.inf
        self._activity: FloatArray | None = None
        self._is_placed, self._language = True, ENGLISH
        self._legend = server.gui.add_html(_legend(ENGLISH, is_placed=True))

    def set_language(self, language: str) -> None:
        """Say what their colours mean in that language from now on."""
        self._language = language
        self._legend.content = _legend(language, self._is_placed)

    def remove(self) -> None:
        """Take them off the page for good."""
        self._clear()
        self._legend.remove()

    def _clear(self) -> None:
        if self._lines is not None:
            self._lines.remove()
            self._lines = None

    def add(self, time_s: float, q_wb: FloatArray, root: FloatArray) -> None:
        """Add a pose that is not drawn: q_wb (S, 4), root (3,) m; one with unknown segments is left out."""
        if np.isfinite(q_wb).all() and np.isfinite(root).all():
            self._muscles.add(time_s, q_wb, root)

    def draw(self, time_s: float, posture: DrawnPose) -> None:
        """Draw the wires on a posture, and renew their activities ten times in a second of its time."""
        place = posture.p_w[self._root]
        if posture.is_placed != self._is_placed:
            self._is_placed = posture.is_placed
            self._legend.content = _legend(self._language, self._is_placed)
        self.add(time_s, posture.q_wb, place)
        # Time may jump backwards, when a recording is shown from its beginning again.
        if not 0.0 <= self._due_s - time_s < EVERY_S:
            self._due_s = time_s + EVERY_S
            found = self._muscles.now()
            self._activity = None if found is None else found.activity
        if self._activity is None:
            self._clear()
            return
        paths = self._muscles.wires(posture.q_wb, place)
        self._show(*segments_of(self._activity, paths, self._stage.middle))

    def _show(self, points: NDArray[np.float32], colours: NDArray[np.uint8]) -> None:
        """Show wires around the stage's middle; the node itself stays, as moving it would lag behind the
        body.
        """
        if self._lines is not None and self._lines.points.shape == points.shape:
            with self._server.atomic():
                self._lines.points, self._lines.colors = points, colours
            return
        self._clear()  # a wire that begins to slide over a bone has more parts than before
        self._lines = self._server.scene.add_line_segments("/body/muscles", points, colours, thickness=0.007)


def muscle_wires(
    server: viser.ViserServer, stage: ViewerStage, skeleton: Skeleton, body_kg: float | None
) -> MuscleWires | None:
    """Return the wires of a body, or None where none are asked for. Raises ``GatewayError`` as they do."""
    return None if body_kg is None else MuscleWires(server, stage, skeleton, body_kg)


def segments_of(
    activity: FloatArray, paths: Sequence[FloatArray], origin: FloatArray
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Return ends (n, 2, 3), m from ``origin``, and colours (n, 2, 3) of the straight parts of all wires."""
    parts = [np.stack([path[:-1], path[1:]], axis=1) for path in paths]
    counts = [len(part) for part in parts]
    looks = np.stack([np.interp(activity, (0.0, 0.5, 1.0), stops) for stops in _STOPS.T], axis=1)
    of_wires = (255.0 * (looks / 255.0) ** _GAMMA).astype(np.uint8)
    colours = np.repeat(np.repeat(of_wires, counts, axis=0)[:, None], 2, axis=1)
    return (np.concatenate(parts) - origin).astype(np.float32), colours


def _legend(language: str, is_placed: bool) -> str:
    """Return what the wires' colours mean, and what is missing, as HTML."""
    names = ("muscle_idle", "muscle_half", "muscle_full")
    meanings = [
        (translated(language, name), (int(stop[0]), int(stop[1]), int(stop[2])))
        for name, stop in zip(names, _STOPS, strict=True)
    ]
    return chips(meanings) + ("" if is_placed else line(translated(language, "muscles_not_placed")))


def _with_joints(skeleton: Skeleton) -> Skeleton:
    """Return a published body, which has no joints, with those of the shipped body of the same segments."""
    if skeleton.joints:
        return skeleton
    for name in _BODIES:
        body = load_body(name)
        if body.segment_names == skeleton.segment_names:
            return replace(skeleton, joints=body.joints, neutral=body.neutral)
    raise GatewayError(
        f"body '{skeleton.name}' shows no muscles live: only those with the segments of "
        f"{' or '.join(_BODIES)} do"
    )
