"""The running gateway: links before the pipeline, outputs after it, everything in one event loop."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Sequence

import gateway
from devices.command_client import CommandClient
from devices.endpoints import link_from_url
from devices.link import Link
from devices.reconnect import ReconnectingLink
from devices.replay_link import ReplayLink
from gateway.body.skeleton import WornSuit
from gateway.modules.journal import Journal, default_journal_path
from gateway.modules.module_log import ModuleLog
from gateway.modules.operations import ModuleOperations
from gateway.modules.session import connect_client
from gateway.observability import Observer
from gateway.outputs.messages import BridgeInfo, ModuleInfo
from gateway.outputs.mqtt import MqttOutput
from gateway.outputs.output import Output
from gateway.outputs.requests import RequestResponder
from gateway.pipeline import Pipeline
from gateway.settings import GatewaySettings
from gateway.stream import ClockMode, Stream
from gateway.synchronisation import Synchroniser

log = logging.getLogger(__name__)

REPORT_INTERVAL_S = 10.0


class Service:
    """Runs until cancelled, or until every link has come to its end (recordings do)."""

    def __init__(
        self, settings: GatewaySettings, suit: WornSuit, links: Sequence[Link] | None = None
    ) -> None:
        self.links = links if links is not None else _links_of(settings)
        self.pipeline = Pipeline.from_settings(settings, suit)
        info = _describe(settings, suit)
        self.mqtt = MqttOutput(settings.mqtt, suit.skeleton, info, self.pipeline.statistics)
        self._outputs: tuple[Output, ...] = (self.mqtt,)
        self.observer = Observer(settings, suit, info, self.pipeline, self.links, self.mqtt)
        stream = self.pipeline.stream
        self.commands = CommandClient(self.links, allow_writes=settings.allow_device_writes)
        connect_client(self.commands, stream)
        ModuleLog().listen_to(stream)
        operations = ModuleOperations(stream, self.commands, suit, Journal(default_journal_path()))
        self._synchroniser = _synchroniser(settings, self.links, stream)
        self.requests = RequestResponder(settings.mqtt, settings.gateway, {"modules": operations.perform})

    async def run(self) -> None:
        """Open everything, and pass on what comes. Raises ``OutputError`` if an output cannot start."""
        async with self.mqtt, self.observer.watching():
            self.requests.start(self.mqtt.port)
            companions = [asyncio.create_task(self._report(), name="report")]
            if self._synchroniser is not None:
                companions.append(asyncio.create_task(self._synchroniser.run(), name="synchroniser"))
            try:
                async with asyncio.TaskGroup() as group:
                    for link in self.links:
                        group.create_task(self._ingest(link), name=f"link {link.name}")
            finally:
                for companion in companions:
                    companion.cancel()
                await self.requests.stop()

    async def _ingest(self, link: Link) -> None:
        """link → pipeline → outputs, for one link."""
        await link.open()
        self.pipeline.add_link(link.name, link.framing)
        try:
            async for chunk in link:
                skeleton_frames = self.pipeline.feed(chunk)
                for frame in skeleton_frames:
                    for output in self._outputs:
                        output.offer(frame)
                if skeleton_frames:
                    await asyncio.sleep(0)  # a link that is never empty must not starve the outputs
        finally:
            await link.close()

    async def _report(self) -> None:
        """A line now and then for whoever reads the log."""
        frames_before = 0
        while True:
            await asyncio.sleep(REPORT_INTERVAL_S)
            modules = self.pipeline.stream.modules.values()
            frames = self.pipeline.skeleton_frames
            log.info(
                "%.1f poses/s from %d modules; packets received %d, lost %d; %s; poses dropped %d",
                (frames - frames_before) / REPORT_INTERVAL_S,
                len(modules),
                sum(record.received for record in modules),
                sum(record.lost for record in modules),
                "broker connected" if self.mqtt.is_connected else "NO BROKER",
                self.mqtt.counters.dropped,
            )
            frames_before = frames


def _links_of(settings: GatewaySettings) -> list[Link]:
    links = [link_from_url(link.url, name=link.name) for link in settings.links]
    return [link if isinstance(link, ReplayLink) else ReconnectingLink(link) for link in links]


def _synchroniser(settings: GatewaySettings, links: Sequence[Link], stream: Stream) -> Synchroniser | None:
    """None where clocks need no exchanges, or none are wanted."""
    if settings.clock.mode is not ClockMode.ESTIMATED or not settings.clock.sync_rate_hz:
        return None
    live = [link for link in links if not isinstance(link, ReplayLink)]
    return Synchroniser(live, stream, 1.0 / settings.clock.sync_rate_hz)


def _describe(settings: GatewaySettings, suit: WornSuit) -> BridgeInfo:
    worn = zip(suit.module_of_segment, suit.skeleton.segment_names, strict=True)
    return BridgeInfo(
        version=gateway.__version__,
        gateway=settings.gateway,
        reconstructor=settings.reconstructor,
        frame_rate=settings.assembly.rate_hz,
        modules=tuple(
            ModuleInfo(module=suit.module_ids[row], segment=segment) for row, segment in worn if row >= 0
        ),
    )
