"""Emulated modules that speak as another maker's: their voices, and what to write into a configuration."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import typer
import yaml

from devices.emulators.emulated_suit import EmulatedSuit
from devices.emulators.sampling import FUSED
from devices.emulators.suit_traffic import SuitTraffic
from devices.emulators.voice import Voice
from devices.emulators.voices import VOICES
from gateway.body.skeleton import WornSuit
from gateway.errors import GatewayError


@dataclass(frozen=True)
class SpokenSuit:
    """A suit whose modules speak as another maker's."""

    carries: str
    rig: str
    voices: Mapping[int, Voice]
    segments: Mapping[int, str]
    is_fused: bool

    @property
    def method(self) -> str | None:
        """The reconstructor that takes what they send; None: the usual one."""
        if not self.is_fused:
            return None
        return "fused" if next(iter(self.voices.values())).speaks_as_one else "fused_neutral"


def spoken_by(traffic: SuitTraffic | None, speaks: str | None, rig: str) -> SpokenSuit | None:
    """Return a suit that speaks as another maker's; None: it speaks our packets, or only plays."""
    if speaks is None or traffic is None:
        return None
    body = traffic.motion.body
    worn = zip(body.module_ids.tolist(), map(str, body.segment_names), strict=True)
    return SpokenSuit(speaks, rig, traffic.voices, dict(worn), traffic.settings.mode == FUSED)


def voices_of(speaks: str, suit: WornSuit) -> Callable[[int], Voice]:
    """Return the voices of a suit's modules, by number. Raises ``GatewayError`` for numbers that no device
    of the maker has."""
    from gateway.modules.summary import segments_of

    field_ut = float(np.linalg.norm(suit.magnetic_field))
    try:
        return VOICES[speaks](list(segments_of(suit).values()), field_ut).__getitem__
    except ValueError as error:
        raise GatewayError(f"--speaks {speaks}: {error}") from None


def say_links(urls: Mapping[int, str], suit: EmulatedSuit, spoken: SpokenSuit, as_json: bool) -> None:
    """Say where each module speaks, as the lines that the configuration of a gateway needs."""
    links = _links(urls, spoken)
    if as_json:
        typer.echo(json.dumps({"links": links, "start_ns": suit.start_ns}))
        return
    typer.echo(f"# emulated modules that speak {spoken.carries} (Ctrl-C ends them); for the configuration:")
    typer.echo(f"rig: {spoken.rig}")
    if spoken.method is not None:
        typer.echo(f"reconstructor: {spoken.method}")
    typer.echo("links:")
    for link in links:
        typer.echo(
            "  - " + yaml.safe_dump(link, default_flow_style=True, sort_keys=False, width=1000).strip()
        )


def _links(urls: Mapping[int, str], spoken: SpokenSuit) -> list[dict[str, object]]:
    """Return a link a device; of those that share one, one with what distinguishes them."""
    if not any(voice.shares_link for voice in spoken.voices.values()):
        return [_link(module, url, spoken) for module, url in urls.items()]
    told: dict[str, dict[str, object]] = {}
    for voice in spoken.voices.values():
        for key, names in voice.link_settings.items():
            assert isinstance(names, Mapping)
            told.setdefault(key, {}).update(names)
    return [{"name": spoken.carries, "url": next(iter(urls.values())), "carries": spoken.carries, **told}]


def _link(module: int, url: str, spoken: SpokenSuit) -> dict[str, object]:
    name = spoken.segments.get(module, str(module))
    usual = {"name": name, "url": url, "carries": spoken.carries, "module": module}
    if spoken.voices[module].speaks_as_one:
        usual |= {"name": spoken.carries, "module": 0}
    return {**usual, **spoken.voices[module].link_settings}
