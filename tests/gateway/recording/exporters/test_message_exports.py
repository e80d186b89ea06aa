"""Recordings as a bag of ROS 2 and for Foxglove, read by readers that are not ours."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from devices.ros_definitions import TF_MESSAGE, definition
from gateway.body.joint_angles import joint_angles
from gateway.body.skeleton import Skeleton
from gateway.cli.main import app
from gateway.contract import ros_messages as ros
from gateway.errors import GatewayError
from gateway.frames import FloatArray
from gateway.recording import Recording, open_recording
from gateway.recording.exporters import foxglove as of_foxglove
from gateway.recording.exporters import ros2
from gateway.recording.exporters.formats import FORMATS, Axes
from gateway.recording.exporters.message_file import samples_of
from gateway.recording.exporters.take import Take, take_of
from tests.gateway.recording.exporters.test_exported_files import ARRAYS

EQUAL = 1e-9
_EXAMPLES = Path(__file__).parents[4] / "examples"
rosbags_reader = pytest.importorskip("rosbags.rosbag2", reason="rosbags is not installed")
typesys = pytest.importorskip("rosbags.typesys", reason="rosbags is not installed")
TYPES = typesys.get_typestore(typesys.Stores.ROS2_JAZZY)


def bag_of(path: Path) -> dict[str, list[tuple[int, object]]]:
    """(log time, message) by topic, as rosbags reads them."""
    found: dict[str, list[tuple[int, object]]] = {}
    with rosbags_reader.Reader(path) as reader:
        for connection, time_ns, data in reader.messages():
            message = TYPES.deserialize_cdr(data, connection.msgtype)
            found.setdefault(connection.topic, []).append((time_ns, message))
    return found


def stamp_ns(header) -> int:
    return int(header.stamp.sec * 10**9 + header.stamp.nanosec)


def chained(skeleton: Skeleton, transforms: dict[str, tuple[str, FloatArray, FloatArray]], world: str):
    """``q_wb`` (S, 4) and ``p_w`` (S, 3) of (parent, place, rotation x y z w) by child; NaN: not there."""
    q_wb, p_w = np.full((skeleton.n_segments, 4), np.nan), np.full((skeleton.n_segments, 3), np.nan)
    neutral = Rotation.from_quat(skeleton.neutral, scalar_first=True)
    frames: dict[str, tuple[Rotation, FloatArray]] = {world: (Rotation.identity(), np.zeros(3))}
    for s, name in enumerate(skeleton.segment_names):
        if name not in transforms or transforms[name][0] not in frames:
            continue
        parent, place, turn = transforms[name]
        of_parent, from_place = frames[parent]
        frames[name] = of_parent * Rotation.from_quat(turn), from_place + of_parent.apply(place)
        q_wb[s] = (frames[name][0] * neutral).as_quat(scalar_first=True)
        p_w[s] = frames[name][1]
    return q_wb, p_w


def of_message(message) -> dict[str, tuple[str, FloatArray, FloatArray]]:
    return {
        each.child_frame_id: (
            each.header.frame_id,
            np.array([getattr(each.transform.translation, k) for k in "xyz"]),
            np.array([getattr(each.transform.rotation, k) for k in "xyzw"]),
        )
        for each in message.transforms
    }


def assert_same_pose(skeleton, transforms, q_wb, p_w, world="map"):
    found_q, found_p = chained(skeleton, transforms, world)
    known = ~np.isnan(q_wb[:, 0])
    for s, parent in enumerate(skeleton.parents.tolist()):  # what hangs from an unknown one is left out
        known[s] &= parent < 0 or known[parent]
    np.testing.assert_array_equal(~np.isnan(found_q[:, 0]), known)
    signs = np.sign((found_q[known] * q_wb[known]).sum(axis=1, keepdims=True))
    np.testing.assert_allclose(found_q[known] * signs, q_wb[known], atol=EQUAL)
    root = p_w[0] if np.isfinite(p_w[0]).all() else np.zeros(3)
    for s in np.flatnonzero(known).tolist():
        parent = int(skeleton.parents[s])
        expected = root
        if parent >= 0:
            turn = Rotation.from_quat(q_wb[parent], scalar_first=True)
            expected = found_p[parent] + turn.apply(skeleton.offsets[s])
        np.testing.assert_allclose(found_p[s], expected, atol=EQUAL)


@pytest.fixture
def person() -> Take:
    return take_of(ARRAYS, "walk", Axes.Z_UP)


def test_a_bag_holds_every_recorded_pose_at_its_own_instant(tmp_path, person):
    ros2.write(person, tmp_path / "walk.mcap", 1.0)
    bag = bag_of(tmp_path / "walk.mcap")
    times = [time_ns for time_ns, _ in bag["/tf"]]
    assert times == ARRAYS.time_ns.tolist()  # the two frames that were not recorded are not made up
    for k, (time_ns, message) in enumerate(bag["/tf"]):
        assert {stamp_ns(each.header) for each in message.transforms} == {time_ns}
        assert_same_pose(person.skeleton, of_message(message), ARRAYS.q_wb[k], ARRAYS.p_w[k])
    hand = person.skeleton.index("left_hand")
    assert np.isnan(ARRAYS.q_wb[65, hand, 0])


def test_joint_states_are_those_of_rep_155_and_the_same_angles(tmp_path, person):
    ros2.write(person, tmp_path / "walk.mcap", 1.0)
    states = bag_of(tmp_path / "walk.mcap")["/humans/bodies/mocap/joint_states"]
    expected = joint_angles(person.skeleton, ARRAYS.q_wb)
    names = ros.angle_names(person.skeleton.joints)
    for k, (time_ns, state) in enumerate(states):
        assert stamp_ns(state.header) == time_ns
        assert state.name == [name for *_, name in names]
        np.testing.assert_allclose(
            state.position, [expected[k, j, a] for j, a, _ in names], atol=EQUAL, equal_nan=True
        )


def test_axes_are_those_of_rep_103(person):
    """Standing and facing east, x of every segment is forward (east), y left (north), z up."""
    skeleton = person.skeleton
    q_wb = np.tile(skeleton.neutral, (skeleton.n_segments, 1))
    data = ros.BodyTransforms(skeleton).encode(5, q_wb, np.zeros((skeleton.n_segments, 3)))
    transforms = of_message(TYPES.deserialize_cdr(data, TF_MESSAGE))
    for _, _, turn in transforms.values():
        np.testing.assert_allclose(turn, [0, 0, 0, 1], atol=EQUAL)
    assert transforms["left_thigh"][1][1] > 0.05
    assert transforms["right_thigh"][1][1] < -0.05
    assert transforms["head"][1][2] > 0.05


@pytest.mark.parametrize("message", [ros.TF_MESSAGE, ros.JOINT_STATE, ros.IMU, ros.MAGNETIC_FIELD])
def test_definitions_are_those_of_ros(message):
    ours = typesys.get_types_from_msg(definition(message), message)
    assert message in ours
    for name, (_, fields) in ours.items():
        assert fields == TYPES.get_msgdef(name).fields, name


def test_modules_of_a_recording_come_raw_in_their_own_frames(record, tmp_path):
    recording = open_recording(record())
    suit = recording.meta.suit
    samples = list(samples_of(recording))
    take = take_of(recording.skeleton_arrays(), "arm", Axes.Z_UP, recording)
    ros2.write(take, tmp_path / "arm.mcap", 1.0)
    bag = bag_of(tmp_path / "arm.mcap")
    assert sum(len(messages) for topic, messages in bag.items() if topic.endswith("data_raw")) == len(samples)
    ((_, static),) = bag["/tf_static"]
    frames = of_message(static)
    for s, row in enumerate(suit.module_of_segment.tolist()):
        if row < 0:
            continue
        segment = suit.skeleton.segment_names[s]
        own = [sample for sample in samples if sample.module == suit.module_ids[row]]
        for sample, (time_ns, imu) in zip(own, bag[f"/modules/{segment}/imu/data_raw"], strict=True):
            assert stamp_ns(imu.header) == time_ns == sample.time_ns
            assert imu.header.frame_id == f"{segment}_imu"
            assert imu.orientation_covariance[0] == -1  # REP 145: there is no orientation
            force = [getattr(imu.linear_acceleration, k) for k in "xyz"]
            rate = [getattr(imu.angular_velocity, k) for k in "xyz"]
            np.testing.assert_array_equal(force, sample.specific_force)
            np.testing.assert_array_equal(rate, sample.angular_rate)
        parent, place, _ = frames[f"{segment}_imu"]
        turn = Rotation.from_quat(suit.skeleton.neutral, scalar_first=True)
        assert parent == segment
        np.testing.assert_allclose(place, turn.apply(suit.lever_arms[s]), atol=EQUAL)


def test_a_recording_shows_its_poses_to_viewers_as_it_is(record):
    """The recorder's own transforms, by a reader that knows nothing of recordings."""
    path = record()
    recording = open_recording(path)
    arrays = recording.skeleton_arrays()
    with path.open("rb") as file:
        found = [
            (schema.name, schema.encoding, channel.message_encoding, message.data)
            for schema, channel, message in make_reader(file).iter_messages(topics=["/tf"])
        ]
    assert {kind[:3] for kind in found} == {(TF_MESSAGE, "ros2msg", "cdr")}
    assert len(found) == len(arrays.time_ns)
    for k, (*_, data) in enumerate(found):
        message = TYPES.deserialize_cdr(data, TF_MESSAGE)
        assert stamp_ns(message.transforms[0].header) == arrays.time_ns[k]
        assert_same_pose(arrays.skeleton, of_message(message), arrays.q_wb[k], arrays.p_w[k])


def test_what_was_made_for_viewers_is_no_recording(record):
    path = record()
    exported = path.with_name(f"{path.stem}.ros2.mcap")
    ran = CliRunner().invoke(app, ["export", str(path), "--to", "ros2", "--json"])
    assert ran.exit_code == 0, ran.output
    assert exported.exists()
    assert json.loads(ran.output)[0]["file"] == str(exported)
    listed = CliRunner().invoke(app, ["recordings", "list", str(path.parent), "--json"])
    assert "ros2.mcap" not in listed.output


@pytest.mark.parametrize("name", ["ros2", "foxglove"])
def test_other_axes_and_units_are_refused(tmp_path, name):
    path = tmp_path / "walk.mcap"
    with pytest.raises(GatewayError, match="z up"):
        FORMATS[name].write(take_of(ARRAYS, "walk", Axes.Y_UP), path, 1.0)
    with pytest.raises(GatewayError, match="100 units a metre"):
        FORMATS[name].write(take_of(ARRAYS, "walk", Axes.Z_UP), path, 100.0)
    assert not path.exists()


def test_nothing_is_written_where_one_of_the_formats_cannot_be(record):
    path = record()
    ran = CliRunner().invoke(app, ["export", str(path), "--to", "bvh", "--to", "ros2", "--axes", "y-up"])
    assert isinstance(ran.exception, GatewayError)
    assert not path.with_suffix(".bvh").exists()


def test_foxglove_shows_the_same_poses_bones_and_angles(tmp_path, person):
    pytest.importorskip("foxglove", reason="the extra foxglove is not installed")
    pytest.importorskip("mcap_protobuf", reason="mcap-protobuf-support is not installed")
    from mcap_protobuf.decoder import DecoderFactory  # noqa: PLC0415 - may not be installed

    path = tmp_path / "walk.mcap"
    of_foxglove.write(person, path, 1.0)
    found: dict[str, list] = {}
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for schema, channel, message in reader.iter_messages():
            decode = DecoderFactory().decoder_for(channel.message_encoding, schema)
            data = json.loads(message.data) if decode is None else decode(message.data)
            found.setdefault(channel.topic, []).append((schema.name, message.log_time, data))
            if schema.encoding == "jsonschema":
                angles_schema = json.loads(schema.data)
    assert {topic: messages[0][0] for topic, messages in found.items()} == {
        "/tf": "foxglove.FrameTransforms",
        "/body": "foxglove.SceneUpdate",
        "/joint_angles": "mocap.JointAngles",
    }
    for k, (_, time_ns, message) in enumerate(found["/tf"]):
        assert time_ns == ARRAYS.time_ns[k]
        transforms = {
            each.child_frame_id: (
                each.parent_frame_id,
                np.array([getattr(each.translation, name) for name in "xyz"]),
                np.array([getattr(each.rotation, name) for name in "xyzw"]),
            )
            for each in message.transforms
        }
        assert_same_pose(person.skeleton, transforms, ARRAYS.q_wb[k], ARRAYS.p_w[k])
    scene = found["/body"][0][2]
    assert [entity.frame_id for entity in scene.entities] == list(person.skeleton.segment_names)
    neutral = Rotation.from_quat(person.skeleton.neutral, scalar_first=True)
    for entity, tip in zip(scene.entities, person.skeleton.tips, strict=True):
        assert entity.frame_locked
        for bone in entity.cylinders:
            turn = Rotation.from_quat([getattr(bone.pose.orientation, k) for k in "xyzw"])
            middle = np.array([getattr(bone.pose.position, k) for k in "xyz"])
            end = middle + turn.apply([0, 0, bone.size.z / 2])
            np.testing.assert_allclose(end, neutral.apply(tip), atol=EQUAL)
    expected = np.degrees(joint_angles(person.skeleton, ARRAYS.q_wb))
    for j, joint in enumerate(person.skeleton.joints):
        for a, angle in enumerate(joint.angles):
            messages = [message for _, _, message in found["/joint_angles"]]
            values = [message[joint.name].get(angle.name, float("nan")) for message in messages]
            np.testing.assert_allclose(values, expected[:, j, a], atol=1e-9, equal_nan=True)
            assert angles_schema["properties"][joint.name]["properties"][angle.name]["type"] == "number"


@pytest.mark.parametrize("kind", ["ros2", "foxglove"])
def test_rerun_sees_transforms(tmp_path, person, kind):
    """With rerun-sdk, which is 170 MB and in no lock; it is run where it is installed."""
    rerun = shutil.which("rerun", path=str(Path(sys.executable).parent))
    if rerun is None:
        pytest.skip("rerun-sdk is not installed (170 MB): pip install rerun-sdk")
    if kind == "foxglove":
        pytest.importorskip("foxglove", reason="the extra foxglove is not installed")
    path = tmp_path / "walk.mcap"
    {"ros2": ros2.write, "foxglove": of_foxglove.write}[kind](person, path, 1.0)
    convert = [rerun, "mcap", "convert", path, "-o", tmp_path / "walk.rrd"]
    run = subprocess.run(convert, capture_output=True, check=False)
    assert run.returncode == 0, run.stderr.decode()
    show = [sys.executable, _EXAMPLES / "rerun" / "show.py", path, tmp_path / "shown.rrd"]
    run = subprocess.run(show, capture_output=True, check=False)
    assert run.returncode == 0, run.stderr.decode()
    assert (
        b"Transform3D:quaternion"
        in subprocess.run(
            [rerun, "rrd", "print", tmp_path / "shown.rrd"], capture_output=True, check=True
        ).stdout
    )
    shown = subprocess.run([rerun, "rrd", "print", tmp_path / "walk.rrd"], capture_output=True, check=True)
    assert b"Transform3D:quaternion" in shown.stdout


@pytest.mark.parametrize("name", ["ros2", "foxglove"])
def test_a_pause_costs_messages_nothing(record, typed, tmp_path, monkeypatch, name):
    """As they are at the instants that were recorded; formats of a regular rate are refused."""
    paused = replace(ARRAYS, time_ns=ARRAYS.time_ns + 86_400_000_000_000 * (np.arange(len(ARRAYS.q_wb)) > 50))
    monkeypatch.setattr(Recording, "skeleton_arrays", lambda *_: paused)
    code, told = typed("export", record(), "--to", name, "-o", tmp_path / "out", "--json")
    assert code == 0
    assert (told[0]["frames"], told[0]["interpolated"]) == (len(ARRAYS.q_wb), {})
    assert told[0]["seconds"] == pytest.approx(86_400, abs=2)
    with Path(told[0]["file"]).open("rb") as file:
        times = [message.log_time for *_, message in make_reader(file).iter_messages(["/tf"])]
    assert times == paused.time_ns.tolist()
