"""How upper arms are turned about their length: by the plane in which elbows bend, whatever skin does."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from devices.marker_files import read_markers
from gateway.body.body_file import load_body
from gateway.emulation import optical_truth
from gateway.emulation.optical_truth import SimulatedTrial, placed_markers, simulated
from gateway.frames import FloatArray
from gateway.geometry import quaternion
from gateway.reconstruction.optical import point_rules
from gateway.reconstruction.optical.anchoring import turns_to_bending
from gateway.reconstruction.optical.bundle import _loose
from gateway.reconstruction.optical.fitted_body import Fit
from gateway.reconstruction.optical.fitting import FitOptions, fit_body
from gateway.reconstruction.optical.joint_ranges import shown_joints
from gateway.reconstruction.optical.landmarks import landmarks_of, measurements
from gateway.reconstruction.optical.marker_set import load_marker_set
from gateway.reconstruction.optical.pose_solver import FIXED_SIGMA, BodyModel, Pose, body_model
from gateway.reconstruction.optical.reconstructor import OpticalReconstructor
from gateway.reconstruction.optical.worn_markers import worn_part
from tests.gateway.reconstruction.optical.test_optical_gaps import _markers

DATA = Path(os.environ.get("MOCAP_DATA", Path(__file__).parents[5] / "shared" / "data"))
TRIAL = DATA / "trc_opensim" / "subject01_static.trc"
BODY = load_body("human_17")
ARM, FOREARM = BODY.index("left_upper_arm"), BODY.index("left_forearm")


def _poses(flexions_deg: FloatArray, turned_deg: float, carrying_deg: float = 0.0) -> list[Pose]:
    """An elbow that bends, of an upper arm whose axes are turned about its length by so much."""
    n = BODY.n_segments
    poses = []
    for flexion in flexions_deg:
        R = np.tile(quaternion.to_matrix(BODY.neutral), (n, 1, 1))
        R[FOREARM] = R[ARM] @ Rotation.from_euler("ZX", [flexion, carrying_deg], degrees=True).as_matrix()
        R[ARM] = R[ARM] @ Rotation.from_euler("y", turned_deg, degrees=True).as_matrix()
        zero = np.zeros(1)
        poses.append(Pose(R, np.zeros(3), zero, zero, np.eye(3 + 3 * n)))
    return poses


def _model() -> BodyModel:
    return body_model(BODY, _markers())


@pytest.mark.parametrize("turned_deg", [-70.0, 0.0, 25.0, 160.0])
def test_the_plane_of_bending_turns_the_upper_arm_back(turned_deg: float) -> None:
    poses = _poses(np.linspace(0.0, 120.0, 30), turned_deg)
    turns = turns_to_bending(_model(), poses, [FOREARM])
    found = Rotation.from_matrix(turns[ARM]).as_euler("yxz", degrees=True)
    assert found[0] == pytest.approx(-turned_deg, abs=1e-6)
    assert np.abs(found[1:]).max() < 1e-6
    np.testing.assert_array_equal(np.delete(turns, ARM, axis=0), np.tile(np.eye(3), (len(turns) - 1, 1, 1)))


def test_an_arm_that_stays_straight_tells_nothing() -> None:
    turns = turns_to_bending(_model(), _poses(np.linspace(0.0, 12.0, 30), 50.0), [FOREARM])
    np.testing.assert_array_equal(turns[ARM], np.eye(3))


def test_what_an_elbow_does_not_have_stays_held_though_markers_show_it() -> None:
    model, poses = _model(), _poses(np.linspace(0.0, 100.0, 40), 0.0, carrying_deg=40.0)
    joint = next(j for j in BODY.joints if j.distal == FOREARM)
    before = {angle.name: angle.limits for angle in joint.angles}
    held = next(j for j in shown_joints(BODY, model, poses, [FOREARM]) if j.distal == FOREARM)
    loose = next(j for j in shown_joints(BODY, model, poses) if j.distal == FOREARM)
    assert "carrying" not in held.free
    assert "carrying" in loose.free
    assert {angle.name: angle.limits for angle in held.angles}["carrying"] == before["carrying"]
    row = model.distals.tolist().index(FOREARM)
    carrying = [angle.name for angle in joint.angles].index("carrying")
    assert _loose(model, [FOREARM]).stiffness[row, carrying] == pytest.approx(FIXED_SIGMA**-2)
    assert _loose(model).stiffness[row, carrying] < 0.1 * FIXED_SIGMA**-2


@pytest.mark.timeout(1200)
def test_hips_beside_their_regression_are_found_from_exact_markers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where nothing slides, the motion shows joints by itself, and is believed unasked."""
    monkeypatch.setattr(optical_truth, "NOISE", 1e-6)
    monkeypatch.setattr(optical_truth, "MISPLACED", 0.0)
    whole = load_marker_set("plug_in_gait")
    marker_set = worn_part(whole, optical_truth.simulated_labels(whole))
    generator = np.random.default_rng(3)
    places, segments = placed_markers(marker_set, marker_set.body, generator)
    seen = simulated(marker_set, marker_set.body, places, segments, 6.0, generator, faults=False)
    fitted = fit_body(marker_set, [seen.trial], FitOptions(vertical="z"))
    assert fitted.centres.is_functional
    reconstructor = OpticalReconstructor(fitted.skeleton, fitted.markers)
    observed = seen.trial.columns(fitted.markers.labels)
    for name in ("left_thigh", "right_thigh"):
        reconstructor.reset()
        frame = optical_truth.MarkerFrame(0, 0, observed[300])
        found = reconstructor.update(frame).p_w[fitted.skeleton.index(name)]
        assert np.linalg.norm(found - seen.p_w[300, marker_set.body.index(name)]) < 0.002
    held = fit_body(marker_set, [seen.trial], FitOptions(vertical="z", centres="rules"))
    for name, most in (("pelvis", 0.1), ("left_thigh", 0.2), ("right_thigh", 0.2)):
        assert _off_deg(held, seen, name) > 1.0
        assert _off_deg(fitted, seen, name) < most
    noisy = np.random.default_rng(4).normal(0.0, 0.005, seen.trial.positions.shape)
    sliding = replace(seen.trial, positions=seen.trial.positions + noisy)
    assert not fit_body(marker_set, [sliding], FitOptions(vertical="z")).centres.is_functional


def _off_deg(fitted: Fit, seen: SimulatedTrial, name: str) -> float:
    """RMS turn of a segment against the truth, once what is the same in all frames is left out: axes of rules
    are not those of the truth."""
    reconstructor = OpticalReconstructor(fitted.skeleton, fitted.markers)
    observed = seen.trial.columns(fitted.markers.labels)
    chosen = np.arange(0, len(observed), 10)
    frames = [optical_truth.MarkerFrame(int(f), int(f) * 10_000_000, observed[f]) for f in chosen]
    s = fitted.skeleton.index(name)
    found = Rotation.from_quat([reconstructor.update(f).q_wb[s] for f in frames], scalar_first=True)
    apart = Rotation.from_quat(seen.q_wb[chosen, s], scalar_first=True).inv() * found
    return float(np.degrees(np.sqrt(((apart.mean().inv() * apart).magnitude() ** 2).mean())))


@pytest.mark.parametrize(("side", "outwards"), [("left", 1.0), ("right", -1.0)])
@pytest.mark.parametrize("flexion_deg", [40.0, 90.0, 140.0])
def test_elbows_lie_inside_lateral_markers_on_both_sides(
    side: str, outwards: float, flexion_deg: float
) -> None:
    shoulder, elbow = np.array([[0.0, 0.0, 1.4]]), np.array([[0.0, 0.0, 1.1]])
    marker = elbow + np.array([0.0, 0.045 * outwards, 0.0])
    bent = np.radians(flexion_deg)
    wrist = elbow + 0.25 * np.array([np.sin(bent), 0.0, -np.cos(bent)])
    found = point_rules.right_triangle(shoulder, marker, wrist, 0.045, side)
    assert np.linalg.norm(found - elbow) < 0.025  # the marker beside the bones turns their plane a little
    assert outwards * (found - marker)[0, 1] < -0.03


@pytest.mark.skipif(not TRIAL.is_file(), reason="no recordings: set MOCAP_DATA")
def test_rules_bend_both_elbows_of_a_standing_person_forward() -> None:
    marker_set, trial = load_marker_set("opensim_41"), read_markers(TRIAL)
    measured = measurements(marker_set, [trial], {})
    axes = landmarks_of(marker_set, trial, "y", measured).places().axes[::50]
    for side in ("left", "right"):
        arm, forearm = BODY.index(f"{side}_upper_arm"), BODY.index(f"{side}_forearm")
        ahead = np.einsum("fi,fi->f", axes[:, arm, :, 0], -axes[:, forearm, :, 1])
        assert (ahead > 0.2).all()
