"""Real lenses from the pictures of a board held by hand, beside the shipped calibration."""

import os
from pathlib import Path

import pytest

pytest.importorskip("cv2")

from benchmarks.camera_boards import real_lens
from gateway.calibration.cameras_import import import_cameras

REAL = Path(os.environ.get("MOCAP_DATA", Path(__file__).parents[3] / "shared/data")) / "pose2sim_single"


@pytest.mark.parametrize(
    "which",
    [0, *(pytest.param(k, marks=pytest.mark.slow(reason="as the first, 4 s each")) for k in range(1, 4))],
)
def test_real_lenses_are_those_of_the_shipped_calibration(which):
    """Seven pictures of a board held by hand, each left out in turn."""
    if not REAL.is_dir():
        pytest.skip("no recording pose2sim_single beside the repository")
    camera = import_cameras(REAL / "calibration/Calib.qca.txt")[which]
    lens = real_lens(REAL, camera)
    assert lens.focal_px == pytest.approx(camera.matrix[0, 0], rel=0.01)
    assert lens.held_out_px < 2.0
