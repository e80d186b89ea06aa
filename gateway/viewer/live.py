"""What a gateway publishes, on the page, as it comes."""

from __future__ import annotations

import asyncio
from collections import deque
from datetime import UTC, datetime

import viser

from devices.link import gateway_time_ns
from gateway.contract.messages import BodyMessage, MarkersMessage
from gateway.contract.topics import ANY_GATEWAY
from gateway.errors import GatewayError
from gateway.outputs.failover import BrokerUnreachableError
from gateway.outputs.settings import MqttSettings
from gateway.outputs.subscriber import PoseSubscriber, ReceivedPose
from gateway.recording import SkeletonArrays
from gateway.viewer.appearance import silent_segments, status_summary
from gateway.viewer.assistant import Assistant
from gateway.viewer.body_steps import BodySteps
from gateway.viewer.check_tab import CheckTab
from gateway.viewer.companions import Companions, people_of, room_of
from gateway.viewer.live_markers import LiveMarkers
from gateway.viewer.marker_points import MarkerInstant
from gateway.viewer.module_table import (
    RecentLosses,
    RecordingStatus,
    health_line,
    module_rows,
    module_table,
    warnings_of,
)
from gateway.viewer.pace import pictures
from gateway.viewer.page_requests import PageRequests
from gateway.viewer.panel import ButtonRow, Panel
from gateway.viewer.pose_table import STALE_AFTER_S, PoseView
from gateway.viewer.posture import skeleton_of
from gateway.viewer.replaying import ReplayedTake
from gateway.viewer.sensor_tab import SensorTab
from gateway.viewer.shown_body import ShownBody
from gateway.viewer.stage import ViewerStage
from gateway.viewer.takes import TakesTab
from gateway.viewer.trail import Trail

RETRY_S = 0.5
RECORDED_AFTER_S = 10.0
"""Older poses are recognised by their instant: they come from a recording."""
MOST_UNDRAWN = 256
"""Poses between two pictures that the muscles take."""
RESETS = ("heading", "full", "mounting", "position")
TEXTS_EVERY = 10
"""Texts and plots are brought up to date with one picture of so many."""


class LiveViewer:
    """Draws the latest pose thirty times a second; poses in between go into the plot and to muscles only."""

    def __init__(
        self,
        server: viser.ViserServer,
        settings: MqttSettings,
        gateway: str,
        muscles_kg: float | None = None,
        *,
        may_write: bool = True,
    ) -> None:
        """Build the page.

        muscles_kg: mass of the person whose muscles are shown; None: no muscles.
        may_write: False leaves out every button that asks something of the gateway, and refuses what a page
        sends.
        """
        self._muscles_kg = muscles_kg
        self._undrawn: deque[ReceivedPose] = deque(maxlen=MOST_UNDRAWN)
        self._server = server
        self._settings = settings
        self._gateway = gateway
        self._takes_any = gateway == ANY_GATEWAY
        self._room: str | None = None
        """Gateway before whose cameras people come and go, each with a name of their own; None: it is not
        known to be one, or any gateway will do."""
        self._loop = asyncio.get_running_loop()
        self._view = PoseView(gateway)
        self._latest: ReceivedPose | None = None
        self._drawn: ReceivedPose | None = None
        self._was_stale = False
        self._was_red: frozenset[str] = frozenset()

        self._message: BodyMessage | None = None
        self._body: ShownBody | None = None
        """None until the gateway has published it."""
        self._worn: frozenset[str] = frozenset()

        self._stage = ViewerStage(server)
        self._markers = LiveMarkers(server, self._stage)
        self._trail = Trail(server, self._stage)
        self._companions = Companions(server, self._stage)
        self._instant: MarkerInstant | None = None

        self._panel = Panel(server, self._buttons() if may_write else (), self._stage)
        self._panel.on_language(self._markers.set_language)
        self._panel.on_language(self._label_muscles)

        self._losses = RecentLosses()
        self._recording = RecordingStatus()
        self._requests = PageRequests(settings, self._panel, self._recording, lambda: self._gateway)
        self._replayed: ReplayedTake | None = None
        self._assistant: Assistant | None = None
        self._check: CheckTab | None = None
        self._body_steps: BodySteps | None = None
        if may_write:
            self._add_assistant(server)

    def _buttons(self) -> tuple[ButtonRow, ...]:
        """Return the buttons that ask something of the gateway."""
        return (
            ButtonRow(
                "recording", ("start", "stop", "mark"), lambda verb: self._requests.ask("recording", verb, {})
            ),
            ButtonRow("reset", RESETS, lambda kind: self._requests.ask("reset", kind, {})),
        )

    def _add_assistant(self, server: viser.ViserServer) -> None:
        """Add the tabs that lead from nothing to a recording, in the order of their steps."""
        tabs, ask = self._panel.tabs, self._requests.answer_of
        self._assistant = Assistant(server, tabs, ask, self._mark)
        sensors, body = SensorTab(server, tabs, ask), BodySteps(server, tabs, ask)
        self._check = CheckTab(server, tabs, ask, lambda: self._worn)
        takes = TakesTab(server, tabs, ask, self._replay)
        self._assistant.leads(sensors, body, self._check, takes)
        self._body_steps = body
        self._panel.on_language(self._assistant.set_language)

    async def run(self, waits: bool = False) -> None:
        """Show poses for ever.

        Raises ``BrokerUnreachableError`` without a broker at the start, unless ``waits``.
        """
        while True:
            try:
                await self._show()
            except BrokerUnreachableError as error:
                if not waits:
                    raise
                self._panel.show_status(self._panel.translated("no_broker"), str(error), is_alarm=True)
            await asyncio.sleep(RETRY_S)

    async def _show(self) -> None:
        listened = self._gateway if not self._takes_any else ANY_GATEWAY
        subscriber = PoseSubscriber(self._settings, listened, with_markers=True)
        async with subscriber as poses, asyncio.TaskGroup() as tasks:
            collecting = tasks.create_task(self._collect(poses), name="poses")
            await self._draw_until_people(poses)
            collecting.cancel()  # to listen to the people by their names

    async def _collect(self, poses: PoseSubscriber) -> None:
        async for received in poses:
            if self._room is not None and room_of(received.gateway) != self._room:
                continue
            is_gone = self._latest is not None and self._gateway not in poses.states
            if self._takes_any and (self._latest is None or is_gone):
                self._gateway = received.gateway  # the first that gives poses, until its person has left
            self._companions.add(received)
            if received.gateway == self._gateway:
                self._latest = received
                self._undrawn.append(received)
                self._view.add(received)
                self._markers.add(received)
                if self._check is not None:
                    self._check.add(received.pose)
                if self._replayed is None:
                    self._panel.add_pose(received.pose)

    async def _draw_until_people(self, poses: PoseSubscriber) -> None:
        """Draw; until the one gateway that is listened to turns out to follow people."""
        picture = 0
        async for _ in pictures():
            # Texts are renewed less often than the body, as each change of them goes to every page.
            if picture % TEXTS_EVERY == 0:
                self._take_choices()
                self._take_gateway(poses)
                if not self._takes_any and people_of(poses, self._gateway) is not None:
                    self._room, self._takes_any = self._gateway, True
                    return
                self._show_texts(poses)
            self._take_body(poses.bodies.get(self._gateway))
            self._draw(poses.markers.get(self._gateway))
            bodies = {} if self._replayed is not None else poses.bodies
            self._companions.draw(self._gateway, bodies, poses.markers)
            picture += 1

    def _take_gateway(self, poses: PoseSubscriber) -> None:
        """Choose a running gateway if any will do, even one without poses: it may be here to be set up."""
        if self._gateway == ANY_GATEWAY:
            running = [name for name, state in poses.states.items() if state == "online"]
            self._gateway = min(running, default=ANY_GATEWAY)

    def _take_body(self, message: BodyMessage | None) -> None:
        """Build the body anew if the gateway publishes another one."""
        if message is None or message == self._message:
            return
        if self._body is not None:
            self._body.remove()
        clicked = None if self._assistant is None else self._assistant.choose_segment
        self._body = body = ShownBody(self._server, self._stage, skeleton_of(message), clicked)
        self._message, self._drawn = message, None
        body.draw_before_any()
        self._panel.parents = {each.name: each.parent for each in message.segments if each.parent is not None}
        self._panel.name_root(next(each.name for each in message.segments if each.parent is None))
        if self._body_steps is not None:
            self._body_steps.look()
        # A body without muscles of its own still is worth showing: the page says why they are missing.
        try:
            body.show_muscles(self._muscles_kg, self._panel.language)
        except GatewayError as error:
            self._panel.show_answer(str(error))

    def _label_muscles(self, language: str) -> None:
        if self._body is not None:
            self._body.set_language(language)

    def _draw(self, markers: MarkersMessage | None) -> None:
        if self._replayed is not None:
            self._draw_replayed(self._replayed)
            return
        body = self._body
        if self._latest is None or body is None:
            return
        latest, instant = self._markers.pose_of(markers, self._latest)
        is_stale = self._is_stale()
        red = self._red()
        # Nothing new: sending the same picture again would cost every page that is open.
        if latest is self._drawn and is_stale == self._was_stale and red == self._was_red:
            return
        self._drawn, self._was_stale, self._was_red = latest, is_stale, red

        time_s = latest.pose.t_ns * 1e-9
        posture = body.take(latest.pose, self._undrawn)
        body.bring_into_view(self._panel, posture, time_s)
        body.scene.draw(posture, is_stale, self._silent(), red)
        self._trail.draw(self._panel.trail.value, time_s, posture.place)
        body.draw_muscles(posture, time_s)
        self._markers.draw(instant)
        self._instant = instant
        if instant is not None:
            self._panel.add_markers(latest.pose.t_ns, instant)

    def _red(self) -> frozenset[str]:
        """Return the segments that did not follow in the check."""
        return frozenset() if self._check is None else self._check.red

    def _replay(self, arrays: SkeletonArrays | None, name: str) -> None:
        """Play a recording in place of what comes; None: what comes again. Raises ``GatewayError``."""
        shown = None if self._body is None else self._body.skeleton
        self._replayed = None if arrays is None else ReplayedTake(arrays, name, shown, self._panel.language)
        self._drawn = None

    def _draw_replayed(self, take: ReplayedTake) -> None:
        if self._body is None:
            return
        now_s = self._loop.time()
        pose = take.at(now_s)
        posture = self._body.take(pose)
        self._body.bring_into_view(self._panel, posture, now_s)
        self._body.scene.draw(posture, is_stale=False)
        self._panel.add_pose(pose)

    def _take_choices(self) -> None:
        self._stage.show_dark(not self._panel.light.value)
        if self._body is not None:
            self._body.take_choices(self._panel)

    def _show_texts(self, poses: PoseSubscriber) -> None:
        health = poses.healths.get(self._gateway)
        self._losses.add(health)
        self._show_headline(poses)
        age = self._view.age_s(gateway_time_ns())
        # Warnings are about the pose that is shown, and an old one is marked as such already.
        comes = age is not None and age <= STALE_AFTER_S and poses.is_connected
        self._panel.show_warnings(self._warnings() if comes else ())
        if health is not None:
            self._recording.take(health.statistics.get("recording"), health.t_ns)
        self._panel.show_recording(self._recording.now(gateway_time_ns()))
        info = poses.infos.get(self._gateway)
        self._worn = frozenset() if info is None else frozenset(module.segment for module in info.modules)
        language = self._panel.language
        rows = module_rows(health, info, self._silent(), language)
        self._panel.show_modules(module_table(rows, language))
        self._panel.draw_plot()

    def _show_headline(self, poses: PoseSubscriber) -> None:
        """Show what comes, or why nothing comes."""
        panel, translated, now_ns = self._panel, self._panel.translated, gateway_time_ns()
        name = self._name(poses)
        age = self._view.age_s(now_ns)
        comes = age is not None and age <= STALE_AFTER_S
        info = poses.infos.get(self._gateway)
        awaited = None if info is None or info.kernels is None else info.kernels.awaited

        is_compiling = awaited is not None and poses.states.get(self._gateway) == "online"
        # In order of importance: of several causes, the first is the one to act on.
        if self._replayed is not None:
            position = self._replayed.text(self._loop.time(), panel.language)
            panel.show_status(translated("replay_of", name=self._replayed.name), position, is_alarm=False)
        elif not poses.is_connected:
            panel.show_status(translated("no_broker"), translated("gets_it_back"), is_alarm=True)
        elif is_compiling:
            lines = self._pose_texts() if comes else ()
            panel.show_status(
                name, translated("compiling", name=awaited), *lines, is_alarm=False, is_busy=True
            )
        elif not comes and people_of(poses, self._gateway) == []:
            panel.show_status(name, translated("nobody"), is_alarm=False)
        elif age is None:
            begin = () if self._assistant is None else (translated("begin_here", tab=translated("tab")),)
            panel.show_status(translated("no_data"), translated("no_pose", name=name), *begin, is_alarm=True)
        elif age > STALE_AFTER_S:
            headline = translated("no_data_for", seconds=f"{age:.0f}")
            panel.show_status(headline, translated("last_pose", name=name), is_alarm=True)
        else:
            panel.show_status(name, *self._pose_texts(), is_alarm=False)

    def _name(self, poses: PoseSubscriber) -> str:
        """Return the gateway's name, and whether it runs."""
        if self._gateway == ANY_GATEWAY:
            return self._panel.translated("no_gateway")
        state = poses.states.get(self._gateway, "unknown")
        known = state in ("online", "offline", "unknown")
        return f"{self._gateway}: {self._panel.translated(f'state_{state}') if known else state}"

    def _pose_texts(self) -> tuple[str, ...]:
        """Return lines about poses that come."""
        latest = self._latest
        rate, latency = self._view.rate_hz or 0.0, self._view.latency_s or 0.0
        translated, language = self._panel.translated, self._panel.language
        when = (
            translated("latency", ms=f"{latency * 1e3:.1f}")
            if latency < RECORDED_AFTER_S
            else translated("taken", when=_instant(latest))
        )
        pace = translated("pace", rate=f"{rate:.0f}", when=when)
        if latest is None:
            return (pace,)
        markers = () if self._instant is None else self._instant.summary(language)
        statuses = latest.pose.status
        # beside a warning the good word would be what is read
        is_good = all(status == "measured" for status in statuses.values())
        summary = status_summary(statuses, self._silent(), language)
        summaries = () if self._warnings() and is_good else (summary,)
        status = self._recording.now(gateway_time_ns())
        stands = health_line(len(self._worn), len(self._silent()), self._losses.share, status, language)
        return (pace, *summaries, stands, *markers)

    def _warnings(self) -> tuple[str, ...]:
        """Return what is wrong with poses that come."""
        latency_s = self._view.latency_s or 0.0
        # A pose of a recording is old by days: that is no latency.
        late = latency_s if latency_s < RECORDED_AFTER_S else 0.0
        status = self._recording.now(gateway_time_ns())
        return warnings_of(self._losses.share, late, status, self._panel.language)

    def _silent(self) -> tuple[str, ...]:
        return () if self._latest is None else silent_segments(self._latest.pose.status, self._worn)

    def _is_stale(self) -> bool:
        age = self._view.age_s(gateway_time_ns())
        return age is not None and age > STALE_AFTER_S

    def _mark(self, segment: str) -> None:
        if self._body is not None:
            self._body.scene.marked = segment


def _instant(received: ReceivedPose | None) -> str:
    """Return when a pose was taken, as text."""
    if received is None:
        return ""
    taken = datetime.fromtimestamp(received.pose.t_ns * 1e-9, UTC)
    return f"{taken:%Y-%m-%d %H:%M:%S}"
