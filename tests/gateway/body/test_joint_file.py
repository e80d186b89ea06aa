"""Joints in body files: wrong ones are refused with the place and the remedy."""

import pytest

from gateway.body.body_file import load_body
from gateway.body.rig import load_rig
from gateway.errors import SettingsError
from gateway.support.settings_files import shipped_folder

BODY = """
name: two
segments:
  - {name: a, parent: null, tip: [1, 0, 0]}
  - {name: b, parent: a, joint: [1, 0, 0], tip: [1, 0, 0]}
joints:
  - {name: j, proximal: PROXIMAL, distal: DISTAL, angles: ANGLES MORE}
"""


def body(tmp_path, proximal="a", distal="b", angles="{turn: {axis: z}}", more=""):
    text = BODY.replace("PROXIMAL", proximal).replace("DISTAL", distal)
    path = tmp_path / "body.yaml"
    path.write_text(text.replace("ANGLES", angles).replace("MORE", more))
    return str(path)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"proximal": "c"}, "joint 'j' names segment 'c', which the body does not have"),
        ({"distal": "world"}, "names segment 'world'"),
        ({"distal": "a"}, "joins 'a' to itself"),
        ({"angles": "{}"}, "one angle or three, not 0"),
        ({"angles": "{p: {axis: x}, q: {axis: y}}"}, "one angle or three, not 2"),
        ({"angles": "{p: {axis: x}, q: {axis: x}, r: {axis: y}}"}, "need different axes"),
        ({"angles": "{p: {axis: x}, q: {axis: y}, r: {axis: [0, 0, 1]}}"}, "vectors are for one angle"),
        ({"angles": "{p: {axis: [0, 0, 0]}}"}, "length zero"),
        ({"angles": "{p: {axis: w}}"}, "axis"),
        ({"angles": "{p: {axis: x, limits_deg: [5, -5]}}"}, "the smaller limit comes first"),
        ({"more": ", free: [spin]"}, "'free' names 'spin'"),
        (
            {"angles": "{p: {axis: x}, q: {axis: y}, r: {axis: x}}", "more": ", decomposition: swing_twist"},
            "three different axes",
        ),
    ],
)
def test_wrong_joints_are_refused(tmp_path, given, message):
    with pytest.raises(SettingsError, match=message) as caught:
        load_body(body(tmp_path, **given))
    assert "body.yaml" in str(caught.value)


def test_a_rig_chooses_another_definition_of_a_joint(tmp_path):
    rig = (shipped_folder() / "rigs" / "suit_17.yaml").read_text()
    path = tmp_path / "rig.yaml"
    path.write_text(rig + "joint_definitions: {left_shoulder: swing_twist, right_shoulder: xzy}\n")
    joints = {joint.name: joint for joint in load_rig(str(path)).skeleton.joints}
    assert joints["left_shoulder"].sequence == "swing_twist"
    assert joints["right_shoulder"].sequence == "xzy"
    path.write_text(rig + "joint_definitions: {left_shoulder: zyx}\n")
    with pytest.raises(SettingsError, match=r"no definition 'zyx'.*did you mean 'xzy'"):
        load_rig(str(path))
    path.write_text(rig + "joint_definitions: {left_sholder: xzy}\n")
    with pytest.raises(SettingsError, match="did you mean 'left_shoulder'"):
        load_rig(str(path))


@pytest.mark.parametrize("path", sorted((shipped_folder() / "bodies").glob("*.yaml")), ids=lambda p: p.stem)
def test_every_segment_of_a_shipped_body_has_a_joint_and_parents_come_first(path):
    body = load_body(path.stem)
    assert (body.parents < range(body.n_segments)).all()
    jointed = {joint.distal for joint in body.joints}
    assert jointed >= set(range(1, body.n_segments))
    for joint in body.joints:
        assert all(low < high for low, high in (angle.limits for angle in joint.angles))
