"""Emulated modules that speak as another maker's: their voices, and what to write into a configuration."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import typer
import yaml

from devices.emulators.emulated_suit import EmulatedSuit
from devices.emulators.suit_traffic import SuitTraffic
from devices.emulators.voice import Voice
from devices.emulators.voices import VOICES
from gateway.body.skeleton import WornSuit


@dataclass(frozen=True)
class SpokenSuit:
    """A suit whose modules speak as another maker's."""

    carries: str
    voices: Mapping[int, Voice]
    segments: Mapping[int, str]


def spoken_by(traffic: SuitTraffic | None, speaks: str | None) -> SpokenSuit | None:
    """Return a suit that speaks as another maker's; None: it speaks our packets, or only plays."""
    if speaks is None or traffic is None:
        return None
    body = traffic.motion.body
    worn = zip(body.module_ids.tolist(), map(str, body.segment_names), strict=True)
    return SpokenSuit(speaks, traffic.voices, dict(worn))


def voices_of(speaks: str, suit: WornSuit) -> Callable[[int], Voice]:
    """Return what makes the voices of a suit's modules, by number."""
    field_ut = float(np.linalg.norm(suit.magnetic_field))
    places = {module: place for place, module in enumerate(suit.module_ids)}
    return lambda module: VOICES[speaks](places[module], module, field_ut)


def say_links(urls: Mapping[int, str], suit: EmulatedSuit, spoken: SpokenSuit, as_json: bool) -> None:
    """Say where each module speaks, as the lines that the configuration of a gateway needs."""
    links = [_link(module, url, spoken) for module, url in urls.items()]
    if as_json:
        typer.echo(json.dumps({"links": links, "start_ns": suit.start_ns}))
        return
    typer.echo(f"# emulated modules that speak {spoken.carries} (Ctrl-C ends them); for the configuration:")
    typer.echo("links:")
    for link in links:
        typer.echo(
            "  - " + yaml.safe_dump(link, default_flow_style=True, sort_keys=False, width=1000).strip()
        )


def _link(module: int, url: str, spoken: SpokenSuit) -> dict[str, object]:
    name = spoken.segments.get(module, str(module))
    usual = {"name": name, "url": url, "carries": spoken.carries, "module": module}
    return {**usual, **spoken.voices[module].link_settings}
