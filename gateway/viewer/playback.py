"""A recording on the page, with a time line."""

from __future__ import annotations

import viser

from gateway.frames import Status
from gateway.recording import SkeletonArrays
from gateway.viewer.appearance import silent_segments, status_summary
from gateway.viewer.ghost import Ghost
from gateway.viewer.marker_points import FittedMarkers, MarkerScene, ReceivedMarkers
from gateway.viewer.module_table import recorded_rows, recorded_table
from gateway.viewer.muscle_wires import ENOUGH_S
from gateway.viewer.pace import pictures
from gateway.viewer.panel import ButtonRow, Panel
from gateway.viewer.replaying import RecordedPoses
from gateway.viewer.shown_body import ShownBody
from gateway.viewer.stage import ViewerStage
from gateway.viewer.texts import ENGLISH, translated
from gateway.viewer.trail import Trail

SPEEDS = ("0.1", "0.25", "0.5", "1", "2", "4")
TIME_LINE_STEP_S = 0.01


class Playback:
    """Plays a recorded result: play, pause, speed, and a time line that can be dragged."""

    def __init__(
        self,
        server: viser.ViserServer,
        arrays: SkeletonArrays,
        name: str,
        markers: FittedMarkers | ReceivedMarkers | None = None,
        muscles_kg: float | None = None,
        compared: SkeletonArrays | None = None,
    ) -> None:
        """Build the page of a recording.

        muscles_kg: mass of the person whose muscles are shown; None: no muscles.
        compared: another recording, shown as a pale body.

        Raises ``GatewayError`` if the two share no segment.
        """
        self._arrays = arrays
        self._times_s: list[float] = arrays.time_s.tolist()
        self._position_s = 0.0
        self._is_playing = True
        self._name = name
        # Segments without a module are predicted throughout: for them silence is no fault.
        measured = (arrays.status == Status.MEASURED).any(axis=0)
        self._worn = {segment for segment, was in zip(arrays.segment_names, measured, strict=True) if was}
        self._poses = RecordedPoses(arrays)
        self._stage = ViewerStage(server)
        self._body = ShownBody(server, self._stage, arrays.skeleton)
        self._body.show_muscles(muscles_kg, ENGLISH)

        self._panel = Panel(
            server, (ButtonRow("playback", ("play", "pause", "begin"), self._press),), self._stage
        )
        self._panel.name_root(arrays.segment_names[0])  # parents come first
        self._speed = server.gui.add_dropdown(translated(ENGLISH, "speed"), SPEEDS, initial_value="1")
        end_s = max(self._times_s[-1], TIME_LINE_STEP_S)
        self._line = server.gui.add_slider(translated(ENGLISH, "time"), 0.0, end_s, TIME_LINE_STEP_S, 0.0)
        self._trail = Trail(server, self._stage)
        self._ghost = None if compared is None else Ghost(server, self._stage, compared, arrays)

        self._line_shown_s = 0.0
        self._drawn = -1
        self._markers = markers
        self._marker_scene = None if markers is None else MarkerScene(server, self._stage)
        self._set_language(ENGLISH)
        self._panel.on_language(self._set_language)

    def _set_language(self, language: str) -> None:
        """Say everything in that language from now on."""
        rows = recorded_rows(self._arrays.segment_names, self._arrays.status, language)
        self._panel.show_modules(recorded_table(rows, language))
        self._speed.label, self._line.label = translated(language, "speed"), translated(language, "time")
        for each in (self._ghost, self._marker_scene, self._body):
            if each is not None:
                each.set_language(language)
        self._drawn = -1

    async def run(self) -> None:
        """Play for ever, again from the beginning at the end."""
        async for elapsed_s in pictures():
            self.advance(elapsed_s)

    def advance(self, elapsed_s: float) -> None:
        """Go on by so much real time, and draw."""
        if self._line.value != self._line_shown_s:  # somebody has dragged it
            self._position_s = float(self._line.value)
        elif self._is_playing:
            self._position_s += elapsed_s * float(self._speed.value)
            if self._position_s > self._times_s[-1]:
                self._position_s = 0.0
        self._take_choices()
        self._draw(self._poses.index_at(self._position_s))

    @property
    def position_s(self) -> float:
        """Where the playback is, s from the first frame."""
        return self._position_s

    def _draw(self, index: int) -> None:
        shown_s = round(self._position_s / TIME_LINE_STEP_S) * TIME_LINE_STEP_S
        # Every assignment is sent to all pages.
        if self._line.value != shown_s:
            self._move_line(shown_s)
        self._line_shown_s = self._line.value
        if index == self._drawn:
            return
        before, self._drawn = self._drawn, index

        pose = self._poses.pose(index)
        time_s, posture = self._times_s[index], self._body.take(pose)
        silent = silent_segments(pose.status, self._worn)
        self._body.bring_into_view(self._panel, posture, time_s)
        self._body.scene.draw(posture, is_stale=False, silent=silent)
        self._trail.draw(self._panel.trail.value, time_s, posture.place)
        if self._ghost is not None:
            self._ghost.draw(time_s, posture)
        self._add_undrawn(before, index)
        self._body.draw_muscles(posture, time_s)

        self._panel.add_pose(pose)
        language = self._panel.language
        seconds = f"{time_s:.2f}"
        where = translated(language, "frame_of", seconds=seconds, number=index + 1, count=len(self._times_s))
        lines = [where, status_summary(pose.status, silent, language)]
        if self._markers is not None and self._marker_scene is not None:
            instant = self._markers.at(index)
            self._marker_scene.draw(instant)
            lines += instant.summary(language)
            self._panel.add_markers(pose.t_ns, instant)
        self._panel.draw_plot()
        self._panel.show_status(self._name, *lines, is_alarm=False)

    def _add_undrawn(self, before: int, index: int) -> None:
        """Add poses that fell between two pictures: muscles need all of them."""
        for i in range(before + 1, index):
            # After a jump in time the poses between are no motion.
            if self._times_s[index] - self._times_s[i] <= ENOUGH_S:
                self._body.add_to_muscles(self._times_s[i], self._arrays.q_wb[i], self._arrays.p_w[i, 0])

    def _take_choices(self) -> None:
        self._stage.show_dark(not self._panel.light.value)
        self._body.take_choices(self._panel)

    def _press(self, what: str) -> None:
        self._is_playing = what != "pause"
        if what == "begin":
            self._move_line(0.0)

    def _move_line(self, position_s: float) -> None:
        # the library's property has a setter, which the type checker does not see
        self._line.value = position_s  # type: ignore[misc]
