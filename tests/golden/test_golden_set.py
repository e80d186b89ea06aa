"""Poses of the golden set come out as they were stored, and whatever differs is noticed."""

import json
import shutil
import warnings
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from devices.link import SUIT, Chunk, Framing
from devices.recording_file import RecordingError
from gateway.frames import Status
from gateway.reconstruction import DELAYABLE, OFFLINE, OPTICAL, RECONSTRUCTORS
from gateway.reconstruction.smoothing import SMOOTHED as CAN_BE_SMOOTHED
from gateway.recording import open_recording
from gateway.recording.pose_encoding import decode_skeleton_frame, encode_skeleton_frame
from gateway.recording.solving import solve
from gateway.sources.clock_mode import ClockMode
from gateway.sources.registry import SOURCES
from tests.golden.__main__ import main, record, renew
from tests.golden.golden_set import DELAY, FOLDER, METHODS, SMOOTHED, Case, cases, fed_live
from tests.golden.poses import (
    PoseMessages,
    compare,
    messages_of,
    other_kind,
    read_poses,
    sha256,
    this_machine,
    write_poses,
)
from tests.golden.recipes import RECIPES, Capture

RENEW = "if poses are meant to change, run `make golden-renew`"
CHEAP = Case("fused", "fused")
LARGEST_SET_BYTES = 3_500_000

stored = cache(lambda case: read_poses(case.poses_path))


def assert_as_stored(case, now):
    """To the last bit on the kind of machine that the stored poses were made on, to 1e-9 on others."""
    before = stored(case)
    assert before.recording_sha256 == sha256(case.recording_path), f"{case}: another recording; {RENEW}"
    found, other = compare(before.poses, now), other_kind(before.machine)
    if other:
        how = f"to 1e-9, as the stored ones were made on another kind of machine ({other})"
        warnings.warn(f"golden poses are compared {how}", stacklevel=1)
    else:
        how = "to the last bit"
    is_same = found.is_within_tolerance if other else found.is_identical
    assert is_same, f"{case}, compared {how}: {found.first}; {found.largest}; {RENEW}"


@pytest.mark.parametrize("case", cases(), ids=str)
def test_poses_come_out_as_they_were_stored(case):
    assert_as_stored(case, case.solved())


@pytest.mark.parametrize("name", [name for name in METHODS if name != "light_and_field"])
def test_a_running_gateway_makes_the_same_poses(name):
    recording = open_recording(Case(name, "").recording_path)
    is_video = recording.meta.suit.video is not None
    method = "video" if is_video else recording.meta.settings.reconstructor
    assert_as_stored(Case(name, method), messages_of(fed_live(recording)))


def test_a_recording_that_tells_a_delay_in_the_name_of_its_method_gives_the_same_poses():
    recording = open_recording(Case("serial", "").recording_path)
    plain = json.loads(recording.meta.attachments["gateway.yaml"])
    told = json.dumps(plain | {"reconstructor": "gyro_free_delayed_100ms"}).encode()
    recording.meta.attachments = {**recording.meta.attachments, "gateway.yaml": told}
    assert_as_stored(Case("serial", "gyro_free_100ms"), messages_of(solve(recording)))


def test_every_method_source_and_clock_is_in_the_set():
    methods = {method for chosen in METHODS.values() for method in chosen}
    smoothed = {name + SMOOTHED for name in CAN_BE_SMOOTHED}
    late = {f"gyro_free_{delay_ms}ms" for delay_ms in (100, 200, 500)}
    assert {DELAY.sub("", name) for name in late} == DELAYABLE
    assert methods == {*RECONSTRUCTORS, OPTICAL, *OFFLINE, *smoothed, *late, "video", "video_offline"}
    metas = [open_recording(Case(name, "").recording_path).meta for name in METHODS]
    contents = {content for meta in metas for content in meta.links.values()}
    assert contents == {*Framing, *SOURCES} - {SUIT}
    assert {meta.settings.clock.mode for meta in metas} == set(ClockMode)


def test_the_set_has_the_files_of_its_cases_and_no_others():
    files = {path for path in FOLDER.rglob("*") if path.suffix == ".mcap"}
    assert files == {path for case in cases() for path in (case.recording_path, case.poses_path)}
    assert set(RECIPES) == set(METHODS)
    assert sum(path.stat().st_size for path in files) < LARGEST_SET_BYTES


@pytest.mark.parametrize("case", cases(), ids=str)
def test_stored_poses_are_worth_being_compared(case):
    """Every segment is known in most frames, most frames differ, and is sometimes measured."""
    frames = [decode_skeleton_frame(pose.skeleton) for pose in stored(case).poses]
    q_wb, status = (np.stack([getattr(frame, name) for frame in frames]) for name in ("q_wb", "status"))
    known = np.isfinite(q_wb).all(axis=2)
    assert len(frames) >= 10
    assert (known.mean(axis=0) > 0.5).all()
    assert (status <= Status.INTERPOLATED).any()
    assert len({q.tobytes() for q in q_wb}) > 0.6 * len(frames)


# What differs is noticed.


def changed(k, **arrays):
    """The cheap case's poses with arrays of the k-th changed in place by functions."""
    poses = list(stored(CHEAP).poses)
    frame = decode_skeleton_frame(poses[k].skeleton)
    for name, change in arrays.items():
        change(getattr(frame, name))
    poses[k] = PoseMessages(encode_skeleton_frame(frame), None)
    return poses


def by_one_bit(values):
    values[0, 1] = np.nextafter(values[0, 1], 2.0)


def by_more_than_rounding(values):
    values[1] += 3e-9


def by_far_more_than_rounding(values):
    values[1] += 3e-7


def undefined(values):
    values[0] = np.nan


def negated(values):
    values *= -1.0


def predicted(values):
    values[0] = Status.PREDICTED


@pytest.mark.parametrize("name", ["q_wb", "p_w", "angular_rate"])
def test_one_bit_of_one_number_is_noticed_and_is_rounding_elsewhere(name):
    found = compare(stored(CHEAP).poses, changed(7, **{name: by_one_bit}))
    assert not found.is_identical
    assert found.is_within_tolerance
    assert (found.moved, found.first) == (1, "pose 7 (counted from 0): numbers")


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("q_wb", by_more_than_rounding), ("p_w", by_more_than_rounding),
        ("angular_rate", by_far_more_than_rounding),
        ("q_wb", undefined), ("p_w", undefined), ("status", predicted),
    ],
)  # fmt: skip
def test_what_is_more_than_rounding_is_noticed_everywhere(name, change):
    found = compare(stored(CHEAP).poses, changed(7, **{name: change}))
    assert not found.is_identical
    assert not found.is_within_tolerance


def test_a_quaternion_and_its_negative_are_the_same_angle_but_not_the_same_bits():
    found = compare(stored(CHEAP).poses, changed(7, q_wb=negated))
    assert found.largest["angle"] < 1e-15
    assert found.is_within_tolerance
    assert not found.is_identical


@pytest.mark.parametrize("k", [0, 7, -1])
def test_a_missing_or_repeated_pose_is_noticed_everywhere(k):
    poses = stored(CHEAP).poses
    fewer = [pose for pose in poses if pose is not poses[k]]
    for before, now in ((poses, fewer), (fewer, poses), (poses, [*poses, poses[k]])):
        found = compare(before, now)
        assert not found.is_identical
        assert not found.is_within_tolerance


def test_what_became_of_markers_is_compared():
    poses = stored(Case("markers", "optical")).poses
    assert compare(poses, poses).is_identical
    other = list(poses)
    other[9] = other[9]._replace(markers=None)
    assert compare(poses, other).unlike == "pose 9 (counted from 0): markers came or went"
    markers = bytearray(poses[9].markers)
    markers[20] ^= 1  # whose point the first marker was given
    other[9] = poses[9]._replace(markers=bytes(markers))
    assert compare(poses, other).unlike == "pose 9 (counted from 0): markers were named otherwise"


# The command.


@pytest.fixture
def copied(tmp_path):
    """The cheap case in a folder of its own."""
    case = replace(CHEAP, folder=tmp_path)
    for path, source in ((case.recording_path, CHEAP.recording_path), (case.poses_path, CHEAP.poses_path)):
        path.parent.mkdir()
        shutil.copy(source, path)
    return case


def store(case, poses, **machine):
    """Store other poses, as made here or on another machine."""
    write_poses(case.poses_path, stored(CHEAP)._replace(poses=poses, machine={**this_machine(), **machine}))


def test_renewing_says_unchanged_and_stores_nothing_when_nothing_moved(copied, capsys):
    store(copied, copied.solved())
    before = copied.poses_path.read_bytes()
    assert renew([copied]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "unchanged: 1 of 1"
    assert copied.poses_path.read_bytes() == before


def test_renewing_says_by_how_much_poses_moved(copied, capsys):
    store(copied, changed(7, p_w=by_more_than_rounding))
    assert renew([copied], is_stored=False) == 1
    assert renew([copied]) == 1
    row, last = capsys.readouterr().out.splitlines()[-2:]
    assert row.split()[:5] == ["fused.fused", str(len(stored(CHEAP).poses)), "1", "0", "3.0e-09"]
    assert last == "renewed: fused.fused; unchanged: 0 of 1"
    assert compare(stored(CHEAP).poses, read_poses(copied.poses_path).poses).is_within_tolerance
    assert renew([copied]) == 0


def test_rounding_of_another_machine_is_left_unless_this_one_is_to_tell_bits(copied, capsys):
    store(copied, changed(7, p_w=by_one_bit), processor="another")
    assert renew([copied]) == 0
    assert "another kind of machine (processor)" in capsys.readouterr().out
    assert renew([copied], is_here=True) == 1
    assert other_kind(read_poses(copied.poses_path).machine) == ""
    assert renew([copied]) == 0


def test_a_recording_is_made_once_and_its_poses_follow(tmp_path, capsys):
    record("fused", tmp_path, seconds=0.3)
    case = replace(CHEAP, folder=tmp_path)
    assert renew([case]) == 1
    assert " new" in capsys.readouterr().out
    assert len(read_poses(case.poses_path).poses) > 5
    with pytest.raises(RecordingError, match="exists already"):
        record("fused", tmp_path, seconds=0.3)


@pytest.mark.parametrize("name", sorted(set(RECIPES) - {"hips", "heat_maps"}))  # pictures take long to draw
def test_recipes_still_make_recordings(name):
    capture = RECIPES[name](0.2)
    assert isinstance(capture, Capture)
    assert {item.link for item in capture.items if isinstance(item, Chunk)} <= set(capture.framings)
    assert capture.items


def test_a_name_that_no_case_has_is_refused(capsys):
    with pytest.raises(SystemExit):
        main(["renew", "seriall"])
    assert "no case 'seriall'" in capsys.readouterr().err
