"""A published body on the page: its scene, its last known posture, and its muscles where they are wanted."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

import viser

from gateway.contract.messages import BodyMessage, PoseMessage
from gateway.outputs.subscriber import ReceivedPose
from gateway.viewer.muscle_wires import MuscleWires, muscle_wires
from gateway.viewer.posture import DrawnPose, PostureKeeper, skeleton_of
from gateway.viewer.scene import BodyScene
from gateway.viewer.stage import ViewerStage


class LiveBody:
    """Drawn in the neutral posture until the first pose comes."""

    def __init__(
        self,
        server: viser.ViserServer,
        stage: ViewerStage,
        message: BodyMessage,
        clicked: Callable[[str], None] | None,
    ) -> None:
        """Draw the body. clicked: called with a segment that is clicked upon."""
        self.message = message
        self.skeleton = skeleton_of(message)
        self.scene = BodyScene(server, stage, self.skeleton, clicked)
        self._server, self._stage = server, stage
        self._keeper = PostureKeeper(self.skeleton)
        self._wires: MuscleWires | None = None
        self.scene.draw(self._keeper.before_any(), is_stale=True)

    @property
    def has_muscles(self) -> bool:
        """Whether muscles are shown."""
        return self._wires is not None

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

    def take(self, pose: PoseMessage, undrawn: deque[ReceivedPose] | None = None) -> DrawnPose:
        """Return a pose as it is to be drawn.

        undrawn: poses that came since the last picture; those up to this one are taken out, and muscles get
        them: they are computed from accelerations, so that every pose counts.
        """
        while self._wires is not None and undrawn and undrawn[0].pose.t_ns <= pose.t_ns:
            earlier = undrawn.popleft().pose
            if earlier is not pose:
                posture = self._keeper.take(earlier)
                self._wires.add(earlier.t_ns * 1e-9, posture.q_wb, posture.place)
        return self._keeper.take(pose)

    def draw_muscles(self, posture: DrawnPose, time_s: float) -> None:
        """Draw the muscles, if there are any. time_s: instant of the pose."""
        if self._wires is not None:
            self._wires.draw(time_s, posture)
