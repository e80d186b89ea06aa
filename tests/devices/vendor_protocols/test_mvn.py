"""Datagrams of the MVN network streamer: layouts as readers have them, round trips, noise."""

from __future__ import annotations

import math
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from devices.vendor_protocols.mvn import (
    JOINT_ANGLES,
    META,
    PARENTS,
    QUATERNIONS,
    SEGMENTS,
    TIME_CODE,
    TO_ISB,
    TRACKERS,
    Datagram,
    JointRotation,
    MvnDecoder,
    SegmentPose,
    Tracker,
    encode,
    encode_scale,
    encode_text,
)
from devices.vendor_protocols.rotations import in_turn, zxy_angles
from gateway.geometry import quaternion

floats = st.floats(-30, 30, width=32)
vectors = st.tuples(floats, floats, floats)
trackers = st.builds(
    Tracker, st.integers(1, 23), st.just((0.6, 0.0, 0.8, 0.0)), vectors, vectors, vectors, vectors
)


def test_the_layout_of_a_pose_is_that_of_other_programs():
    data = encode(QUATERNIONS, 123, 4567, [SegmentPose(1, (1.0, 2.0, 3.0), (1.0, 0.0, 0.0, 0.0))])
    assert data[:6] == b"MXTP02"
    assert struct.unpack(">i", data[6:10]) == (123,)
    assert data[10:12] == b"\x80\x01"
    assert struct.unpack(">i", data[12:16]) == (4567,)
    assert data[16:24] == bytes((0, 23, 0, 0, 0, 0, 0, 32))
    assert struct.unpack(">i3f4f", data[24:]) == (1, 1.0, 2.0, 3.0, 1.0, 0.0, 0.0, 0.0)


def test_the_layouts_of_joints_texts_and_scales_too():
    joints = encode(JOINT_ANGLES, 1, 2, [JointRotation(1, 2, (10.0, 20.0, 30.0))])
    assert struct.unpack(">ii3f", joints[24:]) == (256, 512, 10.0, 20.0, 30.0)
    assert encode_text(META, 1, 2, "name:A\n")[24:] == b"\0\0\0\x07name:A\n"
    scale = encode_scale(1, 2, {"pelvis": (0.0, 0.0, 1.0)})[24:]
    assert scale == struct.pack(">Ii6s3fI", 1, 6, b"pelvis", 0.0, 0.0, 1.0, 0)


@given(st.lists(trackers, max_size=17), st.lists(st.integers(1, 300)), st.integers(0, 2**31 - 1))
def test_trackers_come_back_however_the_bytes_are_cut(items, cuts, sample):
    data, decoder, found = encode(TRACKERS, sample, 5, items, character=2), MvnDecoder(), []
    for cut in [*cuts, len(data)]:
        found += decoder.feed(data[:cut])
        data = data[cut:]
    (datagram,) = found
    assert (datagram.sample, datagram.time_ms, datagram.character) == (sample, 5, 2)
    for read, sent in zip(datagram.items, items, strict=True):
        assert read.segment == sent.segment
        assert read.specific_force == sent.specific_force
        assert read.angular_rate == sent.angular_rate
        assert read.field == sent.field


def test_older_versions_do_not_tell_how_many_bytes_follow():
    data = bytearray(encode(QUATERNIONS, 1, 2, [SegmentPose(4, (0, 0, 0), (0.0, 1.0, 0.0, 0.0))]))
    data[16:24] = bytes(8)
    assert len(MvnDecoder().feed(bytes(data))) == 1


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (encode(QUATERNIONS, 1, 2, [SegmentPose(1, (0, 0, 0), (0.5, 0.0, 0.0, 0.0))]), "not_a_rotation"),
        (encode(QUATERNIONS, 1, 2, [SegmentPose(0, (0, 0, 0), (1.0, 0.0, 0.0, 0.0))]), "no_segment"),
        (encode(QUATERNIONS, 1, 2, [SegmentPose(1, (1e6, 0, 0), (1.0, 0.0, 0.0, 0.0))]), "too_far"),
        (encode(QUATERNIONS, 1, 2, [SegmentPose(1, (math.nan, 0, 0), (1.0, 0, 0, 0))]), "not_finite"),
        (encode(JOINT_ANGLES, 1, 2, [JointRotation(1, 2, (1000.0, 0.0, 0.0))]), "no_angle"),
        (b"MXTP02" + bytes(5) + b"\x02" + bytes(10) + b"\0\x20" + bytes(32), "bad_length"),
        (b"nothing", "noise"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_dropped_and_counted_by_reason(data, reason):
    decoder = MvnDecoder()
    assert decoder.feed(data) == []
    assert reason in decoder.dropped
    assert len(decoder.feed(encode(QUATERNIONS, 1, 2, []))) == 1


def test_kinds_that_nothing_is_made_from_are_counted():
    decoder = MvnDecoder()
    texts = encode_text(META, 1, 2, "name:A\n") + encode_text(TIME_CODE, 1, 2, "12:00:00.000")
    (found,) = decoder.feed(texts + encode_scale(1, 2, {"pelvis": (0, 0, 1)}) + encode(QUATERNIONS, 7, 8, []))
    assert (found, decoder.unused, decoder.dropped) == (Datagram(7, 8, 0, ()), 3, {})


@given(st.binary(max_size=400))
def test_no_bytes_raise(data):
    decoder = MvnDecoder()
    decoder.feed(data)
    decoder.feed(b"MXTP02" + data)


def test_segments_hang_together_and_axes_are_rotations():
    assert len(SEGMENTS) == len(PARENTS) == len(TO_ISB) == 23
    assert all(parent < number for number, parent in enumerate(PARENTS, 1))
    assert np.allclose(np.linalg.norm(TO_ISB, axis=1), 1.0)


@given(st.tuples(st.floats(-1.5, 1.5), st.floats(-3.1, 3.1), st.floats(-3.1, 3.1)))
def test_angles_of_a_joint_come_back(angles):
    x, y, z = angles
    assert zxy_angles(in_turn(("z", z), ("x", x), ("y", y))) == pytest.approx(angles, abs=1e-6)
    turned = quaternion.rotate(np.array(in_turn(("z", z))), np.array([1.0, 0.0, 0.0]))
    assert turned == pytest.approx([math.cos(z), math.sin(z), 0.0], abs=1e-12)
