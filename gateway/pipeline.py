"""READ FIRST: the whole flow, as code.

    link → chunk → source → observations → stage → frames of one instant → reconstructor → pose → outputs

A ``Source`` takes the bytes of one kind of link (``gateway.sources.registry``), a ``Stage`` one kind of
observation (``gateway.stages.registry``). ``Pipeline`` puts them together, and knows none of them by name.

It is sans-I/O and deterministic: fed the same chunks with the same arrival times, and told in the same order
what the gateway sent and when (``sent``) and what was asked of it (``event``), it gives the same skeleton
frames, bit for bit. ``gateway.service.service`` puts links before it and outputs after.
"""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from devices.link import Chunk, InputEvent, LinkItem, SentChunk
from gateway.body.skeleton import WornSuit, remounted
from gateway.clocks import ClockTable, load_clock_table
from gateway.contract.balances import Balance, joined
from gateway.errors import GatewayError
from gateway.frames import ImuFrame, Observation, SkeletonFrame
from gateway.reconstruction import RootSettings
from gateway.reconstruction.reconstructor import Reconstructor
from gateway.reconstruction.resets import Resets
from gateway.settings import GatewaySettings, fitting_suit
from gateway.sources.clock_mode import ClockMode
from gateway.sources.despiking import Despiker
from gateway.sources.link_settings import LinkSettings
from gateway.sources.source import Source
from gateway.sources.sources import Sources
from gateway.stages.frame_assembler import AssemblyParams
from gateway.stages.modules import ModuleStage
from gateway.stages.registry import STAGES
from gateway.stages.stage import Stage, StageContext

FRAMES_AT_A_TIME = 256
"""Of a recording: enough that a call costs nothing, few enough to stay in the processor's cache."""
RESET_EVENT, CALIBRATED_EVENT, LOAD_EVENT = "reset", "calibrated", "load"
INPUT_EVENTS = frozenset({RESET_EVENT, CALIBRATED_EVENT, LOAD_EVENT})
"""Events that are inputs: a recording must hand them over again in their place."""


class PreparedSuit(NamedTuple):
    """A suit that is worn otherwise, with what reconstructs it."""

    suit: WornSuit
    reconstructor: Reconstructor


def sources_from_settings(settings: GatewaySettings, suit: WornSuit) -> Sources:
    """Return the sources of a configuration alone, to see what came: nothing is made of it, and the method is
    not built. Raises ``SettingsError`` for a bad clock table."""
    return Sources(suit, settings.clock.mode, *_of_sources(settings))


def _of_sources(settings: GatewaySettings) -> tuple[ClockTable | None, int, dict[str, LinkSettings]]:
    """Return the clock table, the patience with triggers, ns, and the links by name."""
    clock = settings.clock
    table = None if clock.table is None else load_clock_table(Path(clock.table))
    return table, round(clock.trigger_patience_ms * 1e6), {link.name: link for link in settings.links}


class Pipeline:
    """Chunks in, skeleton frames out."""

    def __init__(
        self,
        suit: WornSuit,
        params: AssemblyParams,
        reconstructor: str = "independent",
        clock_mode: ClockMode = ClockMode.ESTIMATED,
        *,
        clock_table: ClockTable | None = None,
        despiker: Despiker | None = None,
        trigger_patience_ns: int = 250_000_000,
        root: RootSettings | None = None,
        delay_s: float = 0.0,
        links: Mapping[str, LinkSettings] | None = None,
    ) -> None:
        """Build the sources and stages of a suit.

        reconstructor: name of the method. clock_table: for clock mode TABLE.
        despiker: takes single wild values out of samples; None: they stay.
        trigger_patience_ns: in clock mode TRIGGER, how long after a trigger its answers are taken.
        delay_s: by how much the method's frames may come later to be more accurate; for methods that can.
        links: settings of the links by name.
        """
        self._sources = Sources(suit, clock_mode, clock_table, trigger_patience_ns, links or {})
        self.modules, self.stream = self._sources.modules, self._sources.stream
        self._stage_context = StageContext(
            suit,
            self.modules,
            params,
            method=reconstructor,
            root=root,
            despiker=despiker,
            reference=None if clock_table is None else clock_table.reference,
            delay_s=delay_s,
        )
        self.suit = suit
        """As worn now: a calibration may have changed it."""
        self.resets = Resets(suit.skeleton)
        self.skeleton_frames = 0
        self._stages: dict[Callable[[StageContext], Stage[Any]], Stage[Any]] = {}
        self._stage_behind: dict[str, Stage[Any]] = {}  # by link
        self.module_stage = ModuleStage(self._stage_context)
        """The stage of modules, which is there whatever else is."""
        self._stages[ModuleStage] = self.module_stage

    @classmethod
    def from_settings(cls, settings: GatewaySettings, suit: WornSuit) -> Pipeline:
        """Return the pipeline that a configuration describes. Raises ``SettingsError`` for a bad clock table,
        for a body that cannot walk and shall, and for a method that the suit has no modules for."""
        settings = fitting_suit(settings, suit)
        table, patience_ns, links = _of_sources(settings)
        return cls(
            suit,
            settings.assembly.params(),
            settings.reconstructor,
            settings.clock.mode,
            clock_table=table,
            despiker=Despiker() if settings.assembly.despike else None,
            trigger_patience_ns=patience_ns,
            root=settings.root_motion.root(),
            delay_s=settings.reconstructor_delay_ms * 1e-3,
            links=links,
        )

    def add_link(self, name: str, content: str) -> None:
        """Announce a link, before its first chunk. content: what it carries, as recordings keep it
        (``devices.link.content_of``). Raises ``SettingsError`` as ``expect`` does."""
        _, self._stage_behind[name] = self.expect(name, content)
        self._sources.add_link(name, content)

    def expect(self, name: str, content: str) -> tuple[Source, Stage[Any]]:
        """Make what takes the chunks of a link, which may compile for a while.

        Raises ``SettingsError`` where the suit has no use for what it carries."""
        source = self._sources.expect(name, content)
        return source, self.stage_of(source.observes)

    def source_of(self, link: str) -> Source:
        """Return what reads a link that was announced."""
        return self._sources.by_link[link]

    def stage_at(self, link: str) -> Stage[Any]:
        """Return the stage behind a link that was announced."""
        return self._stage_behind[link]

    def stage_of(self, observes: type[Observation]) -> Stage[Any]:
        """Return the stage that takes a kind of observation, made when it is first asked for."""
        make = STAGES[observes]
        if make not in self._stages:
            self._stages[make] = make(self._stage_context)
        return self._stages[make]

    def feed(self, chunk: Chunk) -> list[SkeletonFrame]:
        """Return the skeleton frames that a chunk completes."""
        stage, frames = self._assembled(chunk)
        return self._solved(stage, frames)

    def sent(self, chunk: SentChunk) -> None:
        """Note what the gateway put on a link: time requests and triggers, whose answers need it."""
        self._sources.sent(chunk)

    def take(self, item: LinkItem) -> list[SkeletonFrame]:
        """Take any input; return the skeleton frames that it completes.

        An event that is not possible with this suit or method is ignored.
        """
        if isinstance(item, Chunk):
            return self.feed(item)
        if isinstance(item, SentChunk):
            self.sent(item)
        else:
            with contextlib.suppress(GatewayError):
                self.event(item.name, item.data)
        return []

    def replay(self, items: Iterable[LinkItem]) -> Iterator[SkeletonFrame]:
        """Yield a recording: the frames that ``take`` of each item gives, bit for bit, but many at a time."""
        block: list[Any] = []
        stage: Stage[Any] = self.module_stage
        for item in items:
            if isinstance(item, Chunk):
                taker, frames = self._assembled(item)
                # Poses keep the order of their chunks: a block ends where another stage has frames.
                if taker is not stage and frames:
                    yield from self._solved(stage, block)
                    stage, block = taker, []
                block += frames
            # An event holds for what comes after it, so what came before is solved first.
            if isinstance(item, InputEvent) or len(block) >= FRAMES_AT_A_TIME:
                yield from self._solved(stage, block)
                block = []
            if not isinstance(item, Chunk):
                self.take(item)
        yield from self._solved(stage, block)

    def imu_frames(self, chunk: Chunk) -> list[ImuFrame]:
        """Return the frames of all modules that a chunk completes, not yet reconstructed."""
        stage, frames = self._assembled(chunk)
        return frames if stage is self.module_stage else []

    def _assembled(self, chunk: Chunk) -> tuple[Stage[Any], list[Any]]:
        stage = self._stage_behind[chunk.link]
        return stage, stage.add(self._sources.receive(chunk), chunk.arrived_ns)

    def _solved(self, stage: Stage[Any], frames: list[Any]) -> list[SkeletonFrame]:
        if not frames:
            return []
        poses = stage.solve(frames)
        self.skeleton_frames += len(poses)
        return [self.resets.apply(pose) for pose in poses]

    def event(
        self, name: str, data: Mapping[str, Any], prepared: PreparedSuit | None = None
    ) -> dict[str, object]:
        """Apply something asked of the gateway that changes what follows; other events pass without effect.

        ``reset`` (kind, facing), ``calibrated`` (see ``mounting_event``) and ``load`` (solve_every: of the
        frames, how many are reconstructed). prepared: what ``prepare`` made of a calibration; None: it is
        made here. Returns what came of it; raises ``GatewayError`` where that cannot be done, and then has
        changed nothing.
        """
        try:
            if name == RESET_EVENT:
                return self.resets.reset(str(data["kind"]), float(data.get("facing", 0.0)))
            if name == LOAD_EVENT:
                self.module_stage.solve_every = max(int(data["solve_every"]), 1)
            elif name == CALIBRATED_EVENT:
                self._wear(self.prepare(data) if prepared is None else prepared)
        except (
            KeyError,
            TypeError,
            ValueError,
            OverflowError,
        ) as error:  # a recorded one may be damaged, or another's
            raise GatewayError(f"event '{name}' cannot be read: {error!r}") from error
        return {}

    def prepare(self, data: Mapping[str, Any]) -> PreparedSuit:
        """Make what a calibration needs, which takes a while, and change nothing: for another thread.

        data: of the event. Raises ``GatewayError`` for one of another body."""
        suit = remounted(self.suit, data)
        return PreparedSuit(suit, self.module_stage.make(suit))

    def _wear(self, prepared: PreparedSuit) -> None:
        self.suit = prepared.suit
        self.module_stage.wear(*prepared)
        self.resets = Resets(prepared.suit.skeleton)

    @property
    def _parts(self) -> list[Source | Stage[Any]]:
        return [*self._sources.by_kind.values(), *self._stages.values()]

    def dropped(self) -> dict[str, Mapping[str, int]]:
        """Return what could not be read, by link and reason."""
        return {
            link: counts
            for source in self._sources.by_kind.values()
            for link, counts in source.dropped().items()
        }

    def balances(self) -> list[Balance]:
        """Return where every packet, sample and frame went (see ``gateway.service.accounting``)."""
        made = [Balance("frames", 0, {"reconstructed": self.skeleton_frames})]
        shares = (part.balances() for part in self._parts)
        return joined(itertools.chain(self.modules.balances(), made, *shares))

    def statistics(self) -> dict[str, Any]:
        """Return counters for the health message."""
        found: dict[str, Any] = {
            "skeleton_frames": self.skeleton_frames,
            "dropped_by_link": {link: dict(counts) for link, counts in self.dropped().items()},
            "modules": self.modules.statistics(),
        }
        for part in self._parts:
            for section, values in part.statistics().items():
                # Two sources may fill one section, each with the links or modules of its own.
                if isinstance(values, Mapping) and section in found:
                    found[section] |= values
                else:
                    found[section] = values
        return found
