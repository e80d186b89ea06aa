"""``mocap-gateway report``: a recording as one page."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from gateway.cli.progress import progress_bar
from gateway.errors import GatewayError
from gateway.recording import open_recording
from gateway.report import gather, write_report
from gateway.report.drawing import require_matplotlib


def report(
    file: Annotated[Path, typer.Argument(help="Recording, whole or cut off.")],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="The page; else NAME.html beside the recording.")
    ] = None,
    force: Annotated[bool, typer.Option("--force", "-f", help="Replace a file that is there.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the outcome as JSON.")] = False,
) -> None:
    """Write one HTML page: loss and clocks by module, status, orientations, joint angles, events, settings.

    The page loads nothing from elsewhere and prints well. Needs the extra `plot`.
    """
    require_matplotlib()
    target = output or file.with_suffix(".html")
    if target.exists() and not force:
        raise GatewayError(f"{target} exists: name another file with --output, or replace it with --force")
    recording = open_recording(file)
    with progress_bar(f"reading {file.name}", is_shown=not as_json) as tell:
        found = gather(recording, tell)
    write_report(found, target)
    if as_json:
        typer.echo(json.dumps({"file": str(target), "poses": found.n_poses, "defect": found.summary.defect}))
    else:
        typer.echo(f"{target}: {found.summary.duration_s:.1f} s, {found.n_poses} poses")
        if found.summary.defect:
            typer.echo(f"note: {found.summary.defect}", err=True)
