"""The sources behind all links, one of a kind, on one table of modules."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from devices.link import SUIT, Chunk, SentChunk
from gateway.body.skeleton import WornSuit
from gateway.clocks import ClockTable, TriggerAnswers
from gateway.frames import FusedReading, InertialBatch, Observation
from gateway.sources.clock_mode import ClockMode
from gateway.sources.link_settings import LinkSettings
from gateway.sources.module_table import ModuleTable
from gateway.sources.registry import carried_by, refuse_unsuited, source_kind
from gateway.sources.source import Source, SourceContext
from gateway.sources.suit import SuitSource


class Sources:
    """Chunks in, observations out. Sans-I/O, deterministic."""

    def __init__(
        self,
        suit: WornSuit,
        clock_mode: ClockMode,
        clock_table: ClockTable | None,
        trigger_patience_ns: int,
        links: Mapping[str, LinkSettings],
    ) -> None:
        """Build the source of our own modules; others are made with their links.

        trigger_patience_ns: in clock mode TRIGGER, how long after a trigger its answers are taken.
        links: settings of the links by name.
        """
        self.modules = ModuleTable(clock_mode, clock_table)
        """Of all sources."""
        triggers = None
        if clock_mode is ClockMode.TRIGGER:
            triggers = TriggerAnswers(suit.module_ids, trigger_patience_ns)
        self._context = SourceContext(suit, self.modules, triggers, links)
        self.stream = SuitSource.of(self._context)
        self.by_kind: dict[str, Source] = {SUIT: self.stream}
        """By what their links carry."""
        self.by_link: dict[str, Source] = {}

    def expect(self, name: str, content: str) -> Source:
        """Make what takes the chunks of a link. content: what it carries, as recordings keep it.

        Raises ``SettingsError`` where the suit has no use for what the link carries."""
        carries = carried_by(content)
        refuse_unsuited(name, carries, self._context.suit)
        if carries not in self.by_kind:
            self.by_kind[carries] = source_kind(carries).make(self._context)
        return self.by_kind[carries]

    def add_link(self, name: str, content: str) -> Source:
        """Announce a link, before its first chunk. Raises ``SettingsError`` as ``expect`` does."""
        source = self.by_link[name] = self.expect(name, content)
        source.add_link(name, content)
        return source

    def has_modules(self, link: str) -> bool:
        """Return whether modules are at the other end of a link that was announced."""
        return self.by_link[link].observes in (InertialBatch, FusedReading)

    def receive(self, chunk: Chunk) -> Sequence[Observation]:
        """Return the observations that a chunk completes."""
        return self.by_link[chunk.link].receive(chunk)

    def sent(self, chunk: SentChunk) -> None:
        """Note what the gateway put on a link: time requests and triggers, whose answers need it."""
        if chunk.link in self.by_link:
            self.by_link[chunk.link].sent(chunk)
