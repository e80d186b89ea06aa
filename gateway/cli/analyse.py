"""``mocap-gateway analyse``: from recorded motion to torques, floor forces and muscles."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer

from gateway.analysis.smooth_motion import DEFAULT_CUTOFF_HZ
from gateway.body.inertia import BodyInertia, body_inertia
from gateway.body.skeleton import Skeleton, WornSuit
from gateway.cli.options import AsJson
from gateway.cli.terminal import progress_bar
from gateway.errors import GatewayError
from gateway.support.whole_files import writing

if TYPE_CHECKING:
    from gateway.analysis.analysing import Analysis, MeasuredForces
    from gateway.analysis.muscle_paths import MusclePaths
    from gateway.analysis.muscle_settings import MuscleCosts
    from gateway.analysis.muscles import MuscleResult
    from gateway.recording import SkeletonArrays


MASS_PARAMETERS = ("BODYMASS", "WEIGHT")
_NO_MASS = "{file} does not tell what the person weighs: tell it with --mass KG"
"""Where C3D files tell a person's mass, kg."""


class Sex(StrEnum):
    """Whose tables of masses are taken."""

    FEMALE = "female"
    MALE = "male"


class TableKind(StrEnum):
    """How tables are written."""

    CSV = "csv"
    PARQUET = "parquet"


def analyse_file(
    file: Annotated[
        Path, typer.Argument(help="Recording, or trial of markers (C3D, TRC, …) with --subject.")
    ],
    subject: Annotated[
        str | None, typer.Option("--subject", "-s", help="Subject file of `optical fit`, for trials.")
    ] = None,
    person: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Whose markers, where trials hold several people's (NAME:LASI)."),
    ] = None,
    mass: Annotated[
        float | None, typer.Option(min=2, max=400, help="Of the person, kg; else as the trial's file tells.")
    ] = None,
    sex: Annotated[Sex | None, typer.Option(help="For the masses of segments; else the mean.")] = None,
    forces: Annotated[
        str,
        typer.Option(metavar="auto|none|FILE", help="Force plates: the trial's, none, a C3D's, a .mot."),
    ] = "auto",
    muscles: Annotated[
        str,
        typer.Option(metavar="auto|none|FILE", help="Muscles: where the body has legs, none, or by a YAML."),
    ] = "auto",
    film: Annotated[bool, typer.Option("--film", help="Film of the body and its muscles too, WebM.")] = False,
    slower: Annotated[float, typer.Option(min=0.1, max=50, help="How much slower the film runs.")] = 1.0,
    cutoff: Annotated[
        float, typer.Option(min=0, help="Low-pass without lag, Hz; 0: none.")
    ] = DEFAULT_CUTOFF_HZ,
    inertia: Annotated[
        Path | None, typer.Option(help="YAML of what segments weigh, for bodies that are no person.")
    ] = None,
    to: Annotated[TableKind, typer.Option(help="Format of the tables.")] = TableKind.CSV,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Folder; else NAME_analysis beside the file.")
    ] = None,
    force: Annotated[bool, typer.Option("--force", "-f", help="Write into a folder that is there.")] = False,
    as_json: AsJson = False,
) -> None:
    """Analyse a motion: joint torques, floor forces, muscles, as tables, one HTML page and a film.

    Floor forces are those of the trial's force plates, or estimated where there are none. Needs the extras
    `biomech` and `plot`.
    """
    from gateway.analysis.analysing import analyse

    _refuse_unfit(file, mass, inertia, is_trial=subject is not None)
    folder = _folder(file, output, force=force)
    with progress_bar(f"reading {file.name}", is_shown=not as_json) as progress:
        arrays, suit, recorded_kg = _motion(file, subject, person, progress)
    weighed = _inertia(arrays.skeleton, mass or recorded_kg, sex, inertia, file)
    measured = _measured(file, forces, suit)
    with progress_bar("torques", is_shown=not as_json) as progress:
        found = analyse(
            arrays, file.stem, weighed, suit.gravity, cutoff or None, measured, lambda _: progress
        )
    with progress_bar("muscles", is_shown=not as_json) as progress:
        pulled = _muscles(found, muscles, progress)
    written = _write(found, pulled, folder, to, slower if film else None, as_json)
    _print_summary(found, pulled, folder, written, as_json)


def _refuse_unfit(file: Path, mass: float | None, inertia: Path | None, *, is_trial: bool) -> None:
    """Raise ``GatewayError`` without the extras and without what the body weighs, ``RecordingError`` for a
    file that cannot be read, before any of it is."""
    from devices.marker_files import SUFFIXES as MARKER_SUFFIXES
    from gateway.analysis.body_model import require_biomech
    from gateway.recording import open_recording
    from gateway.support.extras import require_package

    require_biomech()
    require_package("matplotlib")
    if file.is_dir():
        raise GatewayError(f"{file} is a folder: name a recording, or a trial of markers, in it")
    if not file.exists():
        raise GatewayError(f"{file} cannot be read: no such file")
    if mass is not None and inertia is not None:
        raise GatewayError("--mass and --inertia both tell what the body weighs: leave one of them out")
    if not is_trial and file.suffix.lower() not in MARKER_SUFFIXES:
        open_recording(file)
        if mass is None and inertia is None:
            raise GatewayError(_NO_MASS.format(file=file))


def _folder(file: Path, output: Path | None, *, force: bool) -> Path:
    """Return where the results go. Raises ``GatewayError`` where something is already."""
    folder = output or file.with_name(f"{file.stem}_analysis")
    if folder.exists() and not force:
        raise GatewayError(f"{folder} exists: name another folder with --output, or add to it with --force")
    return folder


def _write(
    found: Analysis, pulled: MuscleResult | None, folder: Path, to: TableKind, slower: float | None,
    as_json: bool,
) -> list[Path]:  # fmt: skip
    """Everything into the folder. slower: of the film; None: without."""
    from gateway.analysis.film import write_film
    from gateway.analysis.opensim_loads import write_loads
    from gateway.analysis.page import write_page
    from gateway.analysis.tables import write_tables

    page, moving = folder / "report.html", folder / "film.webm"
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        written = [*write_tables(found, pulled, folder, to.value), *write_loads(found, folder)]
    if slower is not None:
        with progress_bar("film", is_shown=not as_json) as progress:
            write_film(found, pulled, moving, slower, progress)
    write_page(found, pulled, page, None if slower is None else moving)
    return [*written, page, *([] if slower is None else [moving])]


def _muscles(found: Analysis, muscles: str, progress: Callable[[int, int], None]) -> MuscleResult | None:
    """Return those asked for; None where none were, or none were asked for and the body has no legs."""
    from gateway.analysis.muscle_settings import load_costs
    from gateway.analysis.muscles import find_muscles, has_muscles

    if muscles == "none" or (muscles == "auto" and not has_muscles(found.skeleton)):
        return None
    if muscles == "auto":
        return find_muscles(found, progress=progress)
    path = Path(muscles)

    def costs(paths: MusclePaths) -> MuscleCosts:
        names = tuple(wire.name for wire in paths.wires)
        peaks = np.array([wire.peak_force_n for wire in paths.wires])
        return load_costs(path, names, peaks, found.time_s)

    return find_muscles(found, costs, progress)


def _motion(
    file: Path, subject: str | None, person: str | None, progress: Callable[[int, int], None]
) -> tuple[SkeletonArrays, WornSuit, float | None]:
    """Return the poses, who made them, and the mass that the file tells, kg."""
    from devices.marker_files import SUFFIXES as MARKER_SUFFIXES
    from devices.marker_files import read_markers
    from gateway.body.rig import load_rig
    from gateway.recording import open_recording
    from gateway.recording.optical import write_solved_trial

    if file.suffix.lower() not in MARKER_SUFFIXES:
        if subject is not None:
            raise GatewayError(f"--subject goes with trials of markers (C3D, TRC, …); {file} is none")
        if person is not None:
            raise GatewayError(f"--person goes with trials of markers (C3D, TRC, …); {file} is none")
        recording = open_recording(file)
        return recording.skeleton_arrays(progress), recording.meta.suit, None
    if subject is None:
        raise GatewayError(
            f"{file} holds markers: name the person with --subject, a file of `mocap-gateway optical fit`"
        )
    suit = load_rig(subject)
    trial = read_markers(file)
    for note in trial.notes:
        typer.echo(f"note: {note}", err=True)
    mass_kg = next(
        (trial.parameters[key] for key in MASS_PARAMETERS if trial.parameters.get(key, 0) > 0), None
    )
    with tempfile.TemporaryDirectory(prefix="mocap-analysis-") as folder:
        target = Path(folder) / "solved.mcap"
        write_solved_trial(trial, file, suit, subject, target, progress, person)
        return open_recording(target).skeleton_arrays(), suit, mass_kg


def _inertia(
    skeleton: Skeleton, kg: float | None, sex: Sex | None, table: Path | None, file: Path
) -> BodyInertia:
    from gateway.analysis.inertia_file import load_inertia

    if table is not None:
        return load_inertia(table, skeleton)
    if kg is None:
        raise GatewayError(_NO_MASS.format(file=file))
    return body_inertia(skeleton, kg, None if sex is None else sex.value)


def _measured(file: Path, forces: str, suit: WornSuit) -> MeasuredForces | None:
    """Return the plates asked for; None where there are none and none were asked for."""
    from devices.marker_files.force_plates import read_force_plates
    from devices.marker_files.ground_reaction import SUFFIXES as REACTION_SUFFIXES
    from devices.marker_files.ground_reaction import read_ground_reactions
    from gateway.analysis.analysing import MeasuredForces

    source = file if forces == "auto" else Path(forces)
    if forces == "none" or (forces == "auto" and file.suffix.lower() != ".c3d"):
        return None
    if source.suffix.lower() in REACTION_SUFFIXES:
        return MeasuredForces(read_ground_reactions(source), "y")
    plates = read_force_plates(source)
    if not plates.plates:
        if forces == "auto":
            return None
        raise GatewayError(f"--forces {source}: it has no force plates")
    return MeasuredForces(plates, "z" if suit.markers is None else suit.markers.vertical)


def _print_summary(
    found: Analysis, pulled: MuscleResult | None, folder: Path, written: list[Path], as_json: bool
) -> None:
    left = float(np.sqrt(np.mean(np.sum(found.dynamics.residual_force**2, axis=1))))
    if as_json:
        outcome = {
            "folder": str(folder),
            "files": [path.name for path in written],
            "frames": len(found.time_s),
            "mass_kg": round(found.inertia.body_kg, 3),
            "residual_force_rms_n": round(left, 2),
            "muscles": 0 if pulled is None else len(pulled.names),
            "notes": list(found.notes),
        }
        typer.echo(json.dumps(outcome, indent=2))
        return
    typer.echo(f"{folder}: {len(found.time_s)} frames; {', '.join(path.name for path in written)}")
    for note in found.notes:
        typer.echo(note)
