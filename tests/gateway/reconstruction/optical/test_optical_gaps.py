"""What markers in a gap leave open, carried on live and bridged offline; limbs turned round; hips."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gateway.body.body_file import load_body
from gateway.body.skeleton import BodyMarkers
from gateway.emulation.optical_truth import cut_gaps
from gateway.frames import FloatArray, MarkerFrame, Status
from gateway.geometry import quaternion
from gateway.geometry import rotation_matrix as rm
from gateway.reconstruction.optical import both_ways, point_rules
from gateway.reconstruction.optical.both_ways import solve_both_ways
from gateway.reconstruction.optical.bundle import _loose
from gateway.reconstruction.optical.carrying import Carrying
from gateway.reconstruction.optical.motion_kernels import (
    Evidence,
    MovingPoses,
    UsualTurns,
    assembled,
    motion_cost,
    stepped,
)
from gateway.reconstruction.optical.pose_solver import BodyModel, body_model
from gateway.reconstruction.optical.reconstructor import OpticalReconstructor
from gateway.reconstruction.optical.tracking import start_pose
from gateway.reconstruction.optical.usual_posture import INDEPENDENT_S, unknown_posture, usual_posture
from gateway.reconstruction.optical.whole_motion import _differences

BODY = load_body("human_17")
HAND = BODY.index("right_hand")
STEP_NS = 10_000_000


def _markers(n_each: int = 3) -> BodyMarkers:
    generator = np.random.default_rng(0)
    segments = np.repeat(np.arange(BODY.n_segments), n_each)
    places = generator.normal(0.0, 0.08, (len(segments), 3))
    labels = tuple(f"m{i}" for i in range(len(segments)))
    return BodyMarkers(labels, segments, places, np.full(len(segments), 0.003))


def _seen(model: BodyModel, R: FloatArray) -> FloatArray:
    return model.markers_at(R, np.array([0.0, 0.0, 0.95]))


def _waving(n: int) -> FloatArray:
    """(n, S, 3, 3): a person who stands and waves, the hand by ± 45° every two seconds."""
    upright = quaternion.to_matrix(BODY.neutral)
    R = np.tile(upright, (n, BODY.n_segments, 1, 1))
    for f in range(n):
        R[f, HAND] = upright @ rm.from_rotation_vector(np.array([0.0, 0.0, 0.8 * np.sin(0.0314 * f)]))
    return R


def _apart_deg(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.degrees((Rotation.from_matrix(a).inv() * Rotation.from_matrix(b)).magnitude())


def test_a_gap_is_carried_on_live_and_bridged_offline():
    markers = _markers()
    model = body_model(BODY, markers)
    R, gap = _waving(160), slice(90, 125)
    observed = np.array([_seen(model, each) for each in R])
    observed += np.random.default_rng(1).normal(0.0, 0.0005, observed.shape)
    observed[gap, markers.segments == HAND] = np.nan
    frames = [MarkerFrame(f, f * STEP_NS, seen) for f, seen in enumerate(observed)]
    reconstructor = OpticalReconstructor(BODY, markers)
    live = np.array([quaternion.to_matrix(reconstructor.update(each).q_wb[HAND]) for each in frames])
    solved, counts = solve_both_ways(BODY, markers, frames)
    offline = np.array([quaternion.to_matrix(each.q_wb[HAND]) for each in solved])
    held = _apart_deg(np.tile(R[gap.start - 1, HAND], (35, 1, 1)), R[gap, HAND])
    carried, bridged = _apart_deg(live, R[:, HAND])[gap], _apart_deg(offline, R[:, HAND])
    assert carried.max() < 0.75 * held.max()
    assert bridged[gap].max() < 4.0 < carried.max()
    assert np.delete(bridged, np.r_[gap]).max() < 3.0
    assert counts["starts"] == 1
    assert solved[0].markers is not None
    assert np.isnan(solved[100].markers.residuals[markers.segments == HAND]).all()


def test_frames_before_the_first_pose_stay_as_they_are_and_those_between_are_bridged():
    markers = _markers()
    model = body_model(BODY, markers)
    nothing = np.full((len(markers.labels), 3), np.nan)
    seen = _seen(model, _waving(1)[0])
    frames = [MarkerFrame(f, f * STEP_NS, each) for f, each in enumerate([nothing, seen, nothing, seen])]
    solved, counts = solve_both_ways(BODY, markers, frames)
    assert [each.markers is None for each in solved] == [True, False, False, False]
    assert np.isnan(solved[0].q_wb).all()
    assert (solved[2].status == Status.PREDICTED).all()
    np.testing.assert_allclose(solved[2].p_w, solved[1].p_w, atol=1e-3)
    assert counts["lost"] == 2
    assert solve_both_ways(BODY, markers, frames[:1])[0][0].markers is None


@pytest.mark.parametrize("hidden", ["all", "half"])
def test_somebody_who_walks_on_unseen_is_bridged_at_the_root_too(hidden):
    """A second in which a turning walker goes 1.4 m, with no marker or those of the left side."""
    markers = _markers()
    model = body_model(BODY, markers)
    n, gap = 260, slice(80, 180)
    waving = _waving(n)
    turn = Rotation.from_euler("z", 0.5 * np.sin(0.015 * np.arange(n))[:, None]).as_matrix()
    R = turn[:, None] @ waving
    place = np.column_stack([0.014 * np.arange(n), 0.1 * np.sin(0.03 * np.arange(n)), np.zeros(n)])
    observed = np.array([_seen(model, each) for each in R]) + place[:, None]
    observed += np.random.default_rng(5).normal(0.0, 0.0005, observed.shape)
    left = np.array([name.startswith("left") for name in BODY.segment_names])[markers.segments]
    observed[gap, left if hidden == "half" else slice(None)] = np.nan
    frames = [MarkerFrame(f, f * STEP_NS, seen) for f, seen in enumerate(observed)]
    solved, _ = solve_both_ways(BODY, markers, frames)
    true = place + np.array([0.0, 0.0, 0.95])
    apart = np.linalg.norm(np.array([each.p_w[0] for each in solved]) - true, axis=1)
    assert apart[gap].max() < (0.06 if hidden == "all" else 0.003)
    turned = np.array([quaternion.to_matrix(each.q_wb[0]) for each in solved])
    assert _apart_deg(turned, R[:, 0])[gap].max() < 6.0
    assert np.delete(apart, np.r_[gap]).max() < 0.003
    if hidden == "all":
        assert (solved[130].status == Status.PREDICTED).all()
        assert np.isfinite(solved[130].angular_rate).all()


def test_the_equations_of_a_motion_are_the_slope_of_its_cost() -> None:
    """Frames at uneven times, the first ones fixed, markers missing here and there."""
    markers = _markers(2)
    model = body_model(BODY, markers)
    generator = np.random.default_rng(6)
    times = np.cumsum(generator.uniform(0.008, 0.03, 7))
    R = _waving(7)
    for s in range(BODY.n_segments):
        rate = generator.normal(0.0, 1.0, 3)
        R[:, s] = R[:, s] @ Rotation.from_rotvec(times[:, None] * rate).as_matrix()
    root = np.array([0.0, 0.0, 0.95]) + times[:, None] * [1.2, 0.3, 0.0]
    observed = np.array([_seen(model, each) for each in R]) + (root - [0.0, 0.0, 0.95])[:, None]
    observed += generator.normal(0.0, 0.002, observed.shape)
    observed[generator.random(observed.shape[:2]) < 0.3] = np.nan
    motion, differences = MovingPoses(R, root, 3), _differences(times, 3)
    spread = generator.normal(0.0, 5.0, (BODY.n_segments, 3, 3))
    posture = UsualTurns(
        Rotation.from_rotvec(generator.normal(0.0, 0.05, (BODY.n_segments, 3))).as_matrix(),
        spread @ np.swapaxes(spread, 1, 2), generator.uniform(0.5, 2.0, 7),
    )  # fmt: skip
    evidence = Evidence(model, observed, 1.0, differences, posture)
    _, right = assembled(evidence, motion)
    slope = np.empty_like(right)
    for i in range(len(right)):
        step = np.zeros(len(right))
        step[i] = 1e-6
        costs = [motion_cost(evidence, stepped(model, motion, each)) for each in (step, -step)]
        slope[i] = (costs[0] - costs[1]) / 2e-6
    np.testing.assert_allclose(-right, slope, atol=2e-3 * np.abs(slope).max())


@pytest.mark.parametrize("length", [20, 60])
def test_a_limb_that_hides_is_bridged_by_the_least_jerk(length: int) -> None:
    """A whole leg, hip, knee and ankle, is unseen for 0.2 s and 0.6 s of a swing of 2 rad/s at most."""
    markers = _markers()
    model = body_model(BODY, markers)
    R, leg = _waving(160), [BODY.index(f"left_{name}") for name in ("thigh", "shank", "foot")]
    angle = 0.4 * np.sin(2 * np.pi * 0.8 * 0.01 * np.arange(160))
    turns = Rotation.from_rotvec(angle[:, None] * [0.0, 0.0, 1.0]).as_matrix()
    R[:, leg[0]] = R[:, leg[0]] @ turns
    R[:, leg[1]] = R[:, leg[0]] @ turns
    R[:, leg[2]] = R[:, leg[1]]
    observed = np.array([_seen(model, each) for each in R])
    observed += np.random.default_rng(1).normal(0.0, 0.001, observed.shape)
    gap = slice(70, 70 + length)
    observed[gap, np.isin(markers.segments, leg)] = np.nan
    frames = [MarkerFrame(f, f * STEP_NS, seen) for f, seen in enumerate(observed)]
    solved, _ = solve_both_ways(BODY, markers, frames)
    found = np.array([quaternion.to_matrix(each.q_wb[leg[1]]) for each in solved])
    assert _apart_deg(found, R[:, leg[1]])[gap].max() < (1.5 if length == 20 else 15.0)


def test_feet_of_two_markers_are_nearer_for_what_they_usually_do(monkeypatch: pytest.MonkeyPatch) -> None:
    """What they leave open is the roll about the line between them, and the more so without the shank."""
    every = _markers()
    feet = [BODY.index(f"{side}_foot") for side in ("left", "right")]
    dropped = [np.flatnonzero(every.segments == foot)[2] for foot in feet]
    markers = BodyMarkers(
        tuple(np.delete(every.labels, dropped)), np.delete(every.segments, dropped),
        np.delete(every.positions, dropped, axis=0), np.delete(every.sigmas, dropped),
    )  # fmt: skip
    R = _waving(600)  # at 50 Hz: long enough for joints to show what they usually do
    generator = np.random.default_rng(4)
    observed = np.array([_seen(body_model(BODY, markers), each) for each in R])
    observed += generator.normal(0.0, 0.004, observed.shape)
    cut_gaps(observed, 0.5, 50.0, generator, first=20)
    frames = [MarkerFrame(f, 2 * f * STEP_NS, seen) for f, seen in enumerate(observed)]

    def away() -> float:
        solved, _ = solve_both_ways(BODY, markers, frames)
        apart = []
        for foot in feet:
            found = np.array([quaternion.to_matrix(each.q_wb[foot]) for each in solved])
            apart.append(_apart_deg(found, R[:, foot]))
        return float(np.sqrt(np.mean(np.square(apart))))

    drawn = away()
    monkeypatch.setattr(both_ways, "usual_posture", lambda *_: unknown_posture(BODY.n_segments, len(frames)))
    assert drawn < 0.9 * away()


def test_joints_are_learned_from_what_is_seen_of_them() -> None:
    """The hand waves by 0.57 rad (RMS) about one axis, and not about the others; half of all points are
    missing."""
    markers = _markers()
    model = body_model(BODY, markers)
    R = _waving(6000)
    observed = np.array([_seen(model, each) for each in R])
    cut_gaps(observed, 0.5, 100.0, np.random.default_rng(2))
    root = np.tile([0.0, 0.0, 0.95], (6000, 1))
    posture = usual_posture(model, 0.01 * np.arange(6000), observed, (R, root), 1.0)
    assert np.degrees(np.linalg.norm(rm.increment(posture.mean[HAND], R[0, HAND - 1].T @ R[0, HAND]))) < 6.0
    sigmas = np.sqrt(np.linalg.eigvalsh(np.linalg.inv(posture.precision[HAND])))
    assert sigmas[2] == pytest.approx(0.57, rel=0.1)
    assert np.degrees(sigmas[:2]).max() < 3.0
    assert posture.weights.sum() == pytest.approx(60.0 / INDEPENDENT_S, rel=0.01)


def test_few_postures_draw_less() -> None:
    """A prediction from n postures is spread by (n + 1) / (n − 2) more than they are; a joint that hardly
    moved in four seconds may yet."""
    model = body_model(BODY, _markers())
    R = _waving(400)
    observed = np.array([_seen(model, each) for each in R])
    root = np.tile([0.0, 0.0, 0.95], (400, 1))
    posture = usual_posture(model, 0.01 * np.arange(400), observed, (R, root), 1.0)
    sigmas = np.sqrt(np.linalg.eigvalsh(np.linalg.inv(posture.precision[HAND])))
    assert sigmas[2] == pytest.approx(
        np.sqrt(6.0 / 3.0 * (4.0 * 0.57**2 + np.radians(10.0) ** 2) / 5.0), rel=0.1
    )
    assert np.degrees(sigmas[:2]) == pytest.approx(10.0 * np.sqrt(2.0 / 5.0), rel=0.1)


def test_a_trial_longer_than_a_stretch_has_no_seams() -> None:
    markers = _markers(2)
    model = body_model(BODY, markers)
    observed = np.array([_seen(model, each) for each in _waving(620)])
    observed[380:420, markers.segments == HAND] = np.nan  # across the end of the first stretch
    frames = [MarkerFrame(f, f * STEP_NS, seen) for f, seen in enumerate(observed)]
    solved, _ = solve_both_ways(BODY, markers, frames)
    hand = np.array([quaternion.to_matrix(each.q_wb[HAND]) for each in solved])
    assert _apart_deg(hand, _waving(620)[:, HAND]).max() < 4.0  # it turns by up to 57° meanwhile
    assert _apart_deg(hand[1:], hand[:-1]).max() < 2.0


def test_a_hand_with_one_marker_that_turned_far_unseen_is_met_again() -> None:
    """Its marker comes back 9 cm from where it was expected: as far from the wrist as it should be."""
    every = _markers(3)
    kept = np.array([m for m, s in enumerate(every.segments) if s != HAND or m % 3 == 0])
    places = every.positions[kept]
    places[every.segments[kept] == HAND] = [0.0, -0.08, 0.02]
    markers = BodyMarkers(
        tuple(every.labels[m] for m in kept), every.segments[kept], places, every.sigmas[kept]
    )
    model = body_model(BODY, markers)
    R = _waving(60)
    R[30:, HAND] = R[30:, HAND] @ rm.from_rotation_vector(np.array([0.0, 0.0, 1.2]))
    observed = np.array([_seen(model, each) for each in R])
    observed[20:30, markers.segments == HAND] = np.nan
    reconstructor = OpticalReconstructor(BODY, markers)
    found = [reconstructor.update(MarkerFrame(f, f * STEP_NS, seen)) for f, seen in enumerate(observed)]
    assert np.nanmax([frame.markers.residuals[markers.segments == HAND] for frame in found[31:]]) < 0.003
    assert reconstructor.counts["laid_anew"] == 1


def test_a_joint_carries_its_rate_on_and_comes_to_rest():
    carrying = Carrying(BODY.parents)
    R = _waving(1)[0]
    for f in range(60):
        R[HAND] = R[HAND] @ rm.from_rotation_vector(np.array([0.0, 0.0, 0.02]))
        carrying.add(f * STEP_NS, R.copy())
    first = carrying.ahead(60 * STEP_NS)
    turn = rm.increment(R[HAND], first[HAND])
    assert 0.012 < turn[2] < 0.02
    np.testing.assert_allclose(np.delete(first, HAND, axis=0), np.delete(R, HAND, axis=0), atol=1e-9)
    for f in range(60, 160):
        carrying.add(f * STEP_NS, carrying.ahead(f * STEP_NS))
    assert np.degrees(np.linalg.norm(rm.increment(R[HAND], carrying.ahead(160 * STEP_NS)[HAND]))) < 20.0
    still = carrying.ahead(160 * STEP_NS)
    carrying.add(160 * STEP_NS, still)
    np.testing.assert_allclose(carrying.ahead(161 * STEP_NS)[HAND], still[HAND], atol=1e-3)
    carrying.reset()
    carrying.add(0, R)
    np.testing.assert_allclose(carrying.ahead(STEP_NS), R, atol=1e-12)


def test_an_arm_met_by_the_wrong_side_of_its_elbow_is_turned_round():
    arm, forearm = BODY.index("right_upper_arm"), BODY.index("right_forearm")
    kept = [
        m for m, s in enumerate(_markers().segments) if s not in (arm, BODY.index("right_shoulder_girdle"))
    ]
    every = _markers()
    places = np.vstack([every.positions[kept], [0.0, -0.32, 0.05]])
    segments = np.append(every.segments[kept], arm)
    labels = (*(every.labels[m] for m in kept), "elbow")
    model = body_model(BODY, BodyMarkers(labels, segments, places, np.full(len(labels), 0.003)))
    for bent in (40.0, 90.0, 120.0):
        R = _waving(1)[0]
        turn = rm.from_rotation_vector(np.array([0.0, 0.0, np.radians(bent)]))
        R[forearm] = R[arm] @ turn
        R[HAND] = R[forearm]
        pose = start_pose(model, _seen(model, R), quaternion.to_matrix(BODY.neutral))
        assert pose is not None
        assert _apart_deg(pose.R[forearm][None], R[forearm][None])[0] < 5.0
        assert _apart_deg(pose.R[arm][None], R[arm][None])[0] < 20.0


def test_only_joints_beyond_two_markers_are_let_loose():
    markers = _markers(2)
    keep = np.array([m for m, s in enumerate(markers.segments) if s != HAND or m % 2])
    single = BodyMarkers(
        tuple(markers.labels[m] for m in keep), markers.segments[keep], markers.positions[keep],
        markers.sigmas[keep],
    )  # fmt: skip
    model = body_model(BODY, single)
    loose = _loose(model)
    row = model.distals.tolist().index(HAND)
    np.testing.assert_array_equal(loose.stiffness[row], model.stiffness[row])
    assert (np.delete(loose.stiffness / model.stiffness, row, axis=0) < 0.1).all()


def test_hips_of_all_regressions_lie_close_together_and_mirror():
    asis = np.array([[0.0, 0.12, 1.0]]), np.array([[0.0, -0.12, 1.0]])
    sacrum = np.array([[-0.16, 0.0, 1.0]])
    right = [
        point_rules.davis_hip(asis, sacrum, (0.88, 0.88), 0.007, "right"),
        point_rules.davis_hip(asis, sacrum, (0.88, 0.88), 0.007, "right", (0.24, 0.0648)),
        point_rules.harrington_hip(asis, sacrum, "right"),
        point_rules.hara_hip(asis, sacrum, 0.88, "right"),
    ]
    np.testing.assert_allclose(
        right[3][0], [0.011 - 0.063 * 0.88, -0.008 - 0.086 * 0.88, 1 - 0.009 - 0.078 * 0.88]
    )
    assert max(np.linalg.norm(a - b) for a in right for b in right) < 0.03
    np.testing.assert_allclose(right[0], right[1], atol=1e-4)
    left = point_rules.hara_hip(asis, sacrum, 0.88, "left")
    np.testing.assert_allclose(left, right[3] * [1, -1, 1])


@pytest.mark.parametrize(
    ("segment", "turn_deg"),
    [
        ("right_upper_arm", (100, 0, 60)),
        ("left_forearm", (0, 0, 110)),
        ("left_thigh", (0, 0, 100)),
        ("pelvis", (0, 150, 0)),
    ],
)
def test_a_limb_that_turned_far_within_a_gap_is_met_at_once(segment, turn_deg):
    """Half of its markers or more are farther from where they are expected than any ghost."""
    first = BODY.index(segment)
    limb = [s for s in range(BODY.n_segments) if s == first or _bears(first, s)]
    markers = _markers(4)
    model = body_model(BODY, markers)
    R, gap = _waving(40), slice(15, 25)
    R[25:, limb] = R[25:, limb] @ rm.from_rotation_vector(np.radians(np.array(turn_deg, dtype=np.float64)))
    observed = np.array([_seen(model, each) for each in R])
    observed[gap, np.isin(markers.segments, limb)] = np.nan
    reconstructor = OpticalReconstructor(BODY, markers)
    found = [reconstructor.update(MarkerFrame(f, f * STEP_NS, seen)) for f, seen in enumerate(observed)]
    turned = Rotation.from_quat([frame.q_wb[first] for frame in found[25:]], scalar_first=True)
    assert _apart_deg(turned.as_matrix(), R[25:, first]).max() < 2.0
    assert reconstructor.counts["laid_anew"] + reconstructor.counts["starts"] == 2
    assert np.isfinite(np.array([frame.q_wb for frame in found])).all()


def _bears(first: int, segment: int) -> bool:
    """Whether a segment hangs on another, at any distance."""
    parent = int(BODY.parents[segment])
    return parent >= 0 and (parent == first or _bears(first, parent))
