"""``mocap-gateway optical solve`` and ``play``: a trial with a fitted subject."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from devices.marker_file_link import MarkerFileLink
from devices.marker_files import read_markers
from gateway.body.rig import load_rig
from gateway.body.skeleton import WornSuit
from gateway.cli.export import export
from gateway.cli.preparing import make_ready
from gateway.cli.progress import progress_bar
from gateway.cli.replay import speed_of
from gateway.cli.replay_live import QUEUE, Brake, tell_outcome
from gateway.cli.replay_live import play as play_link
from gateway.errors import GatewayError
from gateway.reconstruction import BOTH_WAYS, OFFLINE, OPTICAL, PUBLISHED
from gateway.reconstruction.optical.residual_plot import write_residual_plot
from gateway.recording.exporters import FORMATS
from gateway.recording.optical import (
    SolvedTrial,
    optical_settings,
    write_both_ways_trial,
    write_published_trial,
    write_solved_trial,
)
from gateway.service.service import Service
from gateway.settings import load_gateway_settings

Subject = Annotated[str, typer.Option("--subject", "-s", help="Subject file of `optical fit`.")]
WRITERS = {
    "default": write_solved_trial,
    BOTH_WAYS: write_both_ways_trial,
    PUBLISHED: write_published_trial,
}
Method = Annotated[
    str,
    typer.Option(
        help="default: whole body, frame by frame; both_ways: the same, offline, with gaps bridged from both "
        "sides; published: that of CN1766831A, chain by chain, offline and far slower."
    ),
]


def solve(
    file: Annotated[Path, typer.Argument(help="Trial, C3D or TRC.")],
    subject: Subject,
    method: Method = "default",
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="The recording; default: after trial and method, .mcap."),
    ] = None,
    to: Annotated[
        list[str] | None, typer.Option(metavar="FORMAT", help=f"Export too: {', '.join(FORMATS)}.")
    ] = None,
    plot: Annotated[
        Path | None, typer.Option(help="Residuals of all markers over time as a picture (.png, .svg, .pdf).")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace existing files.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the outcome as JSON.")] = False,
) -> None:
    """Solve a trial for a fitted subject, into a recording that replays, exports and reports like any
    other."""
    write = _writer_of(method)
    suit = _subject(subject)
    for name in to or []:
        if name not in FORMATS:
            raise GatewayError(f"--to {name}: one of {', '.join(FORMATS)} is wanted")
    suffix = "" if write is write_solved_trial else f"_{method}"
    target = output or file.with_name(f"{file.stem}{suffix}.mcap")
    if target.exists() and not force:
        raise GatewayError(f"{target} exists: name another file with --output, or replace it with --force")
    trial = read_markers(file)
    target.unlink(missing_ok=True)
    if write is write_solved_trial:
        make_ready(OPTICAL)
    with progress_bar("solving", is_shown=not as_json) as tell:
        try:
            done = write(trial, file, suit, subject, target, tell)
        except OSError as error:
            raise GatewayError(f"{target} cannot be written: {error.strerror}") from error
    if plot is not None:
        write_residual_plot(done, trial.rate_hz, plot)
    if as_json:
        typer.echo(json.dumps(_outcome(done), indent=2))
    else:
        _print(done)
    if to:
        export(target, to=to, force=force)  # type: ignore[arg-type]  # names of formats, checked above


def play(
    file: Annotated[Path, typer.Argument(help="Trial, C3D or TRC.")],
    subject: Subject,
    method: Method = "default",
    speed: Annotated[str, typer.Option(help="1: as captured, 2: twice as fast, …, max: as it goes.")] = "1",
    config: Annotated[
        Path | None, typer.Option("--config", "-c", help="Broker, gateway name and outputs from this file.")
    ] = None,
    embedded: Annotated[bool, typer.Option("--embedded", help="Publish on a broker of our own.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the outcome as JSON.")] = False,
) -> None:
    """Play a trial over MQTT like a live optical system: `watch`, `view` and all else see a suit."""
    _writer_of(method)
    if method in OFFLINE:
        raise GatewayError(
            f"--method {method} wants all frames at once and cannot stream: `mocap-gateway optical solve "
            f"{file} --method {method}`, or leave it out"
        )
    suit = _subject(subject)
    pace = speed_of(speed)
    trial = read_markers(file)
    make_ready(OPTICAL)
    settings = optical_settings(subject, trial.rate_hz, f"markers://{file.resolve()}")
    if config is not None:
        given = load_gateway_settings(config)
        kept = {
            "mqtt": given.mqtt,
            "gateway": given.gateway,
            "outputs": given.outputs,
            "recording": given.recording,
        }
        settings = settings.model_copy(update=kept)
    changes: dict[str, object] = {"queue_length": max(settings.mqtt.queue_length, QUEUE)}
    if embedded:
        changes.update(broker="embedded", host="127.0.0.1")
    settings = settings.model_copy(update={"mqtt": settings.mqtt.model_copy(update=changes)})
    link = MarkerFileLink(
        file, speed=pace, name="markers", labels=suit.markers.labels if suit.markers else ()
    )
    service = Service(settings, suit, [link])
    link.hold = Brake(service, is_paced=pace is not None).hold
    typer.echo(f"playing to {settings.mqtt.base_topic}/{settings.gateway}/pose; Ctrl-C ends", err=True)
    asyncio.run(play_link(service, link, as_json))
    tell_outcome(service, as_json)


def _writer_of(method: str) -> Callable[..., SolvedTrial]:
    if method not in WRITERS:
        raise GatewayError(f"--method {method}: one of {', '.join(WRITERS)} is wanted")
    return WRITERS[method]


def _subject(name: str) -> WornSuit:
    suit = load_rig(name)
    if suit.markers is None:
        raise GatewayError(f"{name} is a rig without markers: --subject wants a file of `optical fit`")
    return suit


def _outcome(done: SolvedTrial) -> dict[str, object]:
    seen = np.isfinite(done.residuals)
    squares = np.where(seen, done.residuals, 0.0) ** 2
    means = np.sqrt(squares.sum(axis=0) / np.maximum(seen.sum(axis=0), 1))
    return {
        "file": str(done.path),
        "frames": done.frames,
        "rmse_mm": round(1e3 * done.rmse, 2),
        "ms_per_frame": round(done.ms_per_frame, 3),
        "counts": done.counts,
        "renamed": [{"frame": f, "marker": m, "was": was or None} for f, m, was in done.renamed],
        "markers": {
            label: {
                "rmse_mm": None if not seen[:, m].any() else round(1e3 * float(means[m]), 2),
                "seen_percent": round(100 * float(seen[:, m].mean()), 1),
                "used_percent": round(100 * float(done.used[:, m].mean()), 1),
            }
            for m, label in enumerate(done.labels)
        },
    }


def _print(done: SolvedTrial) -> None:
    outcome = _outcome(done)
    markers = outcome["markers"]
    assert isinstance(markers, dict)
    table = Table("marker", "rest mm", "seen %", "used %")
    for label, figures in markers.items():
        rest = "–" if figures["rmse_mm"] is None else f"{figures['rmse_mm']:.1f}"
        table.add_row(label, rest, f"{figures['seen_percent']:.0f}", f"{figures['used_percent']:.0f}")
    Console().print(table)
    typer.echo(
        f"{done.path}: {done.frames} frames, rest {outcome['rmse_mm']} mm RMS, "
        f"{done.ms_per_frame:.2f} ms a frame; {len(done.renamed)} names put right, "
        f"{done.counts.get('rejected', 0)} points left out"
    )
