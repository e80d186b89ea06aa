"""Publish module state, UTC offset, metrics and health; log how many poses and packets come."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from collections.abc import AsyncIterator, Callable, Sequence
from typing import Any

from devices.link import Link, gateway_time_ns
from devices.links.reconnect import LinkState, ReconnectingLink
from gateway.body.skeleton import WornSuit
from gateway.clocks import AnchorWatch
from gateway.contract.balances import Balance, unaccounted
from gateway.contract.messages import BridgeInfo, UtcAnchor
from gateway.modules.module_log import UnknownModules
from gateway.modules.summary import ModuleStates
from gateway.outputs.mqtt import MqttOutput
from gateway.outputs.side_outputs import SideOutputs
from gateway.pipeline import Pipeline
from gateway.service.metrics import GatewayFigures, LinkFigures
from gateway.service.metrics_server import MetricsServer
from gateway.service.overload import LoadWatch
from gateway.settings import GatewaySettings

log = logging.getLogger(__name__)

LOOK_INTERVAL_S = 0.25
REPORT_INTERVAL_S = 10.0
_MOST_STRANGERS_NAMED = 32
_READS = 5

Clock = Callable[[], int]


class Observer:
    """Looks at a running gateway a few times a second, and publishes what it sees; of one event loop."""

    def __init__(
        self,
        settings: GatewaySettings,
        suit: WornSuit,
        info: BridgeInfo,
        pipeline: Pipeline,
        *,
        links: Sequence[Link],
        mqtt: MqttOutput,
        side: SideOutputs,
        utc_ns: Clock = time.time_ns,
        balances: Callable[[], list[Balance]] = list,
        load: LoadWatch | None = None,
        not_recorded: Callable[[], str | None] = lambda: None,
    ) -> None:
        """Watch the parts of a running gateway.

        utc_ns: reads the host's UTC, ns.
        balances: returns where every sample, pose and chunk went.
        load: whether the machine keeps up; None: a watch that observes nothing.
        not_recorded: returns why a recording that is wanted has ended; None: it goes on, or none is wanted.
        """
        self._load = load or LoadWatch()
        self.utc: UtcAnchor | None = None
        self.metrics: MetricsServer | None = None
        """Where the configuration asks for one."""
        self._info = info
        self._pipeline = pipeline
        self._links = links
        self._mqtt = mqtt
        self._side = side
        self._utc_ns = utc_ns
        self._balances = balances
        self._not_recorded = not_recorded

        self._left_over: dict[str, int] = {}
        self._anchors = AnchorWatch()
        self._states = ModuleStates(
            pipeline.stream,
            suit,
            silent_after_ns=round(settings.modules.silent_after_s * 1e9),
            interval_ns=round(settings.modules.state_interval_s * 1e9),
            late=pipeline.module_stage.assembler.late,
            doubts=pipeline.module_stage.doubts,
        )

        if settings.metrics.port is not None:
            self.metrics = MetricsServer(
                settings.metrics.host,
                settings.metrics.port,
                self.figures,
                self.health,
                settings.metrics.token(),
            )

    @contextlib.asynccontextmanager
    async def watching(self) -> AsyncIterator[None]:
        """Look and publish until left, then report all offline. Raises ``OutputError`` for a busy port."""
        self.look()
        async with self.metrics or contextlib.nullcontext():
            looking = asyncio.create_task(self._look_for_ever(), name="observer")
            try:
                yield
            finally:
                looking.cancel()
                for topic, message in self._states.farewell(gateway_time_ns()):
                    self._mqtt.keep(topic, message)

    def look(self) -> None:
        """Read clocks and counters once, and publish every message that is due."""
        self._read_utc()
        self._check_balances()
        for topic, message in self._states.look(gateway_time_ns()):
            self._mqtt.keep(topic, message)

    def figures(self) -> GatewayFigures:
        """Return all that is measured, now."""
        dropped = self._pipeline.dropped()
        links = [
            LinkFigures(
                name=link.name,
                is_up=_is_up(link, has_begun=link.name in dropped),
                reconnections=link.reconnections if isinstance(link, ReconnectingLink) else 0,
                dropped=dict(dropped.get(link.name, {})),
                counts=link.counts.summary() if isinstance(link, ReconnectingLink) else {},
            )
            for link in self._links
        ]
        lost = self._pipeline.module_stage.assembler.lost
        return GatewayFigures(
            info=self._info,
            links=links,
            modules=self._states.states(gateway_time_ns()),
            skeleton_frames=self._pipeline.skeleton_frames,
            dropped_by_assembly={reason.name.lower(): count for reason, count in lost.items()},
            outputs={"mqtt": self._mqtt.counters, **self._side.counters},
            connected={"mqtt": self._mqtt.is_connected},
            utc=self.utc,
            balances=self._balances(),
            load=self._load,
        )

    def health(self) -> dict[str, Any]:
        """Return the health check: ``ok``, or ``degraded`` while poses cannot flow from end to end or are not
        recorded although they should be."""
        figures = self.figures()
        down = [link.name for link in figures.links if not link.is_up]
        silent = [module.module for module in figures.modules if module.availability == "offline"]
        # A suit with one silent module still gives poses; only a link that is down, or silence of all, stops
        # them.
        is_fed = not down and len(silent) < len(figures.modules)
        is_taken = all(figures.connected.values()) and self._mqtt.rights.state != "refused"
        not_recorded = self._not_recorded()
        is_alone = self._mqtt.twin is None
        is_ok = is_fed and is_taken and is_alone and not_recorded is None and not self._load.stage
        return {
            "status": "ok" if is_ok else "degraded",
            "links_down": down,
            "modules_silent": silent,
            "outputs_connected": dict(figures.connected),
            "outputs_publishing": {"mqtt": self._mqtt.rights.state},
            "topics_refused": list(self._mqtt.rights.refused),
            "same_name": self._mqtt.twin,
            "recording_ended": not_recorded,
            "skeleton_frames": figures.skeleton_frames,
            "load": dict(self._load.statistics()),
            "unaccounted": unaccounted(figures.balances),
        }

    async def _look_for_ever(self) -> None:
        while True:
            await asyncio.sleep(LOOK_INTERVAL_S)
            try:
                self.look()
            except Exception:
                # Poses matter more than reports on them.
                log.exception("the gateway could not be looked at")

    def _check_balances(self) -> None:
        """Log a balance that does not add up, which is a defect of the gateway: once, and again when it
        grows.
        """
        left_over = unaccounted(self._balances())
        if left_over != self._left_over:
            log.error("not accounted for: %s; please report this with the recording", left_over)
        self._left_over = left_over

    def _read_utc(self) -> None:
        is_step = self._anchors.observe(*read_both(self._utc_ns))
        reading = self._anchors.newest
        assert reading is not None
        self.utc = UtcAnchor(
            t_ns=reading.gateway_ns,
            utc_ns=reading.utc_ns,
            offset_ns=reading.offset_ns,
            steps=reading.steps,
            last_step_ns=reading.last_step_ns,
            last_step_t_ns=reading.last_step_gateway_ns,
        )
        self._mqtt.anchor(self.utc, is_step=is_step)
        if is_step:
            step_s = (reading.last_step_ns or 0) * 1e-9
            log.warning("the host's UTC was set by %+.3f s; gateway time goes on as it was", step_s)


class LogReport:
    """Logs how a running gateway fares, and who sends to it that should not, or in vain."""

    def __init__(self, pipeline: Pipeline, mqtt: MqttOutput, unknown_modules: UnknownModules) -> None:
        self._pipeline, self._mqtt = pipeline, mqtt
        self._unknown_modules = unknown_modules

    def _warn_of_unknown_modules(self, named: set[str]) -> None:
        """Name who else sends to the links of modules, each once. named: those who were, and are now."""
        for link, figures in self._pipeline.stream.sender_statistics().items():
            unknown = figures["strangers"]
            assert isinstance(unknown, list)
            new = [name for name in unknown if f"{link} {name}" not in named]
            if new and len(named) < _MOST_STRANGERS_NAMED:
                named.update(f"{link} {name}" for name in new)
                log.warning(
                    "%s: %s sends here, and nothing of it is a valid packet; "
                    "'?peers=' in the link's url takes datagrams of some addresses alone",
                    link,
                    ", ".join(new),
                )

    def _warn_of_unreadable_links(self, named: set[str]) -> None:
        """Name links of which nothing can be read, each once. named: those who were, and are now."""
        several = self._pipeline.stream.sender_statistics()  # whose senders are named one by one
        for link in self._pipeline.stream.unreadable():
            if link not in named and link not in several:
                named.add(link)
                log.warning(
                    "%s: bytes come, and no valid packet is among them: is its baud or bit rate right, and "
                    "is it the suit? 'mocap-gateway doctor' looks closer",
                    link,
                )

    def _packets_report(self) -> str:
        """Return how many modules are heard, and their packets; nothing for a rig without modules."""
        if not self._unknown_modules.names:
            return ""
        modules = self._pipeline.modules.records.values()
        return (
            f" from {self._unknown_modules.known} of the rig's {len(self._unknown_modules.names)} modules; "
            f"packets received {sum(each.received for each in modules)}, "
            f"lost {sum(each.lost for each in modules)}"
        )

    async def log_for_ever(self) -> None:
        """Log every ``REPORT_INTERVAL_S`` seconds how many poses and packets came and were lost."""
        frames_before = 0
        unknown: set[str] = set()
        unreadable: set[str] = set()
        while True:
            await asyncio.sleep(REPORT_INTERVAL_S)
            self._warn_of_unknown_modules(unknown)
            self._warn_of_unreadable_links(unreadable)
            frames = self._pipeline.skeleton_frames
            log.info(
                "%.1f poses/s%s; %s; poses dropped %d",
                (frames - frames_before) / REPORT_INTERVAL_S,
                self._packets_report(),
                "broker connected" if self._mqtt.is_connected else "NO BROKER",
                self._mqtt.counters.dropped,
            )

            frames_before = frames
            if (news := self._unknown_modules.news()) is not None:
                log.warning("%s", news)


def read_both(utc_ns: Clock) -> tuple[int, int]:
    """Return (gateway time, UTC) of one moment, ns.

    Of several readings the one that took the least time is kept: its midpoint is the least uncertain.
    """
    readings = []
    for _ in range(_READS):
        before_ns, utc, after_ns = gateway_time_ns(), utc_ns(), gateway_time_ns()
        readings.append((after_ns - before_ns, (before_ns + after_ns) // 2, utc))
    _, gateway_ns, utc = min(readings)
    return gateway_ns, utc


def _is_up(link: Link, *, has_begun: bool) -> bool:
    """Return whether a link is up; a link without reconnection counts as up from its first chunk on."""
    return link.state is LinkState.UP if isinstance(link, ReconnectingLink) else has_begun
