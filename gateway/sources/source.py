"""What a source is: the bytes of links of one kind to observations in gateway time."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from devices.link import Chunk, SentChunk
    from gateway.body.skeleton import WornSuit
    from gateway.clocks import TriggerAnswers
    from gateway.contract.balances import Balance
    from gateway.frames import Observation
    from gateway.sources.link_settings import LinkSettings
    from gateway.sources.module_table import ModuleTable


@dataclass(frozen=True)
class SourceContext:
    """What a source may need of its surroundings."""

    suit: WornSuit
    modules: ModuleTable
    """Clocks and counters of all modules: for sources of modules."""
    triggers: TriggerAnswers | None = None
    """What answers are awaited, where the gateway says when modules sample."""
    links: Mapping[str, LinkSettings] = field(default_factory=dict)
    """What the configuration says of each link, by name; a recorded link may be missing."""


class Source(Protocol):
    """Takes the chunks of all links that carry one thing. Sans-I/O, deterministic.

    Bytes are untrusted: nothing here raises for what they hold; what cannot be used is dropped and counted.
    """

    @property
    def observes(self) -> type[Observation]:
        """What it gives: decides which stage takes it (``gateway.stages.registry``)."""
        ...

    def add_link(self, name: str, content: str) -> None:
        """Announce a link, before its first chunk. content: see ``devices.link.content_of``."""
        ...

    def receive(self, chunk: Chunk) -> Sequence[Observation]:
        """Return the observations that a chunk completes, in order of arrival."""
        ...

    def sent(self, chunk: SentChunk) -> None:
        """Take note of what the gateway put on one of its links."""
        ...

    def dropped(self) -> Mapping[str, Mapping[str, int]]:
        """Return what could not be read, by link and reason."""
        ...

    def statistics(self) -> Mapping[str, object]:
        """Return counters for the health message, by section."""
        ...

    def balances(self) -> Iterable[Balance]:
        """Yield its shares of the balances: what went in, and what came out."""
        ...


class ListeningSource:
    """A source that writes nothing to its links: the parts that are then empty."""

    def sent(self, chunk: SentChunk) -> None:
        """Ignore what was sent: sources of this kind expect no answer."""

    def dropped(self) -> Mapping[str, Mapping[str, int]]:
        """Return what could not be read, by link and reason."""
        return {}

    def statistics(self) -> Mapping[str, object]:
        """Return counters for the health message, by section."""
        return {}

    def balances(self) -> Iterable[Balance]:
        """Yield its shares of the balances."""
        return ()
