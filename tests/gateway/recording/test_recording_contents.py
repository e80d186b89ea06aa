"""What goes into a recording comes out of it: bytes, poses, suit, settings; and no secrets."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from devices.calibration import SensorCalibration
from devices.link import SentChunk
from devices.recording_file import RecordingError
from gateway.body.rig import load_rig
from gateway.errors import SettingsError
from gateway.frames import SkeletonFrame
from gateway.outputs.settings import MqttSettings
from gateway.recording import open_recording
from gateway.recording.pose_encoding import decode_skeleton_frame, encode_skeleton_frame
from gateway.recording.snapshot import attachments_of, decode_suit, encode_suit, without_secrets
from gateway.settings import GatewaySettings
from gateway.sources.link_settings import LinkSettings

FIELDS = ("q_wb", "angular_rate", "joint_acceleration", "p_w", "sigma", "status")
RIGS = ("suit_17", "robot_arm_4", "chain_5", "pendulum_3", "single", "single_placed")


@st.composite
def skeleton_frames(draw):
    n = draw(st.integers(1, 6))

    def array(width):
        shape = (n,) if width == 1 else (n, width)
        undefined = st.just(np.full(shape, np.nan))
        bits = hnp.arrays(np.uint64, shape).map(lambda b: b.view(np.float64))  # any float, any NaN
        return draw(st.one_of(undefined, bits))

    return SkeletonFrame(
        sequence=draw(st.integers(-(2**63), 2**63 - 1)),
        time_ns=draw(st.integers(-(2**63), 2**63 - 1)),
        q_wb=array(4),
        angular_rate=array(3),
        joint_acceleration=array(3),
        p_w=array(3),
        sigma=array(1),
        status=draw(hnp.arrays(np.uint8, n)),
        root=draw(st.integers(0, n - 1)),
    )


@given(skeleton_frames())
def test_skeleton_frames_come_back_bit_for_bit(frame):
    back = decode_skeleton_frame(encode_skeleton_frame(frame))
    assert (back.sequence, back.time_ns, back.root) == (frame.sequence, frame.time_ns, frame.root)
    for name in FIELDS:
        was, now = getattr(frame, name), getattr(back, name)
        assert now.shape == was.shape
        assert now.tobytes() == was.tobytes()


@given(st.binary(max_size=200))
def test_other_bytes_are_refused(data):
    try:
        frame = decode_skeleton_frame(data)
    except ValueError:
        return
    assert len(encode_skeleton_frame(frame)) <= len(data)  # what is taken has the size that it says


@pytest.mark.parametrize("rig", RIGS)
def test_suits_come_back_bit_for_bit(rig):
    suit = load_rig(rig)
    back = decode_suit(encode_suit(suit))
    for name in ("module_of_segment", "sensor_to_segment", "lever_arms", "gravity", "magnetic_field"):
        was, now = getattr(suit, name), getattr(back, name)
        assert (now.dtype, now.tobytes()) == (was.dtype, was.tobytes())
    assert back.module_ids == suit.module_ids
    assert back.skeleton.segment_names == suit.skeleton.segment_names
    assert back.skeleton.offsets.tobytes() == suit.skeleton.offsets.tobytes()
    assert [type(device.quantity) for device in back.local_devices] == [
        type(device.quantity) for device in suit.local_devices
    ]
    assert encode_suit(back) == encode_suit(suit)


def test_calibrations_come_back_in_both_forms(tmp_path):
    calibration = SensorCalibration(
        accelerometer_bias=np.array([0.1, 1 / 3, -0.2]), magnetometer_matrix=np.eye(3) * 1.1
    )
    suit = load_rig("single")
    module = suit.module_ids[0]
    suit = dataclasses.replace(suit, calibrations={module: calibration})
    back = decode_suit(encode_suit(suit)).calibrations
    assert back[module].accelerometer_bias.tobytes() == calibration.accelerometer_bias.tobytes()
    settings = GatewaySettings(
        links=[LinkSettings(name="suit", url="/dev/x")], rig="single", reconstructor="independent"
    )
    for name, data in attachments_of(settings, suit).items():
        (tmp_path / name).write_bytes(data)
    edited = load_rig(str(tmp_path / "rig.yaml")).calibrations
    np.testing.assert_allclose(edited[module].magnetometer_matrix, calibration.magnetometer_matrix)
    np.testing.assert_allclose(edited[module].accelerometer_bias, calibration.accelerometer_bias, atol=1e-11)


def test_a_suit_of_a_newer_version_is_refused_in_words():
    plain = json.loads(encode_suit(load_rig("single"))) | {"gloves": 2}
    with pytest.raises(SettingsError, match="'gloves' is not known to this version"):
        decode_suit(json.dumps(plain).encode())


@pytest.mark.parametrize("rig", RIGS)
def test_rig_and_body_are_files_that_can_be_loaded(rig, tmp_path):
    suit = load_rig(rig)
    settings = GatewaySettings(
        links=[LinkSettings(name="suit", url="/dev/x")], rig=rig, reconstructor="independent"
    )
    for name, data in attachments_of(settings, suit).items():
        (tmp_path / name).write_bytes(data)
    again = load_rig(str(tmp_path / "rig.yaml"))
    assert again.module_ids == suit.module_ids
    np.testing.assert_allclose(again.sensor_to_segment, suit.sensor_to_segment, atol=1e-15)
    np.testing.assert_allclose(again.magnetic_field, suit.magnetic_field, atol=1e-9)
    np.testing.assert_array_equal(again.skeleton.tips, suit.skeleton.tips)
    assert len(again.local_devices) == len(suit.local_devices)
    assert [j.name for j in again.skeleton.joints] == [j.name for j in suit.skeleton.joints]
    assert [j.free for j in again.skeleton.joints] == [j.free for j in suit.skeleton.joints]
    assert len(again.skeleton.contacts) == len(suit.skeleton.contacts)
    assert again.skeleton.interpolations == suit.skeleton.interpolations
    assert GatewaySettings.model_validate(yaml.safe_load((tmp_path / "gateway.yaml").read_text())) == settings


def test_no_secret_is_recorded(monkeypatch):
    monkeypatch.setenv("MOCAP_MQTT_PASSWORD", "hush-hush")
    settings = GatewaySettings(
        links=[LinkSettings(name="suit", url="tcp://host:7000")],
        rig="single",
        reconstructor="independent",
        mqtt=MqttSettings(username="anna", password_file="/etc/password"),
    )
    attachments = attachments_of(settings, load_rig("single"))
    assert all(b"hush-hush" not in data for data in attachments.values())
    plain = {"mqtt_password": "a", "Token": "b", "links": [{"psk": "c"}], "password_file": "/etc/x", "n": 1}
    told = without_secrets(plain)
    assert told["password_file"] == "/etc/x"
    assert told["n"] == 1
    assert {told["mqtt_password"], told["Token"], told["links"][0]["psk"]} == {"(not recorded)"}


def test_everything_is_read_back_in_order(record, arm_chunks):
    recording = open_recording(record(name="walk"))
    assert list(recording.chunks()) == arm_chunks
    assert list(recording.sent()) == [SentChunk(b"hello", arm_chunks[-1].arrived_ns, "left")]
    events = list(recording.events())
    assert [event.name for event in events] == ["reset", "recording_ended"]
    assert events[0].data == {"segment": "base"}
    assert [set(counters.values["modules"]) for counters in recording.statistics()] == [{"0", "1", "2", "3"}]
    assert recording.defect is None
    meta = recording.meta
    assert (meta.name, meta.software, meta.from_start, meta.n_parts) == ("walk", "1.2.3", True, 1)
    assert meta.settings.rig == "robot_arm_4"
    assert set(meta.links) == {"left", "right"}
    assert meta.host["libraries"]["numpy"] == np.__version__


def test_arrays_are_the_frames(record):
    recording = open_recording(record())
    frames = list(recording.skeleton_frames())
    arrays = recording.skeleton_arrays()
    assert len(frames) > 150
    assert arrays.q_wb.shape == (len(frames), len(arrays.segment_names), 4)
    assert arrays.rate_hz == pytest.approx(100, rel=0.01)
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(arrays, name)[7], getattr(frames[7], name))
    assert arrays.time_ns[7] == frames[7].time_ns


def test_without_skeleton_frames_there_are_no_arrays(record, arm_chunks):
    recording = open_recording(record(chunks=arm_chunks[:1]))
    with pytest.raises(RecordingError, match="no skeleton frames: make some with"):
        recording.skeleton_arrays()


@pytest.mark.parametrize("name", ["../up", "/etc/passwd", "a/b", ".hidden", "", "a" * 65, "a\nb", "x.mcap"])
def test_names_that_could_mean_another_folder_are_refused(record, name):
    with pytest.raises(RecordingError, match="is no name for a recording"):
        record(name=name)


def test_settings_of_another_version_are_left_out_and_named(record, caplog):
    meta = open_recording(record()).meta
    plain = json.loads(meta.attachments["gateway.yaml"])
    newer = plain | {"gloves": 2, "clock": plain["clock"] | {"leap": True}}
    newer["links"][0]["colour"] = "red"
    meta.attachments = {**meta.attachments, "gateway.yaml": json.dumps(newer).encode()}
    assert meta.settings.rig == "robot_arm_4"
    assert "clock.leap" in caplog.text
    assert "gloves" in caplog.text
    assert "links.0.colour" in caplog.text


@pytest.mark.parametrize(
    ("name", "delay_ms"),
    [("gyro_free_delayed", 500), ("gyro_free_delayed_100ms", 100), ("gyro_free_delayed_200ms", 200)],
)
def test_a_delay_in_the_name_of_a_method_is_read_as_the_setting(record, name, delay_ms):
    meta = open_recording(record()).meta
    plain = json.loads(meta.attachments["gateway.yaml"])
    del plain["reconstructor_delay_ms"]
    meta.attachments = {
        **meta.attachments,
        "gateway.yaml": json.dumps(plain | {"reconstructor": name}).encode(),
    }
    assert (meta.settings.reconstructor, meta.settings.reconstructor_delay_ms) == ("gyro_free", delay_ms)


def test_a_configuration_that_cannot_be_is_said_in_a_line(record):
    meta = open_recording(record()).meta
    plain = json.loads(meta.attachments["gateway.yaml"])
    meta.attachments = {
        **meta.attachments,
        "gateway.yaml": json.dumps(plain | {"reconstructor": "magic"}).encode(),
    }
    with pytest.raises(SettingsError, match=r"'reconstructor' is 'magic': .*no such reconstructor") as error:
        _ = meta.settings
    assert "\n" not in str(error.value)
