"""``mocap-gateway optical fit``: the body of a person from calibration trials."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.table import Column, Table

from devices.marker_files import MarkerTrial, read_markers
from gateway.body.subject_file import subject_content, write_subject
from gateway.cli.progress import progress_bar
from gateway.cli.spans import seconds_of
from gateway.errors import GatewayError
from gateway.reconstruction.optical.fitting import Fit, FitOptions, fit_body
from gateway.reconstruction.optical.landmarks import MOST_ANGLE
from gateway.reconstruction.optical.marker_set import load_marker_set
from gateway.reconstruction.optical.worn_markers import fitting_set
from gateway.recording.suit_files import body_of

MOST_UNEVEN = 1.15
"""Longer over shorter, of the two segments of one name: beyond it a marker may sit elsewhere."""


def fit(
    files: Annotated[
        list[Path], typer.Argument(help="Calibration trials, C3D or TRC: a static one first, then motion.")
    ],
    marker_set: Annotated[
        str | None,
        typer.Option(
            "--set", metavar="SET", help="Marker set: a shipped one, or a file; without: the one that fits."
        ),
    ] = None,
    person: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Whose markers, where files hold several people's (NAME:LASI)."),
    ] = None,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="The subject file; default: after the first trial.")
    ] = None,
    measure: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=METRES", help="A length of the person; without: as the files tell."),
    ] = None,
    angle: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=DEGREES",
            help="By which a wand lies ahead of its joint's axis, such as left_thigh_rotation=8; without: as "
            "the files tell.",
        ),
    ] = None,
    up: Annotated[str | None, typer.Option(help="Axis of the files that points up: x, y or z.")] = None,
    neutral: Annotated[
        str | None,
        typer.Option(
            metavar="FROM:TO", help="Seconds of neutral standing in the first trial: sets the axes."
        ),
    ] = None,
    functional: Annotated[
        bool,
        typer.Option("--functional", help="Joint centres where the motion has them, whatever rules say."),
    ] = False,
    rules_only: Annotated[
        bool, typer.Option("--rules-only", help="Joint centres where the rules have them, whatever moves.")
    ] = False,
    force: Annotated[bool, typer.Option("--force", help="Replace an existing subject file.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the outcome as JSON.")] = False,
) -> None:
    """Fit a body to marker trials: bone lengths, joint centres, where markers sit. Writes a subject file.

    Joint centres come from the marker set's rules (published regressions) and, as far as the trials move the
    joints, from the motion.
    """
    target = output or files[0].with_suffix(".yaml")
    if target.exists() and not force:
        raise GatewayError(f"{target} exists: name another file with --output, or replace it with --force")
    if functional and rules_only:
        raise GatewayError("--functional and --rules-only contradict each other: leave one out")
    options = FitOptions(
        vertical=_axis(up),
        lengths=dict(map(_measurement, measure or [])),
        angles=dict(map(_angle, angle or [])),
        neutral=None if neutral is None else seconds_of("--neutral", neutral),
        centres="motion" if functional else "rules" if rules_only else "both",
        person=person,
    )
    known = None if marker_set is None else load_marker_set(marker_set)
    trials = _read(files, not as_json)
    chosen = known or fitting_set(trials, person)
    with progress_bar("fitting the body", is_shown=not as_json) as tell:
        found = fit_body(chosen, trials, options, tell)
    outcome = _outcome(found, files, target)
    _write(found, outcome, target)
    if as_json:
        typer.echo(json.dumps(outcome, indent=2))
    else:
        _print(found, outcome)


def _read(files: list[Path], is_shown: bool) -> list[MarkerTrial]:
    with progress_bar("reading", is_shown=is_shown) as tell:
        trials = []
        for done, file in enumerate(files):
            tell(done, len(files))
            trials.append(read_markers(file))
    return trials


def _write(found: Fit, outcome: dict[str, object], target: Path) -> None:
    content = subject_content(
        target.stem, found.marker_set, body_of(found.skeleton), found.skeleton, found.markers,
        {key: outcome[key] for key in ("trials", "frames", "rmse_mm")}, found.lengths, found.angles,
    )  # fmt: skip
    try:
        write_subject(target, content)
    except OSError as error:
        raise GatewayError(f"{target} cannot be written: {error.strerror}") from error


def _axis(text: str | None) -> str | None:
    if text is not None and text not in {"x", "y", "z"}:
        raise GatewayError(f"--up {text}: x, y or z is wanted")
    return text


def _measurement(text: str) -> tuple[str, float]:
    name, _, value = text.partition("=")
    try:
        length = float(value)
    except ValueError:
        length = 0.0
    if not 0.001 < length < 2:
        raise GatewayError(f"--measure {text}: NAME=METRES is wanted, such as left_knee_width=0.105")
    return name, length


def _angle(text: str) -> tuple[str, float]:
    name, _, value = text.partition("=")
    try:
        angle = math.radians(float(value))
    except ValueError:
        angle = math.nan
    if not abs(angle) <= MOST_ANGLE:
        raise GatewayError(f"--angle {text}: NAME=DEGREES is wanted, such as left_thigh_rotation=8")
    return name, angle


def _outcome(found: Fit, files: list[Path], target: Path) -> dict[str, object]:
    names = found.skeleton.segment_names
    lengths_mm = {
        name: round(1e3 * float(np.linalg.norm(tip)), 1)
        for name, tip in zip(names, found.skeleton.tips, strict=True)
    }
    return {
        "file": str(target),
        "marker_set": found.marker_set,
        "trials": [file.name for file in files],
        "frames": found.frames,
        "rmse_mm": round(1e3 * found.rmse, 2),
        "markers": len(found.markers.labels),
        "assumed": list(found.assumed),
        "up": found.markers.vertical,
        "angles_deg": {name: round(math.degrees(a), 2) for name, a in found.angles.items() if a},
        "left_out": list(found.left_out),
        "lengths_mm": lengths_mm,
        "uneven": uneven_sides(lengths_mm),
        "moved_mm": {name: round(1e3 * float(d), 1) for name, d in zip(names, found.moved, strict=True)},
        "sigma_mm": {
            label: round(1e3 * float(s), 1)
            for label, s in zip(found.markers.labels, found.markers.sigmas, strict=True)
        },
    }


def uneven_sides(lengths_mm: Mapping[str, float]) -> list[tuple[str, str]]:
    """Segments of the left and of the right, the longer more than ``MOST_UNEVEN`` times the shorter."""
    pairs = [(name, name.replace("left_", "right_", 1)) for name in lengths_mm if name.startswith("left_")]
    return [
        (left, right)
        for left, right in pairs
        if right in lengths_mm
        and max(lengths_mm[left], lengths_mm[right]) > MOST_UNEVEN * min(lengths_mm[left], lengths_mm[right])
    ]


def _worn(found: Fit, name: str) -> str:
    """Labels of the markers on a segment."""
    segment = found.skeleton.segment_names.index(name)
    on = zip(found.markers.labels, found.markers.segments, strict=True)
    return " ".join(label for label, where in on if where == segment)


def _print(found: Fit, outcome: dict[str, object]) -> None:
    lengths, moved = outcome["lengths_mm"], outcome["moved_mm"]
    assert isinstance(lengths, dict)
    assert isinstance(moved, dict)
    table = Table(Column("segment", no_wrap=True), "length mm", "joint moved by motion mm", "markers")
    for name in found.skeleton.segment_names:
        table.add_row(name, f"{lengths[name]:.0f}", f"{moved[name]:.0f}", _worn(found, name) or "–")
    Console().print(table)
    typer.echo(
        f"{outcome['file']}: {outcome['markers']} markers of {found.marker_set}, {outcome['frames']} frames, "
        f"rest {outcome['rmse_mm']} mm RMS, {found.markers.vertical} up"
    )
    for name, angle in found.angles.items():
        if angle:
            typer.echo(f"{name}: {math.degrees(angle):.1f}° (--angle {name}=0 takes the wand as it stands)")
    if found.left_out:
        typer.echo(f"note: no markers on {', '.join(found.left_out)}: the body goes without them", err=True)
    for left, right in uneven_sides(lengths):
        typer.echo(
            f"note: {left} is {lengths[left]:.0f} mm long, {right} {lengths[right]:.0f} mm: do markers of "
            f"one name sit at the same place on both sides ({_worn(found, left)}; {_worn(found, right)})?",
            err=True,
        )
    for name in found.assumed:
        typer.echo(
            f"note: {name} is told by no file: {found.lengths[name]} m taken (--measure {name}=…)", err=True
        )
