"""Recordings made of other things appear once they are whole."""

import pytest

from devices.link import Framing
from devices.recording_file import RecordingError, RecordingFile
from devices.recording_writer import DerivedRecordingWriter, session_record

SESSION = session_record({"suit": Framing.BYTE_STREAM}, begun_ns="1", name="walk")


def begun(target):
    return DerivedRecordingWriter(target, SESSION, {}, 1)


def test_it_has_its_name_once_it_is_whole_and_not_before(tmp_path):
    target = tmp_path / "walk.mcap"
    with begun(target) as writer:
        writer.add("/events", 5, b"{}")
        writer.flush()
        assert not target.exists()
    assert list(tmp_path.iterdir()) == [target]
    assert RecordingFile(target).head.session["name"] == "walk"


def test_an_error_on_the_way_leaves_nothing(tmp_path):
    with pytest.raises(ZeroDivisionError), begun(tmp_path / "walk.mcap"):
        1 / 0  # noqa: B018 - whatever goes wrong
    assert list(tmp_path.iterdir()) == []


def test_what_a_killed_process_left_is_in_nobodys_way(tmp_path):
    target = tmp_path / "walk.mcap"
    killed = begun(target)
    killed.add("/events", 5, b"{}")
    killed.flush()
    killed.abandon()  # the system closes it; nothing else happens
    assert [path.name for path in tmp_path.iterdir()] == [".walk.mcap.unfinished"]
    with begun(target):
        pass
    assert list(tmp_path.iterdir()) == [target]


def test_one_that_is_there_is_never_written_over(tmp_path):
    target = tmp_path / "walk.mcap"
    target.write_bytes(b"mine")
    with pytest.raises(RecordingError, match="exists already"):
        begun(target)
    assert target.read_bytes() == b"mine"
    assert list(tmp_path.iterdir()) == [target]


def test_what_it_replaces_stays_until_it_is_whole(tmp_path):
    target = tmp_path / "walk.mcap"
    target.write_bytes(b"earlier")
    with DerivedRecordingWriter(target, SESSION, {}, 1, replaces=True):
        assert target.read_bytes() == b"earlier"
    assert RecordingFile(target).head.session["name"] == "walk"
    assert list(tmp_path.iterdir()) == [target]


@pytest.mark.parametrize("name", ["walk.csv", "walk", "walk.ros2.mcap"])
def test_a_name_that_no_recording_has_is_refused(name, tmp_path):
    with pytest.raises(RecordingError, match=r"is a recording: name it walk\.mcap"):
        begun(tmp_path / name)
    assert list(tmp_path.iterdir()) == []
