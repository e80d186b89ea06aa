"""Poses made again from a recording: the same bit for bit, or with another rig; and their difference."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from devices import recording_format as fmt
from devices.recording_file import RecordingError, RecordingFile
from devices.recording_writer import RecordingWriter
from gateway.cli.compare import difference_page
from gateway.errors import GatewayError
from gateway.geometry import quaternion
from gateway.recording import open_recording
from gateway.recording.difference import difference
from gateway.recording.solving import SolvingSetup, recorded_setup, solve, verify, write_solved
from gateway.report.angle_page import save_page
from gateway.settings import ClockSettings, RecordingSettings


def rewritten(path, target, change):
    """A copy of a recording with each message as ``change(message)`` has it; None leaves it out."""
    file = RecordingFile(path)
    with RecordingWriter(target, file.head.session, file.head.attachments, 0) as writer:
        for message in file.messages():
            data = change(message)
            if data is not None:
                writer.add(message.topic, message.time_ns, data)
    return open_recording(target)


def test_every_pose_comes_out_again_bit_for_bit(record):
    recording = open_recording(record())
    found = verify(recording)
    assert (found.is_identical, found.difference, found.not_recorded) == (True, None, 0)
    assert found.compared == len(list(recording.skeleton_frames())) > 150
    solved = recording.skeleton_arrays()
    again = np.stack([frame.q_wb for frame in solve(recording)])
    assert again.tobytes() == solved.q_wb.tobytes()


def test_also_over_rotated_parts(record):
    settings = RecordingSettings(min_free_mb=0, warn_free_mb=0, flush_ms=10, rotate_mb=0.02)
    recording = open_recording(record(settings))
    assert recording.meta.n_parts >= 2
    assert verify(recording).is_identical


def test_the_last_bit_of_one_number_is_found(record, tmp_path):
    count = 0

    def change(message):
        nonlocal count
        count += message.topic == fmt.SKELETON
        if message.topic == fmt.SKELETON and count == 100:
            flipped = bytearray(message.data)
            flipped[24 + message.data[20] + 8] ^= 1  # lowest bit of a quaternion's component
            return bytes(flipped)
        return message.data

    found = verify(rewritten(record(), tmp_path / "flipped.mcap", change))
    assert (found.is_identical, found.compared) == (False, 99)
    assert found.difference.startswith("frame 99 (sequence ")
    assert "orientations differ by up to" in found.difference


def test_a_missing_chunk_is_found(record, tmp_path, arm_chunks):
    missing = arm_chunks[len(arm_chunks) // 2]

    def change(message):
        is_missing = message.topic.startswith(fmt.CHUNKS) and message.data == missing.data
        return None if is_missing else message.data

    assert not verify(rewritten(record(), tmp_path / "less.mcap", change)).is_identical


def test_without_poses_there_is_nothing_to_verify(record):
    settings = RecordingSettings(min_free_mb=0, warn_free_mb=0, flush_ms=10)
    path = record(settings)
    bare = path.with_name("bare.mcap")
    rewritten(path, bare, lambda message: None if message.topic == fmt.SKELETON else message.data)
    with pytest.raises(RecordingError, match="has no skeleton frames to compare with"):
        verify(open_recording(bare))


def test_another_calibration_turns_the_segment_and_is_kept_with_the_result(record, tmp_path):
    recording = open_recording(record())
    setup = recorded_setup(recording)
    suit = setup.suit
    segment = int(np.flatnonzero(suit.module_of_segment >= 0)[1])
    turn = np.array([np.cos(np.pi / 12), 0.0, np.sin(np.pi / 12), 0.0])  # 30° in the sensor's axes
    turned = suit.sensor_to_segment.copy()
    turned[segment] = quaternion.multiply(suit.sensor_to_segment[segment], turn)
    other = SolvingSetup(dataclasses.replace(suit, sensor_to_segment=turned), setup.settings)
    target = tmp_path / "turned.mcap"
    assert write_solved(recording, target, other) == len(recording.skeleton_arrays().time_ns)
    result = open_recording(target)
    assert verify(result).is_identical  # a recording like any other
    assert list(result.chunks()) == list(recording.chunks())
    np.testing.assert_array_equal(result.meta.suit.sensor_to_segment, turned)
    found = difference(recording.skeleton_arrays(), result.skeleton_arrays())
    rms = {figures.segment: figures.rms_deg for figures in found.segments}
    name = suit.skeleton.segment_names[segment]
    assert rms.pop(name) == pytest.approx(30, abs=1e-6)
    assert max(value for value in rms.values() if not np.isnan(value)) < 1e-5
    with pytest.raises(RecordingError, match="exists already"):
        write_solved(recording, target, other)


def test_the_recorded_clock_table_is_used_where_the_file_is_gone(record):
    recording = open_recording(record())
    table = "reference: 0\nranking: [0, 1]\nalpha: {0: [1.0], 1: [1.00001]}\n"
    recording.meta.attachments = {**recording.meta.attachments, fmt.CLOCK_TABLE: table.encode()}
    setup = recorded_setup(recording)
    clock = ClockSettings(mode="table", table="/gone/table.yaml")
    setup = dataclasses.replace(setup, settings=setup.settings.model_copy(update={"clock": clock}))
    assert sum(1 for _ in solve(recording, setup)) > 150


def test_results_are_compared_where_both_have_the_instant(record):
    arrays = open_recording(record()).skeleton_arrays()
    later = dataclasses.replace(
        arrays, **{name: getattr(arrays, name)[10::2] for name in ("time_ns", "sequence", "q_wb", "status")}
    )
    found = difference(arrays, later)
    assert found.angle_deg.shape == (len(later.time_ns), len(arrays.segment_names))
    assert np.nanmax(found.angle_deg) < 1e-5
    with pytest.raises(GatewayError, match="no instant in common"):
        difference(arrays, dataclasses.replace(arrays, time_ns=arrays.time_ns + 10**12))
    with pytest.raises(GatewayError, match="no segment is known in both"):
        difference(arrays, dataclasses.replace(arrays, q_wb=np.full_like(arrays.q_wb, np.nan)))
    named = dataclasses.replace(
        arrays.skeleton, segment_names=("a", "b", "c", "d")[: len(arrays.segment_names)]
    )
    with pytest.raises(GatewayError, match="no segment in common"):
        difference(arrays, dataclasses.replace(arrays, skeleton=named))


@pytest.mark.parametrize(
    ("ending", "magic"), [("png", b"\x89PNG"), ("html", b"<!doctype html>"), ("svg", b"<?xml")]
)
def test_differences_are_drawn(record, tmp_path, ending, magic):
    pytest.importorskip("matplotlib")
    arrays = open_recording(record()).skeleton_arrays()
    target = tmp_path / f"plot.{ending}"
    save_page(difference_page(difference(arrays, arrays), "the same <twice>"), target)
    content = target.read_bytes()
    assert content.startswith(magic)
    assert len(content) > 5000
    assert b"<twice>" not in content
    with pytest.raises(GatewayError, match=r"as \.png, \.svg, \.pdf or \.html"):
        save_page(difference_page(difference(arrays, arrays), ""), tmp_path / "plot.gif")
