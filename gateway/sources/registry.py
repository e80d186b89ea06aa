"""The sources by the word that the configuration has for them. A new device is a file, and a line here."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from devices.link import SUIT, Framing
from gateway.body.skeleton import WornSuit
from gateway.errors import SettingsError, nearest
from gateway.sources.gnss.receiver import GnssLinkSettings, GnssSource
from gateway.sources.heat_maps import NO_CAMERAS, HeatMapSource
from gateway.sources.hips import HipSource
from gateway.sources.link_settings import LinkSettings
from gateway.sources.makers import Discovery, MakersCommands, MakersLinkSettings
from gateway.sources.markers import NO_MARKERS, MarkerSource
from gateway.sources.mti import (
    MtiCanLinkSettings,
    MtiCanSource,
    MtiCommands,
    MtiLinkSettings,
    MtiSource,
)
from gateway.sources.source import Source, SourceContext
from gateway.sources.stream import Stream
from gateway.sources.ximu3 import DISCOVERY, Ximu3Commands, Ximu3LinkSettings, Ximu3Source


class SourceKind(NamedTuple):
    """How the links that carry one thing are read."""

    make: Callable[[SourceContext], Source]
    settings: type[LinkSettings] = LinkSettings
    """What the configuration may say of such a link."""
    takes_commands: bool = False
    """Whether packets of ours may be written to it: time requests, triggers, commands."""
    commands: MakersCommands | None = None
    """What may be asked of its devices in their own words."""
    discovery: Discovery | None = None
    """How its devices are found in the network."""
    refusal: Callable[[WornSuit], str | None] = lambda _suit: None
    """Why a suit has no use for it; None: it has."""

    @property
    def has_modules(self) -> bool:
        """Whether worn modules are at the other end, ours or another maker's."""
        return self.takes_commands or issubclass(self.settings, MakersLinkSettings)


def _without_markers(suit: WornSuit) -> str | None:
    return NO_MARKERS if suit.markers is None else None


def _without_cameras(suit: WornSuit) -> str | None:
    return NO_CAMERAS if suit.video is None and suit.camera_position is None else None


def _cameras(context: SourceContext) -> Source:
    """Return what reads heat maps: of a person alone, or of one whose hips are a local device of modules."""
    at_hips = context.suit.camera_position
    return HeatMapSource(context.suit) if at_hips is None else HipSource(at_hips)


SOURCES: dict[str, SourceKind] = {
    SUIT: SourceKind(Stream.of, takes_commands=True),
    "gnss": SourceKind(GnssSource, GnssLinkSettings),
    "ximu3": SourceKind(Ximu3Source, Ximu3LinkSettings, commands=Ximu3Commands(), discovery=DISCOVERY),
    "mti": SourceKind(MtiSource, MtiLinkSettings, commands=MtiCommands()),
    "mti_can": SourceKind(MtiCanSource, MtiCanLinkSettings),
    "markers": SourceKind(MarkerSource, refusal=_without_markers),
    "heat_maps": SourceKind(_cameras, refusal=_without_cameras),
}
"""By what a link carries."""


def carried_by(content: str) -> str:
    """Return what a link carries, by the word that recordings keep (``devices.link.content_of``)."""
    return SUIT if content in list(Framing) else content


def refuse_unsuited(name: str, carries: str, suit: WornSuit) -> None:
    """Raise ``SettingsError`` where a suit has no use for what the link of that name carries."""
    why = source_kind(carries).refusal(suit)
    if why is not None:
        raise SettingsError(f"link '{name}' carries {carries.replace('_', ' ')}: {why}")


def source_kind(carries: str) -> SourceKind:
    """Return how such links are read. Raises ``SettingsError`` for what nothing reads here."""
    if carries not in SOURCES:
        raise SettingsError(f"no source of this version reads '{carries}'{nearest(carries, SOURCES)}")
    return SOURCES[carries]
