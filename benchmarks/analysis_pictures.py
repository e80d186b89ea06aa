"""Pictures of an analysis for the guide: ``python -m benchmarks.analysis_pictures``.

A walk with force plates is fitted, solved and analysed as `optical fit` and `analyse` do. Its angles by
percent of the stride go to docs/pictures/analysis_gait.png, three instants of its film to
analysis_muscles.png.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np

from benchmarks.optical import DATA
from devices.marker_files import read_markers
from devices.marker_files.force_plates import read_force_plates
from gateway.analysis import graphs
from gateway.analysis.analysing import MeasuredForces, analyse
from gateway.analysis.drawing import draw, png, scene_of
from gateway.analysis.muscles import find_muscles
from gateway.body.body_file import WorldSettings, worn_without_modules
from gateway.body.inertia import body_inertia
from gateway.errors import GatewayError
from gateway.reconstruction.optical.fitting import fit_body
from gateway.reconstruction.optical.worn_markers import fitting_set
from gateway.recording import open_recording
from gateway.recording.optical import write_solved_trial

FOLDER = Path(__file__).parent.parent / "docs" / "pictures"
STATIC, WALK = (DATA / "c3d_btk_pig" / f"PiG_{name}-FlatFoot-Full.c3d" for name in ("Calibration", "Motion"))
CUTOFF_HZ = 6.0
INSTANTS = 3


def main() -> None:
    """Write both pictures. Raises ``GatewayError`` where the walk is not there."""
    if not WALK.is_file():
        raise GatewayError(f"{WALK} is not there: the pictures are made of it")
    trials = [read_markers(STATIC), read_markers(WALK)]
    fit = fit_body(fitting_set(trials), trials)
    suit = worn_without_modules(fit.skeleton, fit.markers, WorldSettings())
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "walk.mcap"
        write_solved_trial(trials[1], WALK, suit, "walker.yaml", target)
        arrays = open_recording(target).skeleton_arrays()
    weighed = body_inertia(arrays.skeleton, trials[1].parameters["BODYMASS"], None)
    plates = MeasuredForces(read_force_plates(WALK), fit.markers.vertical)
    found = analyse(arrays, WALK.stem, weighed, suit.gravity, CUTOFF_HZ, plates)
    curves = graphs.gait(found, "deg")
    if curves is None:
        raise GatewayError(f"{WALK} has no whole stride: nothing to draw")
    muscles, scene = find_muscles(found), scene_of(found)
    frames = np.linspace(0, len(found.time_s) - 1, 2 * INSTANTS + 1)[1::2].astype(int).tolist()
    drawn = np.hstack([draw(found, muscles, frame, scene) for frame in frames])
    for name, content in (("analysis_gait", curves), ("analysis_muscles", png(drawn))):
        (FOLDER / f"{name}.png").write_bytes(content)
        sys.stdout.write(f"written: {FOLDER / name}.png\n")


if __name__ == "__main__":
    main()
