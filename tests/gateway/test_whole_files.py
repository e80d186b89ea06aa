"""A file that cannot be written whole is not written at all."""

from __future__ import annotations

import errno
import os
import stat
from datetime import UTC, datetime

import pytest

from devices.link import Framing
from devices.recording_writer import RecordingWriter, session_record
from gateway.body.subject_file import write_subject
from gateway.calibration.mounting import history, keep, restore
from gateway.calibration.rig_file import write_calibrated_rig
from gateway.cli import body
from gateway.cli.calibrate import _write_cameras
from gateway.clocks.table import clock_table, save_clock_table
from gateway.errors import GatewayError
from gateway.support.settings_files import shipped_folder
from gateway.support.whole_files import replacing, replacing_by_name, write_whole

NOW = datetime(2026, 5, 1, tzinfo=UTC)


@pytest.fixture
def full_disk(monkeypatch):
    """From its call on nothing can be written any more, though files can be made."""

    def fill():
        def fails(*_):
            raise OSError(28, "No space left on device")

        monkeypatch.setattr(os, "write", fails)
        monkeypatch.setattr(os, "fsync", fails)

    return fill


def names(folder):
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())


def test_a_file_is_replaced_whole_with_its_mode_and_through_a_link(tmp_path):
    file, link = tmp_path / "rig.yaml", tmp_path / "link.yaml"
    write_whole(file, b"first")
    assert file.stat().st_mode & 0o777 == 0o666 & ~_mask()
    file.chmod(0o640)
    link.symlink_to(file)
    write_whole(link, b"second")
    assert file.read_bytes() == b"second"
    assert file.stat().st_mode & 0o777 == 0o640
    assert link.is_symlink()
    assert names(tmp_path) == ["link.yaml", "rig.yaml"]


def _mask():
    mask = os.umask(0)
    os.umask(mask)
    return mask


def test_a_full_disk_leaves_the_file_as_it_was(tmp_path, full_disk):
    file = tmp_path / "rig.yaml"
    file.write_bytes(b"before")
    full_disk()
    with pytest.raises(OSError, match="No space"):
        write_whole(file, b"after")
    assert file.read_bytes() == b"before"
    assert names(tmp_path) == ["rig.yaml"]


def test_a_rig_that_cannot_be_kept_leaves_no_empty_version(tmp_path, full_disk):
    rig = tmp_path / "mine.yaml"
    rig.write_text("before")
    full_disk()
    with pytest.raises(GatewayError, match="the earlier rig cannot be kept: No space"):
        keep(rig, NOW)
    assert history(rig) == []
    assert names(tmp_path) == ["mine.yaml"]


def test_a_rig_that_cannot_be_written_stays_what_it_was(tmp_path, full_disk):
    rig = tmp_path / "mine.yaml"
    rig.write_text("older")
    keep(rig, NOW)
    rig.write_text("newer")
    full_disk()
    with pytest.raises(GatewayError, match="No space"):
        restore(rig)
    source = shipped_folder() / "rigs" / "single.yaml"
    with pytest.raises(GatewayError, match="cannot be written: No space"):
        write_calibrated_rig(source, rig, {})
    assert rig.read_text() == "newer"


@pytest.mark.parametrize(
    "write",
    [
        lambda path: save_clock_table(clock_table([{1: [1.0, 2.0], 2: [1.1, 2.1]}]), path),
        lambda path: write_subject(path, {"name": "anna"}),
        lambda path: _write_cameras(path, "cameras: []"),
        lambda path: body._write(path, "# anna\n", {"name": "anna"}, force=True),
    ],
    ids=["clocks", "subject", "cameras", "body"],
)
def test_what_was_measured_before_stays_where_the_new_cannot_be_written(tmp_path, full_disk, write):
    """A power cut in the middle finds the same: the old file, whole."""
    file = tmp_path / "measured.yaml"
    file.write_bytes(b"before")
    full_disk()
    with pytest.raises((GatewayError, OSError), match="No space"):
        write(file)
    assert file.read_bytes() == b"before"
    assert names(tmp_path) == ["measured.yaml"]


def test_a_recording_that_cannot_begin_leaves_no_file(tmp_path, full_disk):
    full_disk()
    session = session_record({"suit": Framing.BYTE_STREAM})
    with pytest.raises(OSError, match="No space"):
        RecordingWriter(tmp_path / "walk.mcap", session, {"rig.yaml": b"body: single"}, 1)
    assert names(tmp_path) == []


def test_an_error_names_the_file_that_was_wanted(tmp_path):
    """And not the one that is made beside it, which is gone by then."""
    wanted, source = tmp_path / "wanted", tmp_path / "source"
    full = OSError(errno.ENOSPC, "no room")
    with pytest.raises(OSError, match=f"No space left on device: '{wanted}'$"), replacing(wanted):
        raise full
    with pytest.raises(OSError, match=f"No space left on device: '{wanted}'$"), replacing(wanted) as made:
        raise OSError(errno.ENOSPC, "no room", str(source), None, str(made))
    with pytest.raises(FileNotFoundError, match=f"'{source}'"), replacing(wanted):
        source.read_bytes()
    with pytest.raises(FileNotFoundError, match=f"'{tmp_path / 'absent' / 'file'}'$"):
        write_whole(tmp_path / "absent" / "file", b"")
    assert not list(tmp_path.iterdir())


def test_a_secret_is_its_owners_alone_from_the_beginning(tmp_path):
    path = tmp_path / "secret"
    for content in (b"one", b"two"):
        write_whole(path, content, 0o600)
        assert (path.read_bytes(), stat.S_IMODE(path.stat().st_mode)) == (content, 0o600)
        path.chmod(0o644)


def test_a_file_that_holds_its_name_is_written_whole_or_not_at_all(tmp_path):
    wanted = tmp_path / "walk.trc"
    with replacing_by_name(wanted) as made:
        made.write_text(made.name)
        assert not wanted.exists()
    assert wanted.read_text() == "walk.trc"

    def write_a_part():
        with replacing_by_name(wanted) as made:
            made.write_text("a part")
            raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(OSError, match="No space"):
        write_a_part()
    assert wanted.read_text() == "walk.trc"
    assert names(tmp_path) == ["walk.trc"]


def test_what_is_no_file_is_not_replaced(tmp_path):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    with pytest.raises(OSError, match="it is no file"), replacing_by_name(pipe):
        pass
    with pytest.raises(OSError, match="it is no file"):
        write_whole(pipe, b"content")
    assert pipe.is_fifo()
