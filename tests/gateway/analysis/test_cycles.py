"""Strides by strikes and lifts of feet, curves by percent of them, published gait beside."""

from __future__ import annotations

import numpy as np
import pytest

from gateway.analysis.cycles import PERCENT, cycles, foot_of, normal_band, stance_spans, strides
from gateway.analysis.floor import FloorForces, ForceSource
from gateway.body.body_file import load_body

BODY = load_body("human_17")
FEET = np.array([BODY.index("left_foot"), BODY.index("right_foot")])
TIME_S = 0.01 * np.arange(400)


def _floor(*loads: list[tuple[int, int]], force_n: float = 700.0, beside_n: float = 0.0) -> FloorForces:
    """Loads over frames, by foot; beside_n: what an estimate leaves on a foot in the air."""
    force, source = np.zeros((400, 2, 3)), np.zeros((400, 2), dtype=np.uint8)
    if beside_n:
        force[..., 2], source[...] = beside_n, ForceSource.ESTIMATED
    for c, spans in enumerate(loads):
        for first, last in spans:
            force[first : last + 1, c, 2] = force_n
            source[first : last + 1, c] = ForceSource.ESTIMATED if beside_n else ForceSource.MEASURED
    return FloorForces(FEET, force, np.zeros_like(force), source, np.zeros((400, 2)))


def _ways() -> np.ndarray:
    """(F, S, 3) m, all joints at 1.3 m/s along the diagonal."""
    way = np.zeros((400, BODY.n_segments, 3))
    way[..., :2] = (1.3 * TIME_S / np.sqrt(2.0))[:, None, None]
    return way


WALK = [(50, 109), (150, 209), (250, 309)], [(0, 59), (100, 159), (200, 259), (300, 359)]


@pytest.mark.parametrize("beside_n", [0.0, 35.0])
def test_a_walk_has_strides_with_stance_length_and_speed(beside_n):
    found = strides(BODY, _floor(*WALK, beside_n=beside_n), TIME_S, _ways())
    assert [(s.foot, round(s.start_s, 2), round(s.end_s, 2)) for s in found] == [
        ("left_foot", 0.5, 1.5),
        ("right_foot", 1.0, 2.0),
        ("left_foot", 1.5, 2.5),
        ("right_foot", 2.0, 3.0),
    ]
    for stride in found:
        assert stride.stance_percent == pytest.approx(59.0)
        assert stride.length_m == pytest.approx(1.3)
        assert stride.speed_m_per_s == pytest.approx(1.3)


def test_standing_and_single_steps_have_none():
    assert strides(BODY, _floor([(0, 399)], [(0, 399)]), TIME_S, _ways()) == ()
    assert strides(BODY, _floor([(100, 160)], []), TIME_S, _ways()) == ()


def test_curves_of_strides_begin_at_the_strike_whatever_their_duration():
    found = strides(BODY, _floor([(50, 109), (150, 209), (230, 289)], []), TIME_S, _ways())
    values = np.sin(2.0 * np.pi * np.interp(TIME_S, [0.5, 1.5, 2.3], [0.0, 1.0, 2.0]))
    over = cycles(values, TIME_S, found)
    assert over.curves.shape == (2, 101)
    assert np.abs(over.mean - np.sin(0.02 * np.pi * PERCENT)).max() < 0.01
    assert over.deviation.max() < 0.01


def test_one_stride_has_no_deviation_and_what_is_unknown_stays_so():
    found = strides(BODY, _floor([(50, 109), (150, 209)], []), TIME_S, _ways())
    values = np.where(TIME_S < 1.0, np.nan, 1.0)
    over = cycles(values, TIME_S, found)
    assert np.isnan(over.deviation).all()
    assert np.isnan(over.mean[:50]).all()
    assert (over.mean[51:] == 1.0).all()


def test_joints_of_a_leg_go_by_its_foot_and_others_by_none():
    by_joint = {joint.name: foot_of(BODY, j) for j, joint in enumerate(BODY.joints)}
    assert by_joint["left_hip"] == by_joint["left_knee"] == by_joint["left_ankle"] == "left_foot"
    assert by_joint["right_knee"] == "right_foot"
    assert {by_joint[name] for name in ("spine", "neck", "left_shoulder", "left_elbow")} == {None}


def test_published_bands_are_those_of_hip_knee_and_ankle_in_the_sagittal_plane():
    angles = {(joint.name, angle.name) for joint in BODY.joints for angle in joint.angles}
    with_band = {each for each in angles if normal_band(*each) is not None}
    sides = ("left", "right")
    expected = {("hip", "flexion"), ("knee", "flexion"), ("ankle", "dorsiflexion")}
    assert with_band == {(f"{side}_{joint}", angle) for side in sides for joint, angle in expected}


def test_spans_of_stance_reach_from_the_first_frame_and_to_the_last():
    spans = stance_spans(BODY, _floor([(0, 59), (150, 209)], [(100, 399)]), TIME_S)
    assert spans["left_foot"] == [(0.0, pytest.approx(0.59)), (pytest.approx(1.5), pytest.approx(2.09))]
    assert spans["right_foot"] == [(pytest.approx(1.0), pytest.approx(3.99))]
