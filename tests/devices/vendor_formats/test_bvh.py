"""BVH files of several programs: names, axes, units, damage."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from devices.deferred import Rotation
from devices.vendor_formats.bvh import read_bvh
from devices.vendor_formats.sheets import FormatError

LEG_M = 0.86
NAMES = {
    "cmu": ("LeftHip", "LeftKnee", "LeftAnkle", "LeftShoulder", "LeftElbow", "LeftWrist"),
    "mixamo": (
        "mixamorig:LeftUpLeg", "mixamorig:LeftLeg", "mixamorig:LeftFoot", "mixamorig:LeftArm",
        "mixamorig:LeftForeArm", "mixamorig:LeftHand",
    ),
    "blender": ("thigh.L", "shin.L", "foot.L", "upper_arm.L", "forearm.L", "hand.L"),
    "short": ("lThigh", "lShin", "lFoot", "lShldr", "lForeArm", "lHand"),
}  # fmt: skip
OTHER = {"Left": "Right", ".L": ".R", "lT": "rT", "lS": "rS", "lF": "rF", "lH": "rH"}


def _right(name: str) -> str:
    for left, right in OTHER.items():
        if left in name:
            return name.replace(left, right, 1)
    raise AssertionError(name)


def _joint(name: str, offset: str, *inner: str) -> list[str]:
    channels = "CHANNELS 3 Zrotation Xrotation Yrotation"
    lines = [f"JOINT {name}", "{", f"OFFSET {offset}", channels, *inner]
    return [*lines, *([] if inner else ["End Site", "{", "OFFSET 0 -1 0", "}"]), "}"]


def _person(names: tuple[str, ...]) -> tuple[list[str], list[str]]:
    """Lines of a hierarchy in decimetres, y up, looking along z, arms stretched sideways; its joints."""
    order = ["Hips"]
    body = [
        "ROOT Hips",
        "{",
        "OFFSET 0 0 0",
        "CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation",
    ]
    for x, own in ((1, names), (-1, tuple(map(_right, names)))):
        order += own[:3]
        foot = _joint(own[2], "0 -4.3 0")
        body += _joint(own[0], f"{x} 0 0", *_joint(own[1], "0 -4.3 0", *foot))
    arms = []
    order.append("Chest")
    for x, own in ((1, names), (-1, tuple(map(_right, names)))):
        order += own[3:]
        hand = _joint(own[5], f"{2.6 * x} 0 0")
        arms += _joint(own[3], f"{2 * x} 4 0", *_joint(own[4], f"{2.9 * x} 0 0", *hand))
    order.append("Head")
    body += _joint("Chest", "0 1 0", *arms, *_joint("Head", "0 5 0"))
    return [*body, "}"], order


def _write(path: Path, kind: str, turns: dict[str, tuple[float, float, float]], frames: int = 3) -> Path:
    """A file in which joints are turned by so many degrees about z, x and y."""
    lines, order = _person(NAMES[kind])
    row = [0.0, 9.0, 0.0]
    for name in order:
        row += turns.get(name, (0.0, 0.0, 0.0))
    motion = ["MOTION", f"Frames: {frames}", "Frame Time: 0.00833333"]
    path.write_text("\n".join(["HIERARCHY", *lines, *motion, *[" ".join(map(str, row))] * frames]) + "\n")
    return path


def _axes(recording, segment: str) -> np.ndarray:
    """(3, 3) of a segment in the first frame, columns x forward, y up, z right, world with Z up."""
    track = next(track for track in recording.fused if track.name == segment)
    return Rotation.from_quat(track.q_es[0], scalar_first=True).as_matrix()


@pytest.mark.parametrize("kind", NAMES)
def test_joints_are_known_by_the_names_of_several_programs(tmp_path, kind):
    found = read_bvh(_write(tmp_path / "a.bvh", kind, {}), LEG_M)
    parts = ("thigh", "shank", "foot", "upper_arm", "forearm", "hand")
    sides = {f"{side}_{part}" for side in ("left", "right") for part in parts}
    assert set(found.names.values()) == sides | {"pelvis", "thorax", "head"}
    assert found.sampling_rate_hz == 120


def test_at_rest_bones_lie_along_y_and_everybody_looks_ahead(tmp_path):
    found = read_bvh(_write(tmp_path / "a.bvh", "cmu", {}), LEG_M)
    pelvis = _axes(found, "pelvis")
    assert np.allclose(pelvis[:, 1], [0, 0, 1])
    assert np.allclose(_axes(found, "left_shank"), pelvis)
    arm = _axes(found, "left_upper_arm")
    assert np.allclose(arm[:, 0], pelvis[:, 0])  # forward
    assert np.allclose(arm[:, 1], pelvis[:, 2])  # from the elbow to the shoulder, to the right
    assert np.allclose(found.local[0].values[0], [0, 0, 0.9])  # 9 dm above the floor


def test_a_bent_knee_turns_the_shank_backwards(tmp_path):
    found = read_bvh(_write(tmp_path / "a.bvh", "mixamo", {"mixamorig:LeftLeg": (0.0, 60.0, 0.0)}), LEG_M)
    bent = _axes(found, "left_thigh").T @ _axes(found, "left_shank")
    assert np.degrees(Rotation.from_matrix(bent).as_rotvec()) == pytest.approx([0.0, 0.0, -60.0])


def test_the_unit_follows_from_the_legs(tmp_path):
    found = read_bvh(_write(tmp_path / "a.bvh", "cmu", {}), 0.5 * LEG_M)
    assert np.allclose(found.local[0].values[0], [0, 0, 0.45])
    assert any("unit is taken for 0.05 m" in note for note in found.notes)


def test_other_names_are_told_by_a_map(tmp_path):
    path = _write(tmp_path / "a.bvh", "cmu", {})
    path.write_text(path.read_text().replace("LeftKnee", "Genou"))
    with pytest.raises(
        FormatError, match=r"no joint is called as left_shank would be: tell with --map .*Genou"
    ):
        read_bvh(path, LEG_M)
    assert "left_shank" in read_bvh(path, LEG_M, {"Genou": "left_shank"}).names.values()
    with pytest.raises(FormatError, match="--map Knie=…: no such joint"):
        read_bvh(path, LEG_M, {"Knie": "left_shank"})


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("HIERARCHY", "NOTHING", "not a BVH file"),
        ("MOTION", "", "not a BVH file, or cut off"),
        ("Frame Time: 0.00833333", "Frame Time: 0", "'Frame Time: SECONDS' are wanted"),
        ("Frame Time: 0.00833333", "Frame Time: -e", "'Frame Time: SECONDS' are wanted"),
        ("Zrotation", "Wrotation", "channels are Xposition"),
        ("OFFSET 1 0 0", "OFFSET 1 0", "3 numbers are wanted behind OFFSET"),
        ("OFFSET 1 0 0", "OFFSET 1 nan 0", "3 numbers are wanted behind OFFSET"),
        ("End Site", "Ende", "is nothing that a hierarchy has"),
        ("0.0 9.0 0.0", "0.0 x 0.0", "could not convert string to float"),
        ("0.0 9.0 0.0", "9.0 0.0", "numbers where 48 channels are wanted; --partial"),
        ("0 -4.3 0", "0 0 0", "no length"),
    ],
)
def test_damage_is_told_in_one_line(tmp_path, old, new, message):
    path = _write(tmp_path / "a.bvh", "cmu", {})
    path.write_text(path.read_text().replace(old, new, 1))
    with pytest.raises(FormatError, match=message) as caught:
        read_bvh(path, LEG_M)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_frames_before_the_damage_can_be_taken(tmp_path):
    path = _write(tmp_path / "a.bvh", "cmu", {}, frames=5)
    path.write_text(path.read_text()[:-40])
    with pytest.raises(FormatError, match="--partial"):
        read_bvh(path, LEG_M)
    found = read_bvh(path, LEG_M, partial=True)
    assert len(found.fused[0].times) == 4
    assert any("4 frames, of which 'Frames:' tells 5" in note for note in found.notes)
