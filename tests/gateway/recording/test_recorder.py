"""The recorder loses nothing, holds nobody up for long, and ends in words when the disk is full."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import logging
import os
import subprocess
import threading
import time
import tracemalloc

import pytest
from mcap.reader import make_reader

from devices.link import Chunk, Framing
from devices.recording_file import RecordingError, RecordingFile
from devices.recording_writer import RecordingWriter, session_record
from gateway.body.rig import load_rig
from gateway.recording import control as control_module
from gateway.recording import open_recording, recorder
from gateway.recording.control import RecordingControl
from gateway.recording.files import Contents, SessionFiles
from gateway.recording.recorder import Recorder, RecordingSink
from gateway.settings import GatewaySettings, RecordingSettings
from gateway.sources.link_settings import LinkSettings
from tests.patience import PATIENCE_S

MB = 10**6
CONTENTS = Contents({"suit": Framing.BYTE_STREAM}, {}, "1", True)


def chunk(index: int, size: int = 100) -> Chunk:
    return Chunk(index.to_bytes(4, "little") + os.urandom(size), 10**18 + index, "suit")


def recorder_on(files: SessionFiles, flush_s: float = 0.01, **options) -> Recorder:
    return Recorder(RecordingSink(files.write, files.flush, files.close, files.abandon), flush_s, **options)


def settings_in(folder, **changes) -> RecordingSettings:
    return RecordingSettings(
        **{"folder": str(folder), "min_free_mb": 0, "warn_free_mb": 0, "fsync_s": 0} | changes
    )


def indices(path) -> list[int]:
    return [int.from_bytes(c.data[:4], "little") for c in open_recording(path).chunks()]


def await_that(condition):
    """What a thread of its own brings about."""
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.002)


def test_what_is_flushed_can_be_read_while_recording_goes_on(tmp_path):
    files = SessionFiles(settings_in(tmp_path), CONTENTS)
    kept = recorder_on(files)
    kept.chunk(chunk(0), Framing.BYTE_STREAM)
    await_that(lambda: kept.counts.written["chunks"] == 1)
    assert indices(files.path) == [0]
    assert RecordingFile(files.path).head.session["software"] == "1"
    kept.chunk(chunk(1), Framing.BYTE_STREAM)
    kept.end("stopped")
    assert kept.join(PATIENCE_S)
    assert indices(files.path) == [0, 1]
    assert kept.counts.written["chunks"] == kept.counts.queued["chunks"] == 2


def test_sessions_rotate_by_size_into_files_that_are_whole_and_read_as_one(tmp_path):
    files = SessionFiles(settings_in(tmp_path, rotate_mb=0.05), CONTENTS, "long")
    for index in range(300):
        files.write("/chunks/suit", 10**18 + index, chunk(index, 1000).data, {"link": "suit"})
        if index % 10 == 9:
            assert files.flush() is None
    files.close()
    paths = sorted(tmp_path.iterdir())
    assert len(paths) == files.part >= 5
    first = min(paths, key=lambda path: len(path.name))
    assert first.name.endswith("Z_long.mcap")
    recording = open_recording(first)
    assert recording.meta.n_parts == len(paths)
    assert indices(first) == list(range(300))
    assert recording.defect is None
    assert files.size == sum(path.stat().st_size for path in paths)
    later = open_recording(first.with_name(f"{first.stem}_part3.mcap"))
    assert later.meta.n_parts == len(paths) - 2
    assert not later.meta.from_start
    assert [event.name for event in recording.events()] == ["rotated"] * (len(paths) - 1)


def test_sessions_rotate_by_time(tmp_path):
    now = 0.0
    files = SessionFiles(settings_in(tmp_path, rotate_minutes=2), CONTENTS, monotonic=lambda: now)
    for now in (0.0, 60.0, 119.0, 121.0, 200.0, 242.0):  # noqa: B007 - read by the clock
        files.flush()
    files.close()
    assert files.part == 3


def test_parts_of_another_session_are_left_alone(tmp_path):
    files = SessionFiles(settings_in(tmp_path), CONTENTS)
    files.close()
    other = SessionFiles(settings_in(tmp_path), CONTENTS)
    other.close()
    assert other.path != files.path  # also within one second
    other.path.rename(files.path.with_name(f"{files.path.stem}_part2.mcap"))
    assert open_recording(files.path).meta.n_parts == 1


def test_low_disk_warns_and_then_ends_the_recording_cleanly(tmp_path, caplog):
    free, looks = [10_000 * MB], []
    files = SessionFiles(
        settings_in(tmp_path, warn_free_mb=2000, min_free_mb=500),
        CONTENTS,
        free=lambda _: looks.append(free[0]) or free[0],
    )
    ended = []
    kept = recorder_on(files, on_end=ended.append)
    kept.chunk(chunk(0), Framing.BYTE_STREAM)
    await_that(lambda: len(looks) > 3)
    assert files.warning is None
    free[0] = 1500 * MB
    await_that(lambda: looks.count(1500 * MB) > 3)
    assert "1500 MB free" in files.warning
    assert caplog.text.count("recording stops at 500 MB") == 1
    kept.chunk(chunk(1), Framing.BYTE_STREAM)
    await_that(lambda: kept.counts.written["chunks"] == 2)
    free[0] = 499 * MB
    assert kept.join(PATIENCE_S)
    assert "499 MB free, less than min_free_mb 500" in kept.ended
    assert ended == [kept.ended]
    kept.chunk(chunk(2), Framing.BYTE_STREAM)
    assert kept.counts.lost == {"chunks": 1}
    recording = open_recording(files.path)
    assert indices(files.path) == [0, 1]
    assert recording.defect is None
    assert "499 MB" in list(recording.events())[-1].data["reason"]


def test_no_room_at_the_start_is_said_before_anything_is_written(tmp_path):
    with pytest.raises(RecordingError, match=r"has 3 MB free, less than recording\.min_free_mb"):
        SessionFiles(settings_in(tmp_path, min_free_mb=4), CONTENTS, free=lambda _: 3 * MB)
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "file").touch()
    with pytest.raises(RecordingError, match=r"recordings cannot go to .*file.*set recording.folder"):
        SessionFiles(settings_in(tmp_path / "file"), CONTENTS)


@contextlib.contextmanager
def small_disk(folder, size):
    """A file system of its own. Skips where it may not be mounted."""
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        pytest.skip(f"a small file system cannot be mounted here: {done.stderr.strip()}")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)


def test_a_disk_full_to_the_brim_ends_the_recording_and_what_was_flushed_is_there(tmp_path):
    with small_disk(tmp_path / "disk", "1m") as disk:
        files = SessionFiles(settings_in(disk), CONTENTS)
        kept = recorder_on(files)
        fed = 0
        while kept.ended is None and fed < 10_000:
            kept.chunk(chunk(fed, 2000), Framing.BYTE_STREAM)
            fed += 1
            time.sleep(0.0005)
        assert kept.join(PATIENCE_S)
        assert "cannot be written any more (No space left on device)" in kept.ended
        written = kept.counts.written["chunks"]
        assert 100 < written < fed
        assert indices(files.path) == list(range(written))
        assert kept.counts.lost["chunks"] == fed - written


def test_an_error_of_the_disk_leaves_the_last_good_flush(tmp_path, monkeypatch):
    files = SessionFiles(settings_in(tmp_path), CONTENTS)
    files.write("/chunks/suit", 1, chunk(0).data, {})
    files.flush()
    real, torn = os.write, []

    def fails(descriptor, data):
        if torn:
            raise OSError(errno.EIO, "Input/output error")
        torn.append(True)
        return real(descriptor, bytes(data)[: len(data) // 2])

    files.write("/chunks/suit", 2, chunk(1).data, {})
    monkeypatch.setattr(os, "write", fails)
    with pytest.raises(OSError, match="Input/output"):
        files.flush()
    monkeypatch.undo()
    files.abandon()
    size = files.path.stat().st_size
    assert indices(files.path) == [0]
    assert size == files.size


async def test_a_slow_disk_holds_the_stream_up_and_nothing_is_lost(tmp_path, monkeypatch):
    monkeypatch.setattr(recorder, "LONGEST_QUEUE_BYTES", 10_000)
    files = SessionFiles(settings_in(tmp_path), CONTENTS)
    gate = threading.Event()

    def flush():
        gate.wait(PATIENCE_S)
        return files.flush()

    kept = Recorder(RecordingSink(files.write, flush, files.close, files.abandon), 0.01)
    for index in range(500):
        if kept.is_behind:
            if not gate.is_set():
                asyncio.get_running_loop().call_later(0.2, gate.set)
            await kept.catch_up()
        kept.chunk(chunk(index), Framing.BYTE_STREAM)
    kept.end("stopped")
    assert kept.join(PATIENCE_S)
    assert indices(files.path) == list(range(500))
    assert kept.counts.stalls >= 1
    assert kept.counts.stalled_s > 0.1
    assert not kept.counts.lost


async def test_a_disk_that_hangs_ends_the_recording_and_lets_the_stream_go_on(tmp_path, monkeypatch):
    monkeypatch.setattr(recorder, "LONGEST_QUEUE_BYTES", 1000)
    monkeypatch.setattr(recorder, "LONGEST_STALL_S", 0.1)
    files = SessionFiles(settings_in(tmp_path), CONTENTS)
    gate = threading.Event()

    def flush():
        gate.wait(PATIENCE_S)
        return files.flush()

    kept = Recorder(RecordingSink(files.write, flush, files.close, files.abandon), 0.01)
    for index in range(50):
        kept.chunk(chunk(index), Framing.BYTE_STREAM)
    begun = time.monotonic()
    await kept.catch_up()
    assert 0.1 <= time.monotonic() - begun < PATIENCE_S / 2  # the disk hangs for longer
    assert not kept.is_behind  # nobody waits a second time
    kept.chunk(chunk(99), Framing.BYTE_STREAM)
    assert kept.counts.lost == {"chunks": 1}
    gate.set()
    assert kept.join(PATIENCE_S)
    assert "the disk took nothing for 0.1 s" in kept.ended
    assert indices(files.path) == list(range(50))


def test_a_failure_inside_is_said_and_ends_it(caplog):
    def breaks(*_):
        raise RuntimeError("inside")

    with caplog.at_level(logging.ERROR):
        kept = Recorder(RecordingSink(breaks, lambda: None, lambda: None, lambda: None), 0.01)
        kept.chunk(chunk(0), Framing.BYTE_STREAM)
        assert kept.join(PATIENCE_S)
    assert "this should not have happened" in kept.ended
    assert kept.counts.lost["chunks"] == 1


def test_the_index_of_a_long_recording_takes_little_memory(tmp_path):
    """The library's own took 17 MB for an hour of flushes five times a second."""
    flushes = 400
    session = session_record({"suit": Framing.BYTE_STREAM}, session="s", software="1", begun_ns="0")
    with RecordingWriter(tmp_path / "long.mcap", session, {}, 0) as writer:
        writer.add_chunk(chunk(0), Framing.BYTE_STREAM)
        writer.flush()
        tracemalloc.start()
        for index in range(1, flushes):
            writer.add_chunk(chunk(index), Framing.BYTE_STREAM)
            writer.flush()
        kept = tracemalloc.get_traced_memory()[0]
        tracemalloc.stop()
    assert kept < 250 * flushes
    with (tmp_path / "long.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert len(summary.chunk_indexes) == flushes
    assert [index.message_start_time for index in summary.chunk_indexes] == [
        10**18 + i for i in range(flushes)
    ]
    assert indices(tmp_path / "long.mcap") == list(range(flushes))


async def test_what_comes_after_an_orderly_end_is_not_lost(tmp_path):
    """It used to be counted as lost for as long as the gateway went on."""
    settings = GatewaySettings(
        links=[LinkSettings(name="suit", url="/dev/null")], rig="arm_3", recording=settings_in(tmp_path)
    )
    links = {"suit": Framing.BYTE_STREAM}
    control = RecordingControl(settings, load_rig("arm_3"), links, dict, dict)
    control.start()
    control.chunk(chunk(0), Framing.BYTE_STREAM)
    await asyncio.sleep(0.2)
    await control.stop()
    assert control.status()["seconds"] >= 0.2, "also when nobody asked while it lasted"
    control.chunk(chunk(1), Framing.BYTE_STREAM)
    control.event("link", {})
    assert control.balance == (1, 1, 0, 0)
    assert control.status()["lost"] == {}


async def test_it_records_for_as_long_as_nobody_takes_poses(tmp_path, monkeypatch):
    monkeypatch.setattr(control_module, "WATCH_INTERVAL_S", 0.02)
    monkeypatch.setattr(control_module, "_CUT_OFF_S", 0.1)
    settings = GatewaySettings(
        links=[LinkSettings(name="suit", url="/dev/null")], rig="arm_3", recording=settings_in(tmp_path)
    )
    control = RecordingControl(settings, load_rig("arm_3"), {"suit": Framing.BYTE_STREAM}, dict, dict)
    is_cut_off = False
    watching = asyncio.create_task(control.record_while(lambda: is_cut_off))
    await asyncio.sleep(0.2)
    assert not control.is_recording
    is_cut_off = True
    async with asyncio.timeout(30):
        while not control.is_recording:
            await asyncio.sleep(0.01)
        is_cut_off = False
        while control.is_recording:
            await asyncio.sleep(0.01)
    (file,) = tmp_path.glob("*.mcap")
    assert "cut_off" in file.name
    control.start("mine")
    await asyncio.sleep(0.2)
    assert control.is_recording, "what was begun by somebody goes on"
    watching.cancel()
    await control.stop()
