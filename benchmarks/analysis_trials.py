"""Walking over plates and down a stair: trials with force plates and Plug-in-Gait's own moments, analysed."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from devices.marker_files import MarkerTrial, read_c3d
from devices.marker_files.force_plates import ForcePlates, read_force_plates
from gateway.analysis.analysing import Analysis, MeasuredForces, analyse
from gateway.analysis.floor import ForceSource
from gateway.body.body_file import WorldSettings, worn_without_modules
from gateway.body.inertia import BodyInertia, body_inertia
from gateway.frames import FloatArray, IntArray
from gateway.reconstruction.optical.fitting import FitOptions, fit_body
from gateway.reconstruction.optical.marker_set import load_marker_set
from gateway.recording import SkeletonArrays, open_recording
from gateway.recording.optical import write_solved_trial

DATA = Path(__file__).parents[2] / "shared" / "data"
GRAVITY = np.array([0.0, 0.0, -9.81])
CUTOFF_HZ = 6.0


@dataclass(frozen=True)
class TrialFiles:
    """What is analysed."""

    name: str
    static: Path
    moving: Path
    body_kg: float
    """As the trial's file tells."""

    @property
    def is_there(self) -> bool:
        """Whether its files are on this machine."""
        return self.static.is_file() and self.moving.is_file()


WALK = TrialFiles(
    "walk", DATA / "c3d_btk_pig" / "PiG_Calibration-FlatFoot-Full.c3d",
    DATA / "c3d_btk_pig" / "PiG_Motion-FlatFoot-Full.c3d", 47.5,
)  # fmt: skip
STAIR = TrialFiles(
    "stair", DATA / "c3d_pycgm" / "Static_trial.c3d", DATA / "c3d_pycgm" / "Movement_trial.c3d", 85.0
)


@dataclass(frozen=True)
class AnalysedTrial:
    """A trial with its plates."""

    files: TrialFiles
    trial: MarkerTrial
    arrays: SkeletonArrays
    plates: ForcePlates
    inertia: BodyInertia
    measured: Analysis


def analysed(files: TrialFiles) -> AnalysedTrial:
    """Fitted to its static and its moving trial, solved, and analysed with its plates."""
    trials = [read_c3d(files.static), read_c3d(files.moving)]
    fit = fit_body(load_marker_set("plug_in_gait"), trials, FitOptions())
    suit = worn_without_modules(fit.skeleton, fit.markers, WorldSettings())
    with TemporaryDirectory() as folder:
        target = Path(folder) / "solved.mcap"
        write_solved_trial(trials[1], files.moving, suit, "benchmark", target)
        arrays = open_recording(target).skeleton_arrays()
    inertia = body_inertia(fit.skeleton, files.body_kg)
    plates = read_force_plates(files.moving)
    measured = MeasuredForces(plates, fit.markers.vertical)
    found = analyse(arrays, files.name, inertia, GRAVITY, CUTOFF_HZ, measured)
    return AnalysedTrial(files, trials[1], arrays, plates, inertia, found)


def on_plates(found: Analysis, side: str) -> IntArray:
    """(n,) frames in which a foot is on a plate."""
    names = found.skeleton.segment_names
    c = [names[s] for s in found.floor.segments].index(f"{side}_foot")
    return np.flatnonzero(found.floor.source[:, c] == ForceSource.MEASURED)


def rms(values: FloatArray) -> float:
    """Of all values."""
    return float(np.sqrt(np.mean(values**2)))
