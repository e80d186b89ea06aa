"""``mocap-gateway import``: other people's recordings as ours."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from gateway.body.skeleton import WornSuit
from gateway.cli.options import AsJson, seconds_of, with_options
from gateway.cli.preparing import make_ready
from gateway.cli.terminal import progress_bar
from gateway.errors import GatewayError
from gateway.imports.formats import FORMATS
from gateway.imports.segment_names import BODY
from gateway.settings import GatewaySettings, check_method
from gateway.support.whole_files import writing

if TYPE_CHECKING:
    from devices.recorded_tracks import RecordedTracks


FormatName = StrEnum("FormatName", {name: name for name in ("auto", *FORMATS)})  # type: ignore[misc]  # from the list
_AUTO = FormatName("auto")


@dataclass(frozen=True)
class Import:
    """The options of ``import``: what the files are, who wore them, and what becomes of them."""

    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="The recording; else NAME.mcap in this folder.")
    ] = None
    format_name: Annotated[
        FormatName, typer.Option("--format", help="What they are; auto looks into them.")
    ] = _AUTO
    maps: Annotated[
        list[str] | None,
        typer.Option(
            "--map", help="NAME=SEGMENT, a YAML file of such lines, or OpenSense's XML. Repeatable."
        ),
    ] = None
    columns: Annotated[Path | None, typer.Option(help="For csv: map of its columns (YAML).")] = None
    body: Annotated[str | None, typer.Option(help=f"Body, name or file; else what is worn of {BODY}.")] = None
    rig: Annotated[str | None, typer.Option(help="Rig, name or file, instead of any map.")] = None
    reconstructor: Annotated[
        str | None, typer.Option(help="Method; else independent, or fused where only orientations came.")
    ] = None
    neutral: Annotated[
        str | None,
        typer.Option(metavar="FROM:TO", help="Seconds in which the wearer stood upright, arms down."),
    ] = None
    forward: Annotated[
        Literal["x", "y", "z", "-x", "-y", "-z"] | None,
        typer.Option(help="With --neutral: axis of the root's module that points forward."),
    ] = None
    rate: Annotated[
        float | None, typer.Option(min=0.5, max=20_000, help="Samples a second, where files do not tell.")
    ] = None
    align: Annotated[
        Literal["stamps", "start"], typer.Option(help="Modules by their time stamps, or all begin together.")
    ] = "stamps"
    partial: Annotated[bool, typer.Option("--partial", help="Take what comes before the first damage.")] = (
        False
    )
    as_json: AsJson = False


@with_options(Import)
def import_files(
    wanted: Import,
    files: Annotated[
        list[Path], typer.Argument(help="Files, one a module where the maker has it so; or folders.")
    ],
) -> None:
    """Make a recording of other makers' files: Xsens, MVNX, BVH, x-IMU3, Movella DOT, OpenSense, CSV.

    The samples become packets of our own modules, so all that works with a recording works with it: replay,
    re-solving, export, report. docs/guide/imports.md has every format.
    """
    from gateway.imports.formats import ReadOptions, detected, read
    from gateway.imports.segment_names import read_maps
    from gateway.imports.writing import is_fused, settings_of, write_imported

    maps = read_maps(wanted.maps or [])
    options = ReadOptions(wanted.rate, wanted.align, wanted.partial, wanted.columns, maps, wanted.body)
    name = detected(files, options) if wanted.format_name == _AUTO else str(wanted.format_name)
    target = wanted.output or Path(f"{files[0].stem}.mcap")
    with progress_bar(f"reading {name}", is_shown=not wanted.as_json):
        recording = read(files, name, options)
    if wanted.reconstructor is not None:
        check_method(wanted.reconstructor)
    suit, notes = _suit(recording, name, {} if name == "bvh" else maps, wanted)
    settings = settings_of(recording, wanted.rig or suit.skeleton.name, wanted.reconstructor)
    if is_fused(settings) and not recording.fused:
        raise GatewayError(
            f"--reconstructor {wanted.reconstructor}: the files hold no orientations"
            if wanted.reconstructor is not None
            else "the files hold neither orientations nor both accelerations and angular rates"
        )
    make_ready(settings.reconstructor)
    if wanted.neutral is not None:
        suit = _aligned(recording, suit, settings, wanted.neutral, wanted.forward)
    elif wanted.rig is None and FORMATS[name].axes == "modules":
        notes.append("modules are taken to lie along their segments; --neutral FROM:TO finds how they sit")
    with (
        progress_bar(f"importing {recording.name}", is_shown=not wanted.as_json) as progress,
        writing(target),
    ):
        done = write_imported(recording, suit, settings, files, target, progress)
    outcome = {
        "file": str(done.path), "format": name, "modules": done.modules, "seconds": round(done.seconds, 3),
        "rate_hz": recording.sampling_rate_hz, "poses": done.poses, "reconstructor": settings.reconstructor,
        "segments": {label: _place(suit, module) for module, label in recording.names.items()},
        "notes": [*recording.notes, *notes],
    }  # fmt: skip
    _print_outcome(outcome, wanted.as_json)


def _suit(
    recording: RecordedTracks, name: str, maps: Mapping[str, str], wanted: Import
) -> tuple[WornSuit, list[str]]:
    """Return the suit, and what the user should know of it. maps: module to segment."""
    from gateway.body.body_file import load_body
    from gateway.body.rig import load_rig
    from gateway.imports.segment_names import mapped_segments
    from gateway.imports.suits import dressed

    # A rig names its modules itself; only without one the modules' own names are used.
    if wanted.rig is not None:
        return load_rig(wanted.rig), []
    segments = load_body(wanted.body or BODY).segment_names
    found = mapped_segments(recording.names, maps, segments)
    if not found.segments:
        raise GatewayError(
            f"no module says by its name where it sits ({', '.join(recording.names.values())}): tell with "
            f"--map '{next(iter(recording.names.values()))}={segments[0]}' (segments: {', '.join(segments)})"
        )
    notes = list(found.notes)
    if found.unknown:
        notes.append(f"on no segment of the body, so kept but not used: {', '.join(found.unknown)}")
    suit = dressed(found.segments, recording.local, wanted.body, mvn_axes=FORMATS[name].axes == "mvnx")
    return suit, notes


def _aligned(
    recording: RecordedTracks, suit: WornSuit, settings: GatewaySettings, neutral: str, forward: str | None
) -> WornSuit:
    from gateway.imports.suits import aligned
    from gateway.imports.writing import solved

    span = seconds_of("--neutral", neutral)
    # Poses as the rig stands now say by how much each module is turned on its segment.
    seen = solved(recording, suit, settings)
    if seen is None:
        raise GatewayError("--neutral: the files give not one pose")
    return aligned(suit, seen, *span, forward)


def _place(suit: WornSuit, module: int) -> str | None:
    if module not in suit.module_ids:
        return None
    segment = suit.module_of_segment.tolist().index(suit.module_ids.index(module))
    return str(suit.skeleton.segment_names[segment])


def _print_outcome(outcome: dict[str, object], as_json: bool) -> None:
    if as_json:
        typer.echo(json.dumps(outcome, indent=2, ensure_ascii=False))
        return
    segments, notes = outcome["segments"], outcome["notes"]
    assert isinstance(segments, dict)
    assert isinstance(notes, list)
    places = ", ".join(f"{label} → {place or '–'}" for label, place in segments.items())
    typer.echo(
        f"{outcome['file']}: {outcome['format']}, {outcome['seconds']} s at {outcome['rate_hz']:g} Hz, "
        f"{outcome['modules']} modules, {outcome['poses']} poses ({outcome['reconstructor']})"
    )
    typer.echo(f"  {places}")
    for note in notes:
        typer.echo(f"note: {note}", err=True)
