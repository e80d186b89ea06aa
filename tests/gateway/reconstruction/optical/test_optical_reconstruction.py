"""Markers to skeleton: equations against finite differences, a small robot against its truth, real trials."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from devices.links.marker_file_link import trial_chunks
from devices.marker_files import MarkerTrial, read_markers
from gateway.body.body_file import load_body
from gateway.body.rig import load_rig
from gateway.body.skeleton import BodyMarkers, Skeleton
from gateway.body.subject_file import subject_content, write_subject
from gateway.errors import GatewayError, SettingsError
from gateway.frames import FloatArray, MarkerFrame, Status
from gateway.geometry import quaternion
from gateway.geometry import rotation_matrix as rm
from gateway.pipeline import Pipeline
from gateway.reconstruction.optical import kernels, point_rules
from gateway.reconstruction.optical.fitting import FitOptions, fit_body
from gateway.reconstruction.optical.landmarks import landmarks_of, measurements, to_world, vertical_axis
from gateway.reconstruction.optical.marker_set import load_marker_set
from gateway.reconstruction.optical.pose_solver import BodyModel, body_model, normal_equations
from gateway.reconstruction.optical.published_chains import chain_gradient, chains_of
from gateway.reconstruction.optical.reconstructor import OpticalReconstructor
from gateway.recording.optical import optical_settings
from gateway.recording.snapshot import body_of
from gateway.stages.markers import MarkerStage

DATA = Path(os.environ.get("MOCAP_DATA", Path(__file__).parents[5] / "shared" / "data"))
needs_data = pytest.mark.skipif(not (DATA / "c3d_pycgm").is_dir(), reason="recordings are not here")
BTK = "c3d_btk_pig/PiG_Calibration-FlatFoot-Full.c3d", "c3d_btk_pig/PiG_Motion-FlatFoot-Full.c3d"


def _person(n_each: int = 4, seed: int = 0) -> tuple[Skeleton, BodyMarkers, BodyModel]:
    body = load_body("human_17")
    generator = np.random.default_rng(seed)
    segments = np.repeat(np.arange(body.n_segments), n_each)
    places = generator.normal(0.0, 0.08, (len(segments), 3))
    labels = tuple(f"m{i}" for i in range(len(segments)))
    markers = BodyMarkers(labels, segments, places, np.full(len(segments), 0.004))
    return body, markers, body_model(body, markers)


def _pose(body: Skeleton, generator: np.random.Generator, spread: float) -> FloatArray:
    R = [quaternion.to_matrix(body.neutral)]
    for s in range(1, body.n_segments):
        R.append(R[body.parents[s]] @ rm.from_rotation_vector(generator.normal(0.0, spread, 3)))
    return np.array(R)


def _numeric_gradient(model: BodyModel, seen: FloatArray, R: FloatArray, root: FloatArray) -> FloatArray:
    def cost(delta: FloatArray) -> float:
        turned, moved = kernels.moved(model.parents, R, root, delta)
        p = model.joints_at(turned, moved)
        apart = seen - model.markers_at(turned, moved)
        joints = normal_equations(model, seen, np.ones(len(seen)), turned, p)[2]
        return float(0.5 * (apart**2).sum() / 0.004**2 + joints)

    steps = 1e-6 * np.eye(3 + 3 * len(model.parents))
    return np.array([(cost(-step) - cost(step)) / 2e-6 for step in steps])


def test_gradient_of_markers_and_joints_is_that_of_differences() -> None:
    body, _, model = _person()
    generator = np.random.default_rng(1)
    R, root = _pose(body, generator, 0.4), np.array([0.1, -0.2, 0.9])
    seen = model.markers_at(R, root) + generator.normal(0.0, 0.01, (len(model.segments), 3))
    p = model.joints_at(R, root)
    _, g, _ = normal_equations(model, seen, np.ones(len(seen)), R, p)
    np.testing.assert_allclose(g, _numeric_gradient(model, seen, R, root), atol=1e-4 * np.abs(g).max())


def test_cholesky_solves() -> None:
    A = np.random.default_rng(2).normal(size=(9, 9))
    A = A @ A.T + np.eye(9)
    b = np.arange(9.0)
    L = A.copy()
    assert kernels.cholesky(L)
    np.testing.assert_allclose(A @ kernels.substituted(L, b), b, atol=1e-9)
    assert not kernels.cholesky(-A)


def _frames(markers: FloatArray) -> list[MarkerFrame]:
    return [MarkerFrame(f, f * 10_000_000, seen) for f, seen in enumerate(markers)]


def _walk(model: BodyModel, body: Skeleton, n: int) -> tuple[FloatArray, FloatArray]:
    """Orientations (n, S, 3, 3) of a smooth motion, and markers (n, M, 3)."""
    generator = np.random.default_rng(4)
    axes = generator.normal(0.0, 0.25, (body.n_segments, 3))
    poses, markers = [], []
    for f in range(n):
        R = [quaternion.to_matrix(body.neutral)]
        for s in range(1, body.n_segments):
            R.append(R[body.parents[s]] @ rm.from_rotation_vector(axes[s] * np.sin(0.05 * f + s)))
        poses.append(R)
        markers.append(model.markers_at(np.array(R), np.array([0.01 * f, 0.0, 0.9])))
    return np.array(poses), np.array(markers)


def _worst_deg(reconstructor: OpticalReconstructor, frames: list[MarkerFrame], R: FloatArray) -> float:
    worst = 0.0
    for frame, truth in zip(frames, R, strict=True):
        q_wb = reconstructor.update(frame).q_wb
        for q, true in zip(q_wb, truth, strict=True):
            worst = max(worst, quaternion.angle_between(q, quaternion.from_matrix(true)))
    return float(np.degrees(worst))


def test_clean_markers_give_the_pose_from_nowhere_and_on() -> None:
    body, markers, model = _person()
    R, seen = _walk(model, body, 40)
    reconstructor = OpticalReconstructor(body, markers)
    assert (
        _worst_deg(reconstructor, _frames(seen), R) < 0.5
    )  # some joints pass their limits, which pull a little
    assert reconstructor.counts["starts"] == 1
    assert reconstructor.last is not None
    assert reconstructor.last.rmse < 1e-3


def test_swapped_ghost_missing_and_nameless_markers_are_put_right() -> None:
    body, markers, model = _person()
    R, seen = _walk(model, body, 40)
    given, nameless = seen.copy(), np.full((40, 1, 3), np.nan)
    given[10:20, [40, 41]] = given[10:20, [41, 40]]  # swapped
    given[15:25, 30] += 0.3  # a ghost
    nameless[20:30, 0] = given[20:30, 20]  # lost its name
    given[20:30, 20] = np.nan
    given[5:35:3, 50] = np.nan
    frames = [
        MarkerFrame(f, f * 10_000_000, place, point)
        for f, (place, point) in enumerate(zip(given, nameless, strict=True))
    ]
    reconstructor = OpticalReconstructor(body, markers)
    assert _worst_deg(reconstructor, frames[:15], R[:15]) < 0.5
    assert reconstructor.last is not None
    assert {(40, 41), (41, 40)} <= set(reconstructor.last.renamed)
    assert _worst_deg(reconstructor, frames[15:25], R[15:25]) < 0.5
    assert reconstructor.last is not None
    assert (20, -1) in reconstructor.last.renamed
    assert not reconstructor.last.used[30]
    assert _worst_deg(reconstructor, frames[25:], R[25:]) < 0.5


def test_without_markers_the_pose_is_held_and_before_any_it_is_missing() -> None:
    body, markers, model = _person()
    _, seen = _walk(model, body, 2)
    nothing = np.full_like(seen[0], np.nan)
    reconstructor = OpticalReconstructor(body, markers)
    frame = reconstructor.update(MarkerFrame(0, 0, nothing))
    assert (frame.status == Status.MISSING).all()
    assert np.isnan(frame.q_wb).all()
    found = reconstructor.update(MarkerFrame(1, 10_000_000, seen[0]))
    held = reconstructor.update(MarkerFrame(2, 20_000_000, nothing))
    assert (held.status == Status.HELD).all()
    np.testing.assert_array_equal(held.q_wb, found.q_wb)
    assert reconstructor.counts["lost"] == 2


def test_rates_are_those_of_the_motion() -> None:
    body, markers, model = _person()
    reconstructor = OpticalReconstructor(body, markers)
    turned = quaternion.to_matrix(body.neutral)
    for f in range(20):
        t = 0.01 * f
        R = np.tile(rm.from_rotation_vector(np.array([0.0, 0.0, 1.5 * t])) @ turned, (body.n_segments, 1, 1))
        seen = model.markers_at(R, np.array([0.0, 0.0, 0.9 + 2.0 * t * t]))
        frame = reconstructor.update(MarkerFrame(f, f * 10_000_000, seen))
    np.testing.assert_allclose(frame.angular_rate[0], turned.T @ [0.0, 0.0, 1.5], atol=0.02)
    np.testing.assert_allclose(frame.joint_acceleration[0], [0.0, 0.0, 4.0], atol=0.1)


def test_published_gradient_and_chains() -> None:
    body, _, model = _person()
    generator = np.random.default_rng(6)
    R0, root0 = _pose(body, generator, 0.3), np.array([0.0, 0.0, 1.0])
    seen = model.markers_at(R0, root0) + generator.normal(0.0, 0.02, (len(model.segments), 3))
    chains = chains_of(body)
    assert sorted(s for chain in chains for s in chain.segments.tolist()) == list(range(body.n_segments))
    assert [chain.moves_root for chain in chains] == [True] + [False] * (len(chains) - 1)
    for chain in (chains[0], max(chains, key=lambda each: len(each.segments))):
        n = 3 * len(chain.segments) + 3 * chain.moves_root
        x = generator.normal(0.0, 0.2, n)

        def at(x: FloatArray, chain=chain) -> tuple[float, FloatArray]:  # type: ignore[no-untyped-def]
            return chain_gradient(model, seen, chain, R0, root0, x)

        numeric = np.array([(at(x + d)[0] - at(x - d)[0]) / 2e-6 for d in 1e-6 * np.eye(n)])
        np.testing.assert_allclose(at(x)[1], numeric, rtol=1e-4, atol=1e-3 * np.abs(numeric).max())


def test_chord_makes_the_right_angle_on_the_right_side() -> None:
    hip, knee, wand = (np.array([each]) for each in ([0.0, 0.1, 0.9], [0.05, 0.2, 0.5], [0.1, 0.25, 0.7]))
    centre = point_rules.chord(hip, knee, wand, 0.06)[0]
    assert np.linalg.norm(centre - knee[0]) == pytest.approx(0.06)
    assert (hip[0] - centre) @ (knee[0] - centre) == pytest.approx(0.0, abs=1e-12)
    normal = np.cross(hip[0] - knee[0], wand[0] - knee[0])
    assert normal @ (centre - knee[0]) == pytest.approx(0.0, abs=1e-12)
    assert np.isnan(point_rules.chord(hip, knee, wand, 5.0)).all()


@needs_data
@pytest.mark.parametrize("trial", ["c3d_pycgm/Static_trial.c3d", "c3d_pycgm/Movement_trial.c3d", *BTK])
def test_joint_centres_are_those_that_plug_in_gait_wrote(trial: str) -> None:
    read = read_markers(DATA / trial)
    marker_set = load_marker_set("plug_in_gait")
    vertical = vertical_axis(marker_set, read)
    told = {"marker_diameter": 0.016} if trial in BTK else {}  # these files do not tell it
    landmarks = landmarks_of(marker_set, read, vertical, measurements(marker_set, [read], told))
    for point, label in {
        "left_shoulder": "LCLO", "right_elbow": "RHUO", "left_wrist": "LRAO", "left_knee": "LFEO",
        "right_ankle": "RTIO", "hips": "PELO",
    }.items():  # fmt: skip
        theirs = to_world(read.columns((label,)), vertical)[:, 0]
        apart = np.linalg.norm(landmarks.point(point) - theirs, axis=1)
        assert np.nanmax(apart) < 2e-6, point


def _short(trial: MarkerTrial, n: int) -> MarkerTrial:
    return replace(trial, positions=trial.positions[:: max(1, trial.n_frames // n)][:n])


@needs_data
def test_a_fitted_subject_solves_its_trial_through_the_pipeline(tmp_path: Path) -> None:
    marker_set = load_marker_set("plug_in_gait")
    static, motion = (read_markers(DATA / name) for name in BTK)
    fit = fit_body(marker_set, [static, _short(motion, 30)], FitOptions(centres="rules"))
    path = tmp_path / "anna.yaml"
    lengths = dict(fit.measured.lengths)
    content = subject_content(
        "anna", fit.marker_set, body_of(fit.skeleton), fit.skeleton, fit.markers, {}, lengths
    )
    write_subject(path, content)
    suit = load_rig(str(path))
    assert suit.markers is not None
    assert suit.markers.labels == fit.markers.labels
    np.testing.assert_allclose(suit.markers.positions, fit.markers.positions, atol=1e-8)
    pipeline = Pipeline.from_settings(optical_settings(str(path), 100.0, "markers:///x.c3d"), suit)
    pipeline.add_link("m", "markers")
    chunks = list(trial_chunks(replace(motion, positions=motion.positions[:60]), 10**9, "m"))
    frames = [frame for chunk in chunks for frame in pipeline.feed(chunk)]
    assert len(frames) == 60
    stage = pipeline.stage_of(MarkerFrame)
    assert isinstance(stage, MarkerStage)
    assert stage.reconstructor.last is not None
    assert stage.reconstructor.last.rmse < 0.008
    knee = suit.skeleton.index("left_shank")
    theirs = motion.columns(("LFEO",))[:60, 0]
    assert np.median(np.linalg.norm([f.p_w[knee] for f in frames] - theirs, axis=1)) < 0.03
    again = Pipeline.from_settings(optical_settings(str(path), 100.0, "markers:///x.c3d"), suit)
    again.add_link("m", "markers")
    np.testing.assert_array_equal(
        [frame.q_wb for frame in again.replay(chunks)], [frame.q_wb for frame in frames]
    )


def test_markers_without_a_subject_are_refused() -> None:
    suit = load_rig("single")
    settings = optical_settings("single", 100.0, "udp://:5000")
    with pytest.raises(SettingsError, match="optical fit"):
        Pipeline.from_settings(settings, suit)
    with pytest.raises(SettingsError, match="link 'markers' carries markers: the rig has no markers"):
        Pipeline.from_settings(settings.model_copy(update={"reconstructor": "independent"}), suit)
    pipeline = Pipeline(suit, settings.assembly.params())
    with pytest.raises(SettingsError, match="link 'm' carries markers: the rig has no markers"):
        pipeline.add_link("m", "markers")


def test_trials_without_the_sets_markers_are_one_clear_error() -> None:
    marker_set = load_marker_set("plug_in_gait")
    places = np.random.default_rng(0).random((3, 4, 3))
    trial = MarkerTrial("odd", ("A", "B"), 100.0, places[:, :2])
    with pytest.raises(GatewayError, match="none of the markers of 'plug_in_gait' is in it; it has A, B"):
        fit_body(marker_set, [trial])
    arm = replace(trial, labels=("LUPA", "LELB"))
    with pytest.raises(
        GatewayError, match=r"which axis points up is not seen without LHEE .*: tell it with --up"
    ):
        fit_body(marker_set, [arm])
    arms = replace(trial, labels=("LELB", "RELB"))
    with pytest.raises(GatewayError, match=r"none of its thorax .*; it has LELB, RELB"):
        fit_body(marker_set, [arms])
    pelvis = MarkerTrial("odd", ("LASI", "RASI", "LPSI", "RPSI"), 100.0, places)
    with pytest.raises(GatewayError, match="no measurement 'left_kne_width'"):
        fit_body(marker_set, [pelvis], FitOptions(vertical="z", lengths={"left_kne_width": 0.1}))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("[LTHI, LKNE, ", "[LTHI, LKNEE, ", "which is no marker"),
        ("  left_foot: {origin", "  left_flipper: {origin", "no segment 'left_flipper'"),
        ("midpoint: [LPSI, RPSI]", "middle: [LPSI, RPSI]", "middle"),
        ("by: marker_radius}", "by: marker_radius, width: 0.1}", "width"),
    ],
)
def test_marker_set_errors_name_what_is_wrong(tmp_path: Path, old: str, new: str, message: str) -> None:
    shipped = Path(__file__).parents[4] / "config" / "marker_sets" / "plug_in_gait.yaml"
    text = shipped.read_text()
    assert old in text
    path = tmp_path / "mine.yaml"
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(SettingsError, match=message) as caught:
        load_marker_set(str(path))
    assert "mine.yaml" in str(caught.value)


def test_shipped_marker_sets_load() -> None:
    sets = {"plug_in_gait": 58, "opensim_41": 49, "helen_hayes": 19, "ior_cast": 76}
    for name, n_markers in sets.items():
        assert len(load_marker_set(name).labels) == n_markers
