"""A body on the page: its scene, its last known posture, and its muscles where they are wanted."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

import viser

from gateway.body.skeleton import Skeleton
from gateway.contract.messages import PoseMessage
from gateway.frames import FloatArray
from gateway.outputs.subscriber import ReceivedPose
from gateway.viewer.muscle_wires import MuscleWires, muscle_wires
from gateway.viewer.panel import Panel
from gateway.viewer.posture import DrawnPose, PostureKeeper
from gateway.viewer.scene import BodyScene
from gateway.viewer.stage import ViewerStage


class ShownBody:
    """The body that a page is about; others beside it have a scene alone."""

    def __init__(
        self,
        server: viser.ViserServer,
        stage: ViewerStage,
        skeleton: Skeleton,
        clicked: Callable[[str], None] | None = None,
    ) -> None:
        """Add the body, without muscles. clicked: called with a segment that is clicked upon."""
        self.skeleton = skeleton
        self.scene = BodyScene(server, stage, skeleton, clicked)
        self._server, self._stage = server, stage
        self._keeper = PostureKeeper(skeleton)
        self._wires: MuscleWires | None = None

    def draw_before_any(self) -> None:
        """Draw the neutral posture, for the time before the first pose."""
        self.scene.draw(self._keeper.before_any(), is_stale=True)

    def show_muscles(self, body_kg: float | None, language: str) -> None:
        """Show the muscles of a person of that mass; None: none.

        Raises ``GatewayError`` for a body without muscles, or without the extra for them.
        """
        self._wires = muscle_wires(self._server, self._stage, self.skeleton, body_kg)
        self.set_language(language)

    def set_language(self, language: str) -> None:
        """Say what the muscles' colours mean in that language from now on."""
        if self._wires is not None:
            self._wires.set_language(language)

    def remove(self) -> None:
        """Take the body off the page for good."""
        self.scene.remove()
        if self._wires is not None:
            self._wires.remove()

    def take_choices(self, panel: Panel) -> None:
        """Show of the body what is chosen on the panel."""
        self.scene.show_axes(panel.axes.value)
        self.scene.show_bones(panel.bones.value or self._wires is not None)
        self.scene.shows_names = panel.names.value
        self.scene.language = panel.language

    def take(self, pose: PoseMessage, undrawn: deque[ReceivedPose] | None = None) -> DrawnPose:
        """Return a pose as it is to be drawn.

        undrawn: poses that came since the last picture; those up to this one are taken out, and muscles get
        them: they are computed from accelerations, so that every pose counts.
        """
        while self._wires is not None and undrawn and undrawn[0].pose.t_ns <= pose.t_ns:
            earlier = undrawn.popleft().pose
            if earlier is not pose:
                posture = self._keeper.take(earlier)
                self.add_to_muscles(earlier.t_ns * 1e-9, posture.q_wb, posture.place)
        return self._keeper.take(pose)

    def add_to_muscles(self, time_s: float, q_wb: FloatArray, root: FloatArray) -> None:
        """Have muscles take a pose that is not drawn: q_wb (S, 4), root (3,) m, world."""
        if self._wires is not None:
            self._wires.add(time_s, q_wb, root)

    def bring_into_view(self, panel: Panel, posture: DrawnPose, time_s: float) -> None:
        """Bring the view to the body, if that is chosen on the panel. time_s: instant of the pose."""
        if panel.follow.value:
            self._stage.follow(posture.place, time_s)
        self._stage.face(posture.q_wb[0])

    def draw_muscles(self, posture: DrawnPose, time_s: float) -> None:
        """Draw the muscles, if there are any. time_s: instant of the pose."""
        if self._wires is not None:
            self._wires.draw(time_s, posture)
