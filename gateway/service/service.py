"""The running gateway: links before the pipeline, outputs after it, everything in one event loop."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import logging
from collections.abc import Callable, Coroutine, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeGuard, TypeVar

from devices.commands.command_client import CommandClient
from devices.link import (
    SUIT,
    Chunk,
    InputEvent,
    Link,
    LinkError,
    SentChunk,
)
from devices.links.link_counts import LinkCounts
from devices.links.reconnect import LinkState, LinkStatus, ReconnectingLink
from devices.replay_link import contents_of, is_recording
from gateway.body.skeleton import WornSuit
from gateway.calibration.control import CalibrationControl, ResetControl
from gateway.calibration.kept_rig import KeptRig
from gateway.calibration.sensor_control import SensorControl
from gateway.contract.balances import Balance
from gateway.contract.messages import BridgeInfo
from gateway.errors import GatewayError
from gateway.frames import HeatMapFrame, SkeletonFrame
from gateway.modules.journal import Journal, default_journal_path
from gateway.modules.makers import MakersModules
from gateway.modules.module_log import ModuleLog, UnknownModules
from gateway.modules.operations import ModuleOperations
from gateway.modules.session import connect_client
from gateway.outputs.connection import first_to_end
from gateway.outputs.mqtt import MqttOutput
from gateway.outputs.output import Output
from gateway.outputs.requests import RequestResponder, in_turn
from gateway.outputs.side_outputs import SideOutputs
from gateway.pipeline import CALIBRATED_EVENT, INPUT_EVENTS, Pipeline, PreparedSuit
from gateway.reconstruction.video.reconstructor import VideoReconstructor
from gateway.recording.control import RecordingControl
from gateway.recording.shelf import Shelf
from gateway.service.accounting import balances_of
from gateway.service.further_bodies import FurtherBody, HandedLink, at_broker
from gateway.service.host_sender import HostSender
from gateway.service.observability import LogReport, Observer
from gateway.service.overload import LoadWatch, Shedding
from gateway.service.own_requests import OwnRequests
from gateway.service.parts import bridge_info, links_of, periodic_senders, unworn_modules
from gateway.service.people import CARRIES, OrdersToCameras, PeopleBeforeCameras
from gateway.settings import GatewaySettings, fitting_suit
from gateway.sources.registry import source_kind
from gateway.sources.statistics import Cause
from gateway.stages.cameras import CameraStage
from gateway.support.memory import bound_memory, give_back
from gateway.support.supervision import kept_running

log = logging.getLogger(__name__)

T = TypeVar("T")
_POSES_A_TURN = 8
"""Of a link that is never empty; then the event loop has its turn."""
_LAST_POSES_S = 0.1
"""After the last chunk, for further people's poses to go out."""
_LOGGED_FAILURES = frozenset(10**power for power in range(7))
"""The first, the tenth … one is logged."""


async def _open(link: Link) -> None:
    """Open a link. Raises ``GatewayError`` for a recording that is not there; other links wait for theirs."""
    try:
        await link.open()
    except LinkError as error:
        raise GatewayError(f"link '{link.name}': {error}") from error


class Service:
    """Runs until cancelled, or until every link has come to its end (recordings do)."""

    def __init__(
        self,
        settings: GatewaySettings,
        suit: WornSuit,
        links: Sequence[Link] | None = None,
        awaited: str | None = None,
        others: Sequence[FurtherBody] = (),
        config: Path | None = None,
    ) -> None:
        """Build every part of the gateway; nothing is opened and no task is started.

        links: in place of those of the settings.
        awaited: the method that is being compiled meanwhile, and takes over when it is ready.
        others: further people whose markers come by the same links.
        config: the file that the settings come from.
        """
        settings = fitting_suit(settings, suit)
        self.settings, self.others = settings, others
        self.begun = asyncio.Event()
        """Whether all that could keep it from running is open."""
        self.is_ending = False
        """Whether it closes what is open, by itself or since it was cancelled."""
        self.failed_chunks = 0
        """Chunks that a defect of ours kept from being handled."""
        self._ingesting: list[asyncio.Task[None]] = []

        self._build_inputs(suit, links)
        self._build_outputs(suit, bridge_info(settings, suit, awaited))
        self._build_requests(KeptRig(settings.rig, config), self._build_commands(suit))

    def _build_inputs(self, suit: WornSuit, links: Sequence[Link] | None) -> None:
        """Build the links, the pipeline behind them, and what records both."""
        settings = self.settings
        self._handed: dict[str, list[HandedLink]] = {}
        self.links = (
            links if links is not None else links_of(settings, self._note_link, lambda: self.mqtt.port)
        )
        self.pipeline = Pipeline.from_settings(settings, suit)
        self._carries = {link.name: link.carries for link in settings.links}
        contents = {name: of for link in self.links for name, of in self._contents_of(link).items()}
        for name, content in contents.items():
            self.pipeline.expect(name, content)

        self.recording = RecordingControl(
            settings, suit, contents, self.pipeline.statistics, self.pipeline.modules.restarts
        )
        self._records_at_start = settings.recording.at_start

        self._orders = OrdersToCameras([link for link in self.links if self._has_cameras(link)])
        self.people: PeopleBeforeCameras | None = None
        """Several, who come and go before cameras."""
        if settings.people is not None:
            self.people = PeopleBeforeCameras(settings, suit, _person_service, self._orders.send)

    def _build_outputs(self, suit: WornSuit, info: BridgeInfo) -> None:
        """Build what poses go to, and what watches how the gateway fares."""
        settings = self.settings
        self.side = self._side_outputs(suit)
        self.mqtt = MqttOutput(
            settings.mqtt,
            suit.skeleton,
            info,
            self.statistics,
            lambda: self.side.counters,
            suit.marker_labels,
        )
        self._outputs: tuple[Output, ...] = (self.mqtt, self.side)

        self.load = LoadWatch()
        self.shedding = Shedding(
            self.load, self.mqtt, self.side, self._apply_event, lambda: self._link_counts
        )
        self.observer = Observer(
            settings,
            suit,
            info,
            self.pipeline,
            links=self.links,
            mqtt=self.mqtt,
            side=self.side,
            balances=self.balances,
            load=self.load,
            not_recorded=lambda: self.recording.failure,
        )

    def _build_commands(self, suit: WornSuit) -> ModuleOperations:
        """Build what is sent to modules: commands, requests for time, triggers. Return the operations."""
        settings, stream = self.settings, self.pipeline.stream
        commanded = [link for link in self.links if self._takes_commands(link)]
        self.commands = CommandClient(commanded, allow_writes=settings.allow_device_writes)
        self.commands.on_sent = self._note_sent
        connect_client(self.commands, stream)
        ModuleLog().listen_to(stream)
        unknown = UnknownModules(stream, suit, unworn_modules(settings))
        self._report = LogReport(self.pipeline, self.mqtt, unknown)
        self._makers = MakersModules(self._note_sent)
        sender = HostSender(self._note_sent, senders=stream.senders)
        self._announced: list[Link] = []  # to the pipeline, and with devices that take commands
        self._periodic_senders = list(periodic_senders(settings, self._announced, sender, stream))
        return ModuleOperations(stream, self.commands, suit, Journal(default_journal_path()), self._makers)

    def _build_requests(self, rig: KeptRig, operations: ModuleOperations) -> None:
        """Build what answers requests over MQTT."""
        self.own_requests = OwnRequests(self.mqtt)
        self.calibration = CalibrationControl(
            self.pipeline, rig, self._calibrated, lambda: self.own_requests.perform("reload", {})
        )
        self.shelf = Shelf(self.settings.recording, lambda: self.recording.file)
        self.requests = self._responder(operations, rig)

    def _side_outputs(self, suit: WornSuit) -> SideOutputs:
        """Return the outputs beside MQTT."""
        settings = self.settings
        return SideOutputs(
            settings.outputs,
            suit.skeleton,
            settings.gateway,
            settings.assembly.rate_hz,
            self._least_charge,
            lambda topic, payload: self.mqtt.publish_beside(topic, payload),  # noqa: PLW0108 - made later
        )

    def _responder(self, operations: ModuleOperations, rig: KeptRig) -> RequestResponder:
        """Return what answers requests over MQTT, family by family.

        Families that change one thing (a recording, a calibration) take their requests in turn.
        """
        sensors = SensorControl(
            lambda: self.pipeline.suit, rig, self.pipeline.stream, self._makers, operations
        )
        families = {
            "gateway": self.own_requests.perform,
            "modules": operations.perform,
            "recording": self.shelf.beside(in_turn(self.recording.perform)),
            "calibration": in_turn(self.calibration.perform),
            "sensors": in_turn(sensors.perform),
            "reset": in_turn(ResetControl(self._apply_event).perform),
        }
        return RequestResponder(self.settings.mqtt, self.settings.gateway, families)

    @property
    def can_flow(self) -> bool:
        """Whether every link is read and the MQTT output works: what the watchdog asks."""
        return (
            bool(self._ingesting)
            and not any(task.done() for task in self._ingesting)
            and self.mqtt.is_running
        )

    def balances(self) -> list[Balance]:
        """Return where every sample, pose and chunk went (see ``gateway.service.accounting``)."""
        outputs = {"mqtt": self.mqtt.counters, **self.side.counters}
        return balances_of(self.pipeline, outputs, self.recording.balance, self._link_counts)

    @property
    def _link_counts(self) -> dict[str, LinkCounts]:
        return {link.name: link.counts for link in self.links if isinstance(link, ReconnectingLink)}

    def statistics(self) -> dict[str, object]:
        """Return counters for the health message."""
        accounting = {balance.name: balance.summary() for balance in self.balances()}
        return {
            **{
                section: values
                for sender in self._periodic_senders
                for section, values in sender.statistics().items()
            },
            **self.pipeline.statistics(),
            "accounting": accounting,
            "links": {name: counts.summary() for name, counts in self._link_counts.items()},
            "senders": self.pipeline.stream.sender_statistics(),
            "failed_chunks": self.failed_chunks,
            "recording": self.recording.status(),
            "load": self.load.statistics(),
            **({} if self.people is None else self.people.statistics()),
            "requests": self.requests.statistics(),
        }

    async def prepare(self, former: Service) -> None:
        """Bind, open and check what can fail, while ``former`` still runs, which this one is to follow.

        Ports that both want are taken when the former has ended. Raises ``GatewayError`` with what stands
        against it, and then holds nothing.
        """
        try:
            if self._records_at_start:
                self.recording.check()
            for link in self.links:
                if not isinstance(link, ReconnectingLink):  # others are tried until they are there
                    await link.open()
                    await link.close()
            metrics, held = self.observer.metrics, former.observer.metrics
            if metrics is not None and (held is None or metrics.port != held.port):
                metrics.bind()
            await self.side.open()
            await self.mqtt.prepare(former.mqtt)
            self.requests.follow(former.requests)
        except BaseException as error:
            await self.release(former)
            if isinstance(error, LinkError):
                raise GatewayError(str(error)) from error
            raise

    async def release(self, former: Service) -> None:
        """Give back what ``prepare`` took, of a service that is not to run after all."""
        if self.observer.metrics is not None:
            self.observer.metrics.release()
        await self.side.close()
        await self.mqtt.release(former.mqtt)
        self.requests.release(former.requests)

    async def run(self) -> None:
        """Open everything, and pass on what comes.

        Raises ``OutputError`` if an output cannot start, ``RecordingError`` if what it is to record cannot be
        written, ``GatewayError`` if a recording that it is to read is not there.
        """
        bound_memory()
        async with self.mqtt, self.side.running(), self.observer.watching():
            if self._records_at_start:
                self.recording.start()
            self.begun.set()
            if self.people is not None:
                self.people.broker_port = self.mqtt.port
            self.requests.start(self.mqtt.port)
            # Each is restarted should it fail: a broken report must not end the poses.
            companions = [
                asyncio.create_task(kept_running("the report", self._report.log_for_ever), name="report"),
                asyncio.create_task(kept_running("the load", self.shedding.watch), name="load"),
                asyncio.create_task(kept_running("giving memory back", give_back), name="memory"),
                asyncio.create_task(kept_running("the talk with modules", self._makers.talk), name="talk"),
            ]
            if self.settings.recording.when_cut_off:
                watch = functools.partial(self.recording.record_while, lambda: not self.mqtt.is_connected)
                companions.append(
                    asyncio.create_task(kept_running("the recorder's watch", watch), name="cut off")
                )
            companions += [
                asyncio.create_task(kept_running(f"the {sender.name}", sender.run), name=sender.name)
                for sender in self._periodic_senders
            ]
            others = [
                asyncio.create_task(_run_beside(other), name=other.settings.gateway)
                for other in self._other_services()
            ]

            try:
                await first_to_end(self._ingest_all(), self.mqtt.until_name_is_taken())
                await self._until_others_are_done()
            finally:
                self.is_ending = True
                # First what may still use the outputs, or begin a recording, then the recording, so that its
                # last event is the end.
                for companion in (*companions, *others):
                    companion.cancel()
                await asyncio.gather(*others, return_exceptions=True)
                if self.people is not None:
                    await self.people.close()
                await self.requests.stop()
                await self.recording.stop()

    def _other_services(self) -> list[Service]:
        """Return the services of further people, fed by the links of this one."""
        services = []
        for settings, suit in self.others:
            links = [HandedLink(link.name) for link in settings.links]
            for link in links:
                self._handed.setdefault(link.name, []).append(link)
            services.append(Service(at_broker(settings, self.mqtt.port), suit, links))
        return services

    async def _until_others_are_done(self) -> None:
        """Wait until further people's services have taken what the links gave."""
        while not all(link.is_empty for links in self._handed.values() for link in links):  # noqa: ASYNC110
            await asyncio.sleep(_LAST_POSES_S)
        if self._handed:
            await asyncio.sleep(_LAST_POSES_S)

    async def _ingest_all(self) -> None:
        try:
            async with asyncio.TaskGroup() as group:
                for link in self.links:
                    self._ingesting.append(group.create_task(self._ingest(link), name=f"link {link.name}"))
        except ExceptionGroup as failed:
            # What the user can put right is one line; anything else is told with all that led to it.
            if (found := failed.subgroup(GatewayError)) is not None and found.exceptions == failed.exceptions:
                raise found.exceptions[0] from None
            raise

    def _least_charge(self) -> float | None:
        """Return the least charge of all modules, 0 to 1; None: none has reported it."""
        percents = [
            record.health.battery_percent
            for record in self.pipeline.modules.records.values()
            if record.health
        ]
        return min((percent / 100 for percent in percents if percent is not None), default=None)

    def _contents_of(self, link: Link) -> Mapping[str, str]:
        """Return what a link carries, by the names that its chunks have."""
        return contents_of(link, self._carries.get(link.name, SUIT))

    def _takes_commands(self, link: Link) -> bool:
        """Return whether packets of ours may be written to a link."""
        return source_kind(self._carries.get(link.name, SUIT)).takes_commands

    def _has_cameras(self, link: Link) -> TypeGuard[ReconnectingLink]:
        """Return whether cameras are at the other end of a link, which take orders."""
        return isinstance(link, ReconnectingLink) and self._carries.get(link.name) == CARRIES

    async def _ingest(self, link: Link) -> None:
        """Pass on what one link yields, until it ends: link → pipeline → outputs."""
        await _open(link)
        contents = self._contents_of(link)
        for name, content in contents.items():
            self.pipeline.add_link(name, content)
        is_live = not is_recording(link)
        if is_live:
            self._makers.add_link(link, self.pipeline.source_of(link.name))
            if self._takes_commands(link):
                self._announced.append(link)
        counts = link.counts if isinstance(link, ReconnectingLink) else LinkCounts()
        losses = n_poses = 0
        try:
            async for item in link:
                # With a disk slower than the suit, the recorder's queue would grow without bound.
                if self.recording.is_behind:
                    await self.recording.catch_up()
                if counts.losses != losses:
                    # Bytes lost in the link's own buffers leave a gap in the packets that follow: the gap's
                    # cause is known.
                    losses = counts.losses
                    self.pipeline.modules.notice(link.name, Cause.OVERRUN)
                if isinstance(item, Chunk):
                    n_poses += self._take_chunk(item, contents[item.link])
                    # The arrival times of a recording are not of today, so they say nothing of the load.
                    if is_live:
                        self.shedding.note_lag(link.name, counts, item.arrived_ns)
                    if self.side.is_waiting or n_poses >= _POSES_A_TURN:
                        n_poses = 0
                        await asyncio.sleep(0)  # a link that is never empty must not starve all else
                elif isinstance(item, SentChunk):
                    self._note_sent(item)
                else:
                    self._replay_event(item)
        finally:
            await link.close()

    def _take_chunk(self, chunk: Chunk, content: str) -> int:
        """Record a chunk, feed it, hand the poses on; return how many there are."""
        self.recording.chunk(chunk, content)
        if self.people is not None and content == CARRIES:
            self._guarded(self.people.take, chunk)
            return 0
        for link in self._handed.get(chunk.link, ()):
            link.hand(chunk)
        skeleton_frames = self._fed(chunk)
        if content == CARRIES:
            self._lead_cameras(chunk.link)
        for frame in skeleton_frames:
            self.recording.skeleton(frame, chunk.arrived_ns)
            for output in self._outputs:
                output.offer(frame)
        return len(skeleton_frames)

    def _lead_cameras(self, link: str) -> None:
        """Tell the cameras where the pose will have the person of the rig."""
        stage = self.pipeline.stage_at(link)
        if isinstance(stage, CameraStage) and (orders := stage.orders()):
            self._orders.send(orders)

    def _fed(self, chunk: Chunk) -> list[SkeletonFrame]:
        return self._guarded(self.pipeline.feed, chunk) or []

    def _guarded(self, take: Callable[[Chunk], T], chunk: Chunk) -> T | None:
        """Return what ``take`` makes of a chunk; an exception costs this chunk, never the session."""
        try:
            return take(chunk)
        except Exception:
            self.failed_chunks += 1
            # A defect may hit every chunk: logging the first, tenth, hundredth … keeps the log readable.
            if self.failed_chunks in _LOGGED_FAILURES:
                log.exception(
                    "chunk %d that could not be handled (%d bytes of %s at %d ns): the gateway goes on; "
                    "please report this with the recording",
                    self.failed_chunks,
                    len(chunk.data),
                    chunk.link,
                    chunk.arrived_ns,
                )
            return None

    def _note_sent(self, sent: SentChunk) -> None:
        """Give the pipeline what the gateway has sent, and record it in its place among what was received."""
        self.recording.sent(sent)
        self.pipeline.sent(sent)

    def _apply_event(
        self, name: str, data: Mapping[str, Any], prepared: PreparedSuit | None = None
    ) -> dict[str, object]:
        """Apply a reset or a calibration, and record it as an input; return what changed.

        Raises ``GatewayError`` if the suit or the method does not allow it.
        """
        changed = self.pipeline.event(name, data, prepared)
        # Recorded only once it was applied: a replay then meets no event that failed.
        self.recording.event(name, data)
        self.recording.worn(self.pipeline.suit)
        return changed

    async def _calibrated(self, data: Mapping[str, Any]) -> None:
        """Apply a calibration; what it needs is prepared in a thread, so that poses go on.

        Raises ``GatewayError``.
        """
        prepared = await asyncio.to_thread(self.pipeline.prepare, data)
        self._apply_event(CALIBRATED_EVENT, data, prepared)

    def _replay_event(self, event: InputEvent) -> None:
        """Apply an event of a recording that is played; ignore it where this suit or method cannot."""
        if event.name in INPUT_EVENTS:
            with contextlib.suppress(GatewayError):
                self._apply_event(event.name, event.data)

    def _note_link(self, name: str, status: LinkStatus) -> None:
        if status.state is LinkState.DOWN:
            self.pipeline.modules.notice(name, Cause.LINK_DOWN)
        self.recording.event("link", {"link": name, "state": status.state.value, "reason": status.reason})


def _person_service(
    settings: GatewaySettings, suit: WornSuit, links: Sequence[Link]
) -> tuple[VideoReconstructor, Coroutine[Any, Any, None]]:
    """Return the service of somebody before cameras, of whom nothing stays at the broker: what solves them in
    it, and what runs it."""
    service = Service(settings, suit, links)
    service.mqtt.leaves_nothing = True
    stage = service.pipeline.stage_of(HeatMapFrame)
    assert isinstance(stage, CameraStage)
    return stage.reconstructor, _run_beside(service)


async def _run_beside(service: Service) -> None:
    """Run a further person's service; if it fails, log why and let the others go on."""
    try:
        await service.run()
    except GatewayError as error:
        log.error("%s ends, the others go on: %s", service.settings.gateway, error)
