"""``mocap-gateway import``: other people's recordings as ours."""

from __future__ import annotations

import json
from pathlib import Path

import typer

from devices.emulators.recordings import Recording
from gateway.body.rig import load_body, load_rig
from gateway.body.skeleton import WornSuit
from gateway.cli import import_options as options
from gateway.cli.import_options import FormatName
from gateway.cli.options import seconds_of
from gateway.cli.terminal import progress_bar
from gateway.errors import GatewayError
from gateway.imports import (
    ReadOptions,
    Worn,
    detected,
    dressed,
    mapped_segments,
    read,
    write_imported,
)
from gateway.imports.map_files import read_maps
from gateway.imports.suits import BODY, aligned
from gateway.imports.writing import is_fused, settings_of, solved
from gateway.settings import GatewaySettings, check_method


def import_files(
    files: options.Files,
    output: options.Output = None,
    format_name: options.Format = FormatName("auto"),
    maps: options.Maps = None,
    columns: options.Columns = None,
    body: options.Body = None,
    rig: options.Rig = None,
    reconstructor: options.Reconstructor = None,
    neutral: options.Neutral = None,
    forward: options.Forward = None,
    rate: options.Rate = None,
    align: options.Align = "stamps",
    partial: options.Partial = False,
    as_json: options.AsJson = False,
) -> None:
    """Make a recording of other makers' files: Xsens, MVNX, x-IMU3, Movella DOT, OpenSense, any CSV.

    The samples become packets of our own modules, so all that works with a recording works with it: replay,
    re-solving, export, report. docs/imports.md has every format.
    """
    options = ReadOptions(rate, align, partial, columns)
    name = detected(files, options) if format_name == "auto" else str(format_name)
    target = output or Path(f"{files[0].stem}.mcap")
    with progress_bar(f"reading {name}", is_shown=not as_json):
        recording = read(files, name, options)
    if reconstructor is not None:
        check_method(reconstructor)
    suit, notes = _suit(recording, name, read_maps(maps or []), body, rig)
    settings = settings_of(recording, rig or suit.skeleton.name, reconstructor)
    if is_fused(settings) and not recording.fused:
        raise GatewayError(f"--reconstructor {reconstructor}: the files hold no orientations")
    if neutral is not None:
        suit = _aligned(recording, suit, settings, neutral, forward)
    elif rig is None and name != "mvnx":
        notes.append("modules are taken to lie along their segments; --neutral FROM:TO finds how they sit")
    with progress_bar(f"importing {recording.name}", is_shown=not as_json) as tell:
        try:
            done = write_imported(recording, suit, settings, files, target, tell)
        except OSError as error:
            raise GatewayError(f"{target} cannot be written: {error.strerror}") from error
    outcome = {
        "file": str(done.path), "format": name, "modules": done.modules, "seconds": round(done.seconds, 3),
        "rate_hz": recording.sampling_rate_hz, "poses": done.poses, "reconstructor": settings.reconstructor,
        "segments": {label: _place(suit, module) for module, label in recording.names.items()},
        "notes": [*recording.notes, *notes],
    }  # fmt: skip
    _tell(outcome, as_json)


def _suit(
    recording: Recording, name: str, given: dict[str, str], body: str | None, rig: str | None
) -> tuple[WornSuit, list[str]]:
    """The suit, and what the user should know of it."""
    if rig is not None:
        return load_rig(rig), []
    segments = load_body(body or BODY).segment_names
    found = mapped_segments(recording.names, given, segments)
    if not found.segments:
        raise GatewayError(
            f"no module says by its name where it sits ({', '.join(recording.names.values())}): tell with "
            f"--map '{next(iter(recording.names.values()))}=right_thigh' (segments: {', '.join(segments)})"
        )
    worn = Worn(found.segments, recording.local)
    notes = list(found.notes)
    if found.unknown:
        notes.append(f"on no segment of the body, so kept but not used: {', '.join(found.unknown)}")
    return dressed(worn, body, mvn_axes=name == "mvnx"), notes


def _aligned(
    recording: Recording, suit: WornSuit, settings: GatewaySettings, neutral: str, forward: str | None
) -> WornSuit:
    span = seconds_of("--neutral", neutral)
    seen = solved(recording, suit, settings)
    if seen is None:
        raise GatewayError("--neutral: the files give not one pose")
    return aligned(suit, seen, *span, forward)


def _place(suit: WornSuit, module: int) -> str | None:
    if module not in suit.module_ids:
        return None
    segment = suit.module_of_segment.tolist().index(suit.module_ids.index(module))
    return str(suit.skeleton.segment_names[segment])


def _tell(outcome: dict[str, object], as_json: bool) -> None:
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
