"""The sources by the word that the configuration has for them. A new device is a file, and a line here.

The settings of links are at hand, for the configuration needs them all; a source that takes long to import is
imported when the first one is made.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

from devices.deferred import Deferred
from devices.link import SUIT, Framing
from gateway.errors import SettingsError, nearest
from gateway.sources import slimevr
from gateway.sources.bno08x import Bno08xLinkSettings, Bno08xSource
from gateway.sources.link_settings import GnssLinkSettings, LinkSettings, MarkersLinkSettings
from gateway.sources.makers import Discovery, MakersCommands, OthersLinkSettings
from gateway.sources.mocopi import MocopiLinkSettings, MocopiSource
from gateway.sources.mti import (
    MtiCanLinkSettings,
    MtiCanSource,
    MtiCommands,
    MtiLinkSettings,
    MtiSource,
)
from gateway.sources.mvn import MvnLinkSettings, MvnSource
from gateway.sources.slimevr import SlimevrCommands, SlimevrLinkSettings, SlimevrSource
from gateway.sources.source import Source, SourceContext
from gateway.sources.witmotion import (
    WitMotionCanCommands,
    WitMotionCanLinkSettings,
    WitMotionCanSource,
    WitMotionCommands,
    WitMotionLinkSettings,
    WitMotionSource,
)
from gateway.sources.ximu3 import DISCOVERY, Ximu3Commands, Ximu3LinkSettings, Ximu3Source

if TYPE_CHECKING:
    from gateway.body.skeleton import WornSuit

NO_MARKERS = "the rig has no markers: 'rig' must name a subject that `mocap-gateway optical fit` wrote"
NO_CAMERAS = (
    "the rig has no cameras: 'rig' must name a subject that `mocap-gateway video solve` wrote, or a rig with "
    "'cameras'"
)


class SourceKind(NamedTuple):
    """How the links that carry one thing are read."""

    make: Callable[[SourceContext], Source]
    settings: type[LinkSettings] = LinkSettings
    """What the configuration may say of such a link."""
    takes_commands: bool = False
    """Whether packets of ours may be written to it: time requests, triggers, commands."""
    commands: MakersCommands | None = None
    """What may be asked of its devices in their own words."""
    greeted_in_s: float = 0.0
    """How long it may take until modules that are to be greeted are heard."""
    discovery: Discovery | None = None
    """How its devices are found in the network."""
    refusal: Callable[[WornSuit], str | None] = lambda _suit: None
    """Why a suit has no use for it; None: it has."""

    @property
    def has_modules(self) -> bool:
        """Whether worn modules are at the other end, ours or another maker's."""
        return self.takes_commands or issubclass(self.settings, OthersLinkSettings)


def _without_markers(suit: WornSuit) -> str | None:
    return NO_MARKERS if suit.markers is None else None


def _without_cameras(suit: WornSuit) -> str | None:
    return NO_CAMERAS if suit.video is None and suit.camera_position is None else None


def _cameras(context: SourceContext) -> Source:
    """Return what reads heat maps: of a person alone, or of one whose hips are a local device of modules."""
    at_hips = context.suit.camera_position
    return _heat_maps(context.suit) if at_hips is None else _hips(at_hips)


_heat_maps: Callable[..., Source] = Deferred("gateway.sources.heat_maps", "HeatMapSource")
_hips: Callable[..., Source] = Deferred("gateway.sources.hips", "HipSource")


SOURCES: dict[str, SourceKind] = {
    SUIT: SourceKind(Deferred("gateway.sources.suit", "SuitSource.of"), takes_commands=True),
    "gnss": SourceKind(Deferred("gateway.sources.gnss.receiver", "GnssSource"), GnssLinkSettings),
    "ximu3": SourceKind(Ximu3Source, Ximu3LinkSettings, commands=Ximu3Commands(), discovery=DISCOVERY),
    "mti": SourceKind(MtiSource, MtiLinkSettings, commands=MtiCommands()),
    "mti_can": SourceKind(MtiCanSource, MtiCanLinkSettings),
    "slimevr": SourceKind(
        SlimevrSource,
        SlimevrLinkSettings,
        commands=SlimevrCommands(),
        greeted_in_s=5.0,
        discovery=slimevr.DISCOVERY,
    ),
    "witmotion": SourceKind(WitMotionSource, WitMotionLinkSettings, commands=WitMotionCommands()),
    "witmotion_can": SourceKind(
        WitMotionCanSource, WitMotionCanLinkSettings, commands=WitMotionCanCommands()
    ),
    "mvn": SourceKind(MvnSource, MvnLinkSettings),
    "bno08x_rvc": SourceKind(Bno08xSource, Bno08xLinkSettings),
    "mocopi": SourceKind(MocopiSource, MocopiLinkSettings),
    "markers": SourceKind(
        Deferred("gateway.sources.markers", "MarkerSource"), MarkersLinkSettings, refusal=_without_markers
    ),
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
