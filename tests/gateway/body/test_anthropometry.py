"""Bodies fitted to a person."""

import numpy as np
import pytest

from gateway.body.anthropometry import LENGTH_OF_STATURE, MASS_OF_BODY, Subject, scaled, segment_masses
from gateway.body.body_file import load_body
from gateway.body.rig import load_rig
from gateway.errors import SettingsError
from gateway.support.settings_files import shipped_folder

HUMAN = load_body("human_17")


def length(body, segment):
    return float(np.linalg.norm(body.tips[body.index(segment)]))


@pytest.mark.parametrize("segment", ["thigh", "shank", "upper_arm", "forearm", "hand"])
def test_the_shipped_person_has_the_lengths_of_the_published_table(segment):
    for side in ("left", "right"):
        expected = LENGTH_OF_STATURE[segment] * HUMAN.stature_m
        assert length(HUMAN, f"{side}_{segment}") == pytest.approx(expected, abs=0.001)


def test_the_shipped_person_has_the_widths_of_the_published_table():
    half_hip = abs(HUMAN.offsets[HUMAN.index("left_thigh"), 2])
    assert half_hip == pytest.approx(LENGTH_OF_STATURE["half_hip_width"] * 1.75, abs=0.001)
    girdle = HUMAN.index("right_shoulder_girdle")
    half_shoulder = HUMAN.offsets[girdle, 2] + HUMAN.tips[girdle, 2]
    assert half_shoulder == pytest.approx(LENGTH_OF_STATURE["half_shoulder_width"] * 1.75, abs=0.001)


def test_stature_scales_everything_and_a_measurement_only_its_segment():
    tall = scaled(HUMAN, Subject(height_m=1.925, lengths={"left_thigh": 0.5, "forearm": 0.3}))
    np.testing.assert_allclose(length(tall, "right_thigh"), 1.1 * length(HUMAN, "right_thigh"))
    np.testing.assert_allclose(length(tall, "left_thigh"), 0.5)
    np.testing.assert_allclose(tall.offsets[tall.index("left_shank")], [0, -0.5, 0])
    for side in ("left", "right"):
        np.testing.assert_allclose(length(tall, f"{side}_forearm"), 0.3)
    np.testing.assert_allclose(
        [point for _, point in tall.contacts], 1.1 * np.array([point for _, point in HUMAN.contacts])
    )
    assert tall.stature_m == 1.925


@pytest.mark.parametrize("body", ["human_17", "lower_body_7"])
def test_widths_are_between_joint_centres(body):
    wide = scaled(load_body(body), Subject(lengths={"hip_width": 0.24}))
    left, right = (wide.offsets[wide.index(f"{side}_thigh"), 2] for side in ("left", "right"))
    assert right - left == pytest.approx(0.24)


def test_shoulder_width_stretches_the_girdle():
    wide = scaled(HUMAN, Subject(lengths={"shoulder_width": 0.50}))
    half = [
        wide.offsets[wide.index(f"{side}_shoulder_girdle"), 2]
        + wide.offsets[wide.index(f"{side}_upper_arm"), 2]
        for side in ("left", "right")
    ]
    np.testing.assert_allclose(half, [-0.25, 0.25])
    girdle = wide.index("left_shoulder_girdle")
    np.testing.assert_allclose(wide.tips[girdle], wide.offsets[wide.index("left_upper_arm")])


def test_wrong_lengths_are_refused():
    with pytest.raises(SettingsError, match="did you mean 'thigh'"):
        scaled(HUMAN, Subject(lengths={"thig": 0.4}))
    with pytest.raises(SettingsError, match="has no 'stature_m'"):
        scaled(load_body("robot_arm_4"), Subject(height_m=1.7))


def test_masses_add_up_to_the_body():
    for sex in (0, 1):
        total = sum(
            pair[sex] * (1 if name in ("head", "thorax", "pelvis") else 2)
            for name, pair in MASS_OF_BODY.items()
        )
        assert total == pytest.approx(1.0, abs=0.001)
    for sex in ("female", "male", None):
        assert np.nansum(segment_masses(HUMAN, 70.0, sex)) == pytest.approx(70.0, abs=0.1)


def test_a_rig_file_scales_its_body(tmp_path):
    path = tmp_path / "rig.yaml"
    rig = (shipped_folder() / "rigs" / "suit_lower_7.yaml").read_text()
    path.write_text(rig + "subject: {height_m: 1.60, lengths: {shank: 0.37}}\n")
    suit, shipped = load_rig(str(path)), load_rig("suit_lower_7")
    assert length(suit.skeleton, "left_shank") == pytest.approx(0.37)
    assert length(suit.skeleton, "left_thigh") == pytest.approx(0.429 * 1.60 / 1.75)
    np.testing.assert_array_equal(suit.lever_arms, shipped.lever_arms)  # modules stay where they are measured
