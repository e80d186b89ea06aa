"""Marker sets of one's own: the animal that the documentation shows, fitted and solved as a user would."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from devices.marker_files import MarkerTrial
from gateway.errors import GatewayError
from gateway.frames import FloatArray, MarkerFrame
from gateway.geometry import quaternion
from gateway.geometry import rotation_matrix as rm
from gateway.reconstruction.optical.fitted_body import Fit
from gateway.reconstruction.optical.fitting import FitOptions, fit_body
from gateway.reconstruction.optical.marker_set import load_marker_set
from gateway.reconstruction.optical.reconstructor import OpticalReconstructor

DOCUMENT = Path(__file__).parents[4] / "docs" / "guide" / "optical.md"
RATE_HZ = 100.0
LENGTHS = {"thigh": 0.18, "shank": 0.19}
HIP = np.array([-0.11, -0.03, -0.05])
PLACES = {
    "CRL": (0, (0.0, 0.0, -0.06)), "CRR": (0, (0.0, 0.0, 0.06)), "ISC": (0, (-0.16, 0.0, 0.0)),
    "TRO": (1, (0.0, 0.0, -0.03)), "THI": (1, (0.0, -0.09, -0.05)), "STI": (1, (0.0, -0.18, -0.025)),
    "SHA": (2, (0.03, -0.06, -0.02)), "TIB": (2, (0.02, -0.12, 0.01)), "HOC": (2, (0.0, -0.19, -0.015)),
    "HEL": (3, (-0.03, -0.01, 0.0)), "MET": (3, (0.02, -0.08, -0.02)), "TOE": (3, (0.0, -0.13, 0.0)),
}  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The files that the documentation shows."""
    where = tmp_path_factory.mktemp("dog")
    for block in re.findall(r"```yaml\n(# (\S+\.yaml)\n.*?)```", DOCUMENT.read_text(), re.DOTALL):
        (where / block[1]).write_text(block[0])
    return where


def _trot(n: int, scale: float = 1.0) -> tuple[FloatArray, FloatArray]:
    """Hip, stifle and hock angles (n, 3) rad, and markers (n, 12, 3) m; nowhere standing straight."""
    upright = quaternion.to_matrix(np.array([0.5**0.5, 0.5**0.5, 0.0, 0.0]))
    t = np.arange(n) / RATE_HZ
    angles = np.stack(
        [0.2 + 0.5 * np.sin(9 * t), 0.9 + 0.5 * np.sin(9 * t + 1.0), 0.7 + 0.4 * np.sin(9 * t + 2.0)], axis=1
    )
    markers = np.empty((n, len(PLACES), 3))
    for f in range(n):
        R, p = [upright @ rm.from_rotation_vector(np.array([0.0, 0.1 * np.sin(t[f]), 0.0]))], []
        p.append(np.array([1.5 * t[f], 0.0, 0.55 * scale]))
        for joint, turn in zip((HIP, [0, -0.18, 0], [0, -0.19, 0]), (1, -1, 1) * angles[f], strict=True):
            p.append(p[-1] + R[-1] @ (scale * np.asarray(joint)))
            R.append(R[-1] @ rm.from_rotation_vector(np.array([0.0, 0.0, turn])))
        for m, (segment, place) in enumerate(PLACES.values()):
            markers[f, m] = p[segment] + R[segment] @ (scale * np.array(place))
    return angles, markers


def _fitted(folder: Path, scale: float = 1.0) -> Fit:
    markers = _trot(90, scale)[1] + np.random.default_rng(5).normal(0.0, 0.0005, (90, len(PLACES), 3))
    trial = MarkerTrial("trot", tuple(PLACES), RATE_HZ, markers)
    width = 0.04 * scale + 0.01 * (scale - 1.0)  # markers do not shrink with the animal
    told = {"stifle_width": width, "hip_depth": 0.03 * scale, "hock_depth": 0.015 * scale}
    return fit_body(load_marker_set(str(folder / "dog_markers.yaml")), [trial], FitOptions(lengths=told))


@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_the_animal_of_the_documentation_is_fitted_and_solved_from_any_first_pose(folder, scale):
    fit = _fitted(folder, scale)
    body = fit.skeleton
    for parent, child in (("thigh", "shank"), ("shank", "paw")):
        length = np.linalg.norm(body.offsets[body.index(child)])
        assert length == pytest.approx(scale * LENGTHS[parent], abs=0.003)
    angles, markers = _trot(60, scale)
    order = [list(PLACES).index(label) for label in fit.markers.labels]
    reconstructor = OpticalReconstructor(body, fit.markers)
    for f in range(60):
        pose = reconstructor.update(MarkerFrame(f, f * 10_000_000, markers[f, order]))
        thigh, shank = (quaternion.to_matrix(pose.q_wb[body.index(name)]) for name in ("thigh", "shank"))
        turned = np.linalg.norm(rm.increment(thigh, shank))
        assert np.degrees(abs(turned - angles[f, 1])) < 2.0
    assert reconstructor.counts["starts"] == 1


def test_a_trial_of_another_marker_set_is_refused_with_what_it_has(folder):
    trial = MarkerTrial("walk", ("LASI", "RASI", "C7"), RATE_HZ, np.ones((5, 3, 3)))
    marker_set = load_marker_set(str(folder / "dog_markers.yaml"))
    with pytest.raises(
        GatewayError, match="none of the markers of 'dog_markers' is in it; it has LASI, RASI"
    ):
        fit_body(marker_set, [trial], FitOptions(vertical="z"))


def test_a_trial_that_lacks_a_segments_markers_names_them(folder):
    _, markers = _trot(20)
    kept = [m for m, label in enumerate(PLACES) if label not in ("STI", "HOC")]
    trial = MarkerTrial("trot", tuple(np.array(list(PLACES))[kept]), RATE_HZ, markers[:, kept])
    marker_set = load_marker_set(str(folder / "dog_markers.yaml"))
    with pytest.raises(
        GatewayError, match=r"no frame tells how thigh, shank, paw lie: thigh needs stifle, hip"
    ):
        fit_body(marker_set, [trial])
