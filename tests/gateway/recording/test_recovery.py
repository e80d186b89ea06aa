"""Files that were cut off or damaged anywhere: opened, read up to there, and made whole."""

from __future__ import annotations

import errno
import os

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from devices import recording_format as fmt
from devices.recording_file import RecordingError, RecordingFile
from devices.recording_writer import DerivedRecordingWriter
from gateway.recording import open_recording
from gateway.recording.recovery import recover, recover_in_place
from gateway.recording.summary import recordings_in, summarise


@pytest.fixture
def whole(record, arm_chunks):
    path = record(chunks=arm_chunks[:80])
    return path, path.read_bytes(), list(open_recording(path).items())


def first_message(data: bytes) -> int:
    """Offset of the first MCAP chunk; before it stand the session record and the attachments."""
    return data.index(b"zstd") - 40


@settings(max_examples=12, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(share=st.floats(0, 1))
def test_a_file_cut_anywhere_gives_what_was_before_and_recovers(whole, tmp_path, share):
    _, data, items = whole
    cut = tmp_path / "cut.mcap"
    start = first_message(data)
    cut.write_bytes(data[: start + round(share * (len(data) - start))])
    recording = open_recording(cut)
    found = list(recording.items())
    assert repr(found) == repr(items[: len(found)])
    target = tmp_path / "whole.mcap"
    target.unlink(missing_ok=True)
    done = recover(cut, target)
    again = open_recording(target)
    assert repr(list(again.items())) == repr(found)
    assert again.defect is None
    assert again.meta.session == recording.meta.session
    assert (done.defect is None) == (share == 1.0 or recording.defect is None)
    with target.open("rb") as file:  # the index serves readers that are not ours
        topics = [channel.topic for _, channel, _ in make_reader(file).iter_messages()]
    assert done.messages == len(topics)
    assert len([topic for topic in topics if topic != fmt.TRANSFORMS]) == len(found)


@settings(max_examples=12, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(share=st.floats(0, 0.999), flip=st.integers(1, 255))
def test_a_damaged_byte_costs_a_piece_at_most_and_is_never_believed(whole, tmp_path, share, flip):
    _, data, items = whole
    start = first_message(data)
    position = start + int(share * (len(data) - start))
    damaged = tmp_path / "damaged.mcap"
    damaged.write_bytes(data[:position] + bytes([data[position] ^ flip]) + data[position + 1 :])
    found = [repr(item) for item in open_recording(damaged).items()]
    remaining = iter(repr(item) for item in items)
    assert all(any(item == other for other in remaining) for item in found)  # in order, none invented


def test_recovering_in_place_keeps_the_file_until_the_new_one_is_whole(whole):
    path, data, items = whole
    path.write_bytes(data[:-500])
    done = recover_in_place(path)
    assert done.path == path
    assert "was not closed" in done.defect
    assert repr(list(open_recording(path).items())) == repr(items)
    assert [each.name for each in path.parent.iterdir()] == [path.name]


def test_a_full_disk_is_said_with_the_remedy_and_the_file_stays(whole, monkeypatch):
    path, data, _ = whole

    def full(*_arguments, **_named):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(DerivedRecordingWriter, "flush", full)
    monkeypatch.setattr(DerivedRecordingWriter, "__exit__", full)
    with pytest.raises(RecordingError, match="the disk is full: make room, or name another place"):
        recover_in_place(path)
    assert path.read_bytes() == data


def test_what_is_no_recording_is_said(tmp_path, whole):
    path, data, _ = whole
    for name, content in (("empty", b""), ("text", b"hello"), ("magic", data[:8]), ("head", data[:60])):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(RecordingError, match="is no recording of mocap-gateway"):
            open_recording(tmp_path / name)
    with pytest.raises(RecordingError, match="No such file"):
        open_recording(tmp_path / "absent.mcap")
    with pytest.raises(RecordingError, match="exists already"):
        recover(path, path)


def test_a_newer_format_is_refused_in_words(tmp_path, whole):
    _, data, _ = whole
    newer = data.replace(
        b"\x06\x00\x00\x00format\x01\x00\x00\x001", b"\x06\x00\x00\x00format\x01\x00\x00\x009", 1
    )
    assert newer != data
    (tmp_path / "newer.mcap").write_bytes(newer)
    with pytest.raises(RecordingError, match="format 9; this program reads format 1"):
        open_recording(tmp_path / "newer.mcap")


def test_figures_are_the_same_from_the_index_and_from_reading(whole):
    path, data, _ = whole
    by_index = summarise(open_recording(path))
    path.write_bytes(data[:-100])
    by_reading = summarise(open_recording(path))
    assert by_index.defect is None
    assert "was not closed" in by_reading.defect
    assert by_index.messages["/chunks/left"] == by_reading.messages["/chunks/left"] > 30
    assert by_index.modules == by_reading.modules
    assert by_index.duration_s == pytest.approx(by_reading.duration_s, abs=0.05)
    assert 0 <= by_index.loss_percent < 20


def test_folders_are_listed_with_what_is_not_readable(whole):
    path, _, _ = whole
    (path.parent / "broken.mcap").write_bytes(b"broken")
    (path.parent / "notes.txt").write_text("notes")
    found = list(recordings_in(path.parent))
    assert [isinstance(each, RecordingError) for each in found] == [False, True]
    with pytest.raises(RecordingError, match=r"there is no folder .*absent: the first `mocap"):
        list(recordings_in(path.parent / "absent"))


@pytest.fixture
def ten_pieces(tmp_path):
    """A recording of ten poses, each a piece of its own, and where the pieces begin."""
    path = tmp_path / "pieces.mcap"
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=100, compression=CompressionType.ZSTD)
        writer.start(fmt.PROFILE, "test")
        writer.add_metadata(fmt.SESSION, {"format": str(fmt.FORMAT_VERSION), "links": "{}"})
        channel = writer.register_channel(fmt.SKELETON, "bytes", 0, {})
        for k in range(10):
            writer.add_message(channel, k, bytes([k]) * 200, k)
        writer.finish()
    with path.open("rb") as file:
        starts = [index.chunk_start_offset for index in make_reader(file).get_summary().chunk_indexes]
    return path, starts


def poses_in(path):
    """The numbers of the poses that can be read, and the file."""
    file = RecordingFile(path)
    found = list(file.messages())
    assert {message.topic for message in found} <= {fmt.SKELETON}
    return [message.data[0] for message in found], file


def test_a_damaged_first_piece_costs_no_message_of_those_after_it(ten_pieces):
    """A channel is named within its first piece alone; poses of a whole recording were lost with one byte."""
    path, _ = ten_pieces
    data = bytearray(path.read_bytes())
    data[data.index(b"zstd") + 30] ^= 0xFF
    path.write_bytes(data)
    found, file = poses_in(path)
    assert file.damaged_chunks == 1
    assert found == list(range(1, 10))


@pytest.mark.parametrize("first", [0, 3])
def test_a_stretch_of_zeros_costs_what_stood_there_and_nothing_after_it(ten_pieces, tmp_path, first):
    """A bad sector of the disk: of a recording of 20 s what came after it was lost, and recovering it in
    place would have thrown that away."""
    path, starts = ten_pieces
    data = bytearray(path.read_bytes())
    begin, end = starts[first] + 5, starts[first + 2] + 20
    data[begin:end] = bytes(end - begin)
    path.write_bytes(data)
    found, file = poses_in(path)
    assert found == [k for k in range(10) if not first <= k <= first + 2]
    assert "damaged pieces were left out" in file.defect
    assert recover_in_place(path).defect == file.defect
    assert poses_in(path)[0] == found


def test_whatever_byte_of_a_head_is_damaged_that_piece_alone_is_lost(ten_pieces):
    path, starts = ten_pieces
    data = path.read_bytes()
    without = [k for k in range(10) if k != 4]
    for at in range(starts[4], starts[4] + 49):
        for flip in (0x01, 0x80, 0xFF):
            path.write_bytes(data[:at] + bytes([data[at] ^ flip]) + data[at + 1 :])
            assert poses_in(path)[0] in (without, list(range(10)))


def test_a_file_that_was_made_to_be_searched_for_ever_is_given_up(ten_pieces, monkeypatch):
    path, starts = ten_pieces
    data = path.read_bytes()
    piece = data[starts[4] : starts[5]]
    path.write_bytes(data[: starts[4]] + (piece[:-1] + b"\xff" * 20) * 50 + data[starts[5] :])
    monkeypatch.setattr("devices.recording_file.MOST_GAPS", 10)
    found, file = poses_in(path)
    assert len(found) < 20
    assert "is damaged: read up to byte" in file.defect
