"""The body as OpenSim's model, put by its own ``.mot`` where the take has it; Rajagopal's arms and feet."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gateway.body.body_file import load_body
from gateway.body.joint_angles import posture
from gateway.frames import FloatArray
from gateway.recording import SkeletonArrays
from gateway.recording.exporters.formats import FORMATS, Axes
from gateway.recording.exporters.opensim import pelvis_origin
from gateway.recording.exporters.take import Take, rotation, take_of

FRAMES = 12
BODY = load_body("human_17")


def _moving() -> SkeletonArrays:
    """Every joint in motion, about all of its axes."""
    generator = np.random.default_rng(4)
    phases = {joint.name: generator.uniform(0, 6, len(joint.angles)) for joint in BODY.joints}
    q_wb = []
    for f in range(FRAMES):
        angles = {
            joint.name: 0.3 * np.sin(0.3 * f + phases[joint.name])
            for joint in BODY.joints
            if joint.proximal == BODY.parents[joint.distal]
        }
        for side in ("left", "right"):
            angles[f"{side}_shoulder"] = np.array([0.3, 0.9 + 0.04 * f, -0.4])
            angles[f"{side}_elbow"] = np.array([0.5 + 0.1 * f, 0.1, 0.8])
        q_wb.append(posture(BODY, angles, BODY.neutral))
    count = (FRAMES, BODY.n_segments)
    p_w = np.full((*count, 3), np.nan)
    p_w[:, 0] = np.column_stack([0.1 * np.arange(FRAMES), np.full(FRAMES, 0.2), np.full(FRAMES, 0.95)])
    return SkeletonArrays(
        (10**9 + 10_000_000 * np.arange(FRAMES)).astype(np.int64), np.arange(FRAMES), np.array(q_wb), p_w,
        np.zeros((*count, 3)), np.zeros((*count, 3)), np.zeros(count), np.zeros(count, np.uint8), BODY,
    )  # fmt: skip


TAKE = take_of(_moving(), "moving", Axes.Y_UP)


def _written(tmp_path: Path) -> tuple[Path, Path]:
    paths = tmp_path / "moving.osim", tmp_path / "moving.mot"
    for path in paths:
        FORMATS[path.suffix[1:]].write(TAKE, path, 1.0)
    return paths


def _columns(path: Path) -> dict[str, FloatArray]:
    lines = path.read_text().splitlines()
    at = lines.index("endheader") + 1
    table = np.array([line.split("\t") for line in lines[at + 1 :]], float)
    return dict(zip(lines[at].split("\t"), table.T, strict=True))


def _numbers(element: ElementTree.Element, path: str) -> FloatArray:
    return np.array((element.findtext(path) or "").split(), float)


def _placed(osim: Path, columns: dict[str, FloatArray]) -> dict[str, tuple[Rotation, FloatArray]]:
    """Every body in the ground, by what the file says of its joints."""
    found = {"/ground": (Rotation.identity(FRAMES), np.zeros((FRAMES, 3)))}
    for joint in ElementTree.parse(osim).iter("CustomJoint"):
        above, own = joint.findall("frames/PhysicalOffsetFrame")
        turned, place = found[above.findtext("socket_parent") or ""]
        place = place + turned.apply(_numbers(above, "translation"))
        shift = np.zeros((FRAMES, 3))
        for axis in joint.iter("TransformAxis"):
            name = axis.findtext("coordinates") or ""
            along = _numbers(axis, "axis")
            if (axis.get("name") or "").startswith("rotation"):
                turned = turned * Rotation.from_rotvec(np.radians(columns[name])[:, None] * along)
            elif name:
                shift += columns[name][:, None] * along
        found[own.findtext("socket_parent") or ""] = turned, place + shift
    return found


def test_the_model_stands_where_the_take_does(tmp_path: Path) -> None:
    osim, mot = _written(tmp_path)
    found = _placed(osim, _columns(mot))
    for segment, body in (("left_foot", "calcn_l"), ("right_hand", "hand_r"), ("head", "head")):
        s = BODY.index(segment)
        turned, place = found[f"/bodyset/{body}"]
        np.testing.assert_allclose(place, TAKE.p_w[:, s], atol=1e-7)
        assert (turned.inv() * rotation(TAKE.q_wb[:, s])).magnitude().max() < 1e-7
    turned, place = found["/bodyset/pelvis"]
    np.testing.assert_allclose(place - turned.apply(pelvis_origin(BODY)), TAKE.p_w[:, 0], atol=1e-7)
    assert pelvis_origin(BODY)[1] == pytest.approx(0.078, abs=0.01)


def test_the_masses_are_those_of_the_person(tmp_path: Path) -> None:
    osim, _ = _written(tmp_path)
    masses = [float(mass.text or "") for mass in ElementTree.parse(osim).iter("mass")]
    assert sum(masses) == pytest.approx(75.0, rel=1e-3)


def _direction(vectors: FloatArray) -> FloatArray:
    unit: FloatArray = vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
    return unit


@pytest.mark.parametrize(("side", "letter", "out"), [("left", "l", -1.0), ("right", "r", 1.0)])
def test_arms_of_rajagopal_s_model_point_where_the_take_s_do(
    tmp_path: Path, side: str, letter: str, out: float
) -> None:
    """Joints of Rajagopal2015.osim, whose elbow has no carrying angle, and whose forearm is not straight."""
    columns = {name: np.radians(values) for name, values in _columns(_written(tmp_path)[1]).items()}

    def turn(axis: tuple[float, float, float], name: str) -> Rotation:
        unit = np.array(axis) / np.linalg.norm(axis)
        return Rotation.from_rotvec(columns[f"{name}_{letter}"][:, None] * unit)

    mirror = np.array([1.0, 1.0, out])
    torso = rotation(TAKE.q_wb[:, BODY.index("thorax")])
    humerus = torso * turn((0, 0, 1), "arm_flex") * turn((out, 0, 0), "arm_add")
    humerus = humerus * turn((0, out, 0), "arm_rot")
    ulna = humerus * turn((out * 0.22604696, out * 0.022269, 0.97386183), "elbow_flex")
    radius = ulna * turn((out * 0.05639803, out * 0.99840646, 0.001952), "pro_sup")
    elbow = humerus.apply(np.array([0.013144, -0.286273, -0.009595]) * mirror)
    wrist = ulna.apply(np.array([-0.006727, -0.013007, 0.026083]) * mirror)
    wrist = wrist + radius.apply(np.array([-0.008797, -0.235841, 0.01361]) * mirror)
    arm, forearm, hand = (
        TAKE.p_w[:, BODY.index(f"{side}_{part}")] for part in ("upper_arm", "forearm", "hand")
    )
    for theirs, ours in ((elbow, forearm - arm), (wrist, hand - forearm)):
        apart = np.degrees(np.arccos(np.clip(np.sum(_direction(theirs) * _direction(ours), axis=1), -1, 1)))
        assert apart.max() < 6.0


_CHILD = """
import sys, numpy, opensim
opensim.Logger.setLevelString("error")
model = opensim.Model(sys.argv[1])
state = model.initSystem()
lines = open(sys.argv[2]).read().splitlines()
at = lines.index("endheader") + 1
row = dict(zip(lines[at].split("\\t"), map(float, lines[-1].split("\\t"))))
coordinates = model.getCoordinateSet()
for i in range(coordinates.getSize()):
    each = coordinates.get(i)
    value = row[each.getName()]
    each.setValue(state, numpy.radians(value) if each.getMotionType() == 1 else value, False)
model.realizePosition(state)
for i in range(model.getBodySet().getSize()):
    place = model.getBodySet().get(i).getPositionInGround(state)
    print(*(place.get(k) for k in range(3)))
"""


def test_opensim_puts_the_model_there(tmp_path: Path) -> None:
    python = os.environ.get("MOCAP_OPENSIM")
    if python is None:
        pytest.skip("MOCAP_OPENSIM names no Python that has OpenSim")
    osim, mot = _written(tmp_path)
    command = [python, "-I", "-c", _CHILD, str(osim), str(mot)]
    said = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    places = np.array([line.split() for line in said.splitlines()], float)
    expected = TAKE.p_w[-1].copy()
    expected[0] += rotation(TAKE.q_wb[-1:, 0]).apply(pelvis_origin(BODY))[0]
    np.testing.assert_allclose(places, expected, atol=1e-6)


def test_a_take_in_other_axes_is_the_same_model(tmp_path: Path) -> None:
    east: Take = take_of(_moving(), "moving", Axes.Z_UP)
    texts = []
    for k, take in enumerate((TAKE, east)):
        FORMATS["osim"].write(take, tmp_path / f"{k}.osim", 1.0)
        texts.append((tmp_path / f"{k}.osim").read_text())
    assert texts[0] == texts[1]
