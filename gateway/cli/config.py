"""``mocap-gateway config``: configuration files, and what is made of them."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import typer
from rich.console import Console
from rich.markup import escape

from devices.links.signed_link import write_key
from firmware_protocol import MAX_MODULE, RELAY
from firmware_protocol.dbc import ALL_SENSORS, render
from gateway.cli.options import ReplaceFiles, refuse_existing
from gateway.errors import GatewayError, SettingsError, nearest
from gateway.settings import GatewaySettings, fitting_suit, load_gateway_settings
from gateway.support.whole_files import write_whole, writing

if TYPE_CHECKING:
    from gateway.body.skeleton import WornSuit

config_app = typer.Typer(
    help="Check a configuration file, show what may stand in one, make a key, describe a suit's CAN bus.",
    epilog="Example: mocap-gateway config check my.yaml",
    no_args_is_help=True,
)


@config_app.command(epilog="Example: mocap-gateway config check config/gateway.yaml")
def check(file: Path = typer.Argument(Path("config/gateway.yaml"), help="Configuration file.")) -> None:
    """Check a configuration, and every file and folder that it names. Opens no port."""
    from gateway.body.rig import load_rig
    from gateway.doctor.named_files import trouble_with_files
    from gateway.reconstruction.inertial.articulated import unobserved_headings

    settings = load_gateway_settings(file)
    suit = load_rig(settings.rig, file)
    fitting_suit(settings, suit)
    if trouble := list(trouble_with_files(settings, suit, file)):
        raise SettingsError("\n".join(f"{file}: {line.removeprefix(f'{file}: ')}" for line in trouble))
    Console().print(
        f"[green]{escape(str(file))} is good[/green]: gateway '{settings.gateway}', {len(settings.links)} "
        f"link(s), {_worn(suit)} on body '{escape(suit.skeleton.name)}', "
        f"{settings.assembly.rate_hz:g} Hz, reconstructor '{settings.reconstructor}'{_late(settings)}, "
        f"broker {settings.mqtt.broker} {escape(settings.mqtt.host)}:{settings.mqtt.port}",
        soft_wrap=True,
    )
    if settings.reconstructor == "articulated" and suit.sun is None:
        _print_unobserved(unobserved_headings(suit))


def _worn(suit: WornSuit) -> str:
    """Return what the poses of a body come from: its modules, its markers, or the cameras before it."""
    video = suit.camera_position.person.video if suit.camera_position is not None else suit.video
    counts = [(len(suit.module_ids), "modules"), (len(suit.marker_labels), "markers")]
    counts += [(len(video.cameras), "cameras")] if video is not None else []
    return ", ".join(f"{n} {what}" for n, what in counts if n) or "0 modules"


def _print_unobserved(headings: Mapping[str, tuple[int, ...]]) -> None:
    """Name the segments whose heading is not observed without gyroscopes, with the ways to face."""
    if not headings:
        return
    listed = "; ".join(f"{segment} (facing {_ranges(lost)})" for segment, lost in headings.items())
    Console().print(
        "[yellow]note[/yellow]: where modules have no gyroscopes, 'articulated' does not observe, at rest in "
        f"the neutral posture, the heading of: {listed}. North is 0°, east 90°. Such a module wants "
        "gyroscopes, or to sit on the joint, or more to one side of it; see docs/guide/gyro_free.md",
        soft_wrap=True,
        highlight=False,
    )


def _ranges(facings: Sequence[int]) -> str:
    """Return ways to face, of ``FACINGS``, as ranges clockwise."""
    from gateway.reconstruction.inertial.articulated import FACINGS

    if len(facings) == len(FACINGS):
        return "any way"
    # Facings are equally far apart and begin with 0°, so the second is the step.
    step = FACINGS[1]
    # A range begins where the facing before it is not among them; it may go across north.
    first = [facing for facing in facings if (facing - step) % 360 not in facings]
    last = [
        next(f for f in range(start, start + 360, step) if (f + step) % 360 not in facings) for start in first
    ]
    return ", ".join(
        f"{start}°" if start == end else f"{start}° to {end % 360}°"
        for start, end in zip(first, last, strict=True)
    )


def _late(settings: GatewaySettings) -> str:
    delay_ms = settings.reconstructor_delay_ms
    return f" {delay_ms:g} ms late" if delay_ms else ""


@config_app.command(epilog="Example: mocap-gateway config schema > gateway.schema.json")
def schema() -> None:
    """Print the JSON Schema of the configuration, for editors and for reading."""
    typer.echo(json.dumps(GatewaySettings.model_json_schema(), indent=2))


@config_app.command(epilog="Example: mocap-gateway config key /etc/mocap/wifi.key")
def key(file: Path = typer.Argument(help="New file for the key; one that is there stays as it is.")) -> None:
    """Make a key for a signed link, in a file that only you may read.

    Its line, 64 hexadecimal digits, is what the modules of that link are given.
    """
    with writing(file):
        write_key(file)
    Console().print(
        f"[green]{escape(str(file))} holds a new key[/green]: give it to the modules, and write in the "
        f"configuration [bold]url: udp://…?key_file={escape(str(file.absolute()))}[/bold] (or tcp://…)",
        soft_wrap=True,
    )


@config_app.command(epilog="Example: mocap-gateway config dbc --modules 0-16 -o suit.dbc")
def dbc(
    modules: str = typer.Option("0-16", help="Ids of the modules, such as 0-16,60; 254 is a relay."),
    sensor: list[str] = typer.Option(
        list(ALL_SENSORS), help="What samples hold on classic CAN; to be repeated. Default: all three."
    ),
    output: Path = typer.Option(..., "--output", "-o", help="File to write."),
    force: ReplaceFiles = False,
) -> None:
    """Describe the CAN messages of a suit to bus monitors, as a DBC file. It needs no suit."""
    refuse_existing(output, force)
    for name in sensor:
        if name not in ALL_SENSORS:
            raise GatewayError(f"--sensor {name}: no such sensor{nearest(name, ALL_SENSORS)}")
    ids = _module_ids(modules)
    write_whole(output, render(ids, sensor).encode("ascii"))
    Console().print(f"[green]{escape(str(output))} describes {len(ids)} module(s)[/green]", soft_wrap=True)


def _module_ids(text: str) -> tuple[int, ...]:
    """Return the ids that ``0-16,60`` names, in order. Raises ``GatewayError`` for what names none."""
    known = {*range(MAX_MODULE + 1), RELAY}
    ids: set[int] = set()
    for part in text.split(","):
        ends = re.fullmatch(r"\s*(\d{1,3})\s*(?:-\s*(\d{1,3})\s*)?", part)
        named = range(int(ends[1]), int(ends[2] or ends[1]) + 1) if ends else range(0)
        if not named or not known.issuperset(named):
            raise GatewayError(
                f"--modules {text}: '{part}' names no modules; ids are 0 to {MAX_MODULE}, "
                f"and {RELAY} for a relay, as in 0-16,60"
            )
        ids.update(named)
    return tuple(sorted(ids))
