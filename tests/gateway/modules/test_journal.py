"""What stood in the modules before a change outlives programs, other processes, full and damaged disks."""

from __future__ import annotations

import errno
import fcntl
import multiprocessing
import os

import pytest

from devices.commands.configure import Change
from gateway.modules import journal as journal_module
from gateway.modules.journal import Journal, JournalError

A, B = b"a" * 12, b"b" * 12
FIRST = Change(A, {"label": "", "calibration": (1.0, 0.1)}, {"label": "x", "calibration": (0.0, 0.0)})
SECOND = Change(B, {"module_id": 3}, {"module_id": 5})


@pytest.fixture
def path(tmp_path):
    return tmp_path / "deep" / "module_changes.json"


def changes_of(path):
    entry = Journal(path).last()
    return () if entry is None else entry.changes


def test_entries_outlive_the_program_and_are_taken_back_last_first(path):
    Journal(path).record([FIRST])
    second = Journal(path).record([SECOND])
    assert changes_of(path) == (SECOND,)
    Journal(path).settle(second, [])
    (kept,) = changes_of(path)
    assert kept.before == {"label": "", "calibration": [1.0, 0.1]}
    first = Journal(path).last()
    Journal(path).settle(first, [])
    assert Journal(path).last() is None


def test_an_entry_is_trimmed_to_what_the_modules_hold(path):
    journal = Journal(path)
    entry = journal.record([FIRST, SECOND, Change(B, {"label": "b"}, {"label": ""})])
    assert len(entry.changes) == 2  # one for each module
    journal.settle(entry, [SECOND])
    assert changes_of(path) == (SECOND,)


def test_another_process_adds_to_the_same_file_and_nothing_is_lost(path):
    mine, other = Journal(path), Journal(path)
    entry = mine.record([FIRST])
    other.record([SECOND])
    mine.settle(entry, [])
    assert mine.last().changes == (SECOND,)


def _record_many(path, module, times):
    journal = Journal(path)
    for label in range(times):
        journal.record([Change(module, {"label": str(label)}, {"label": ""})])


def test_processes_that_write_at_once_lose_nothing(path):
    spawning = multiprocessing.get_context("spawn")
    others = [spawning.Process(target=_record_many, args=(path, uid, 20)) for uid in (A, B)]
    for process in others:
        process.start()
    for process in others:
        process.join()
    assert [process.exitcode for process in others] == [0, 0]
    found = []
    while (entry := Journal(path).last()) is not None:
        found.append((entry.changes[0].unique_id, entry.changes[0].before["label"]))
        Journal(path).settle(entry, [])
    assert sorted(found) == sorted((uid, str(label)) for uid in (A, B) for label in range(20))


def test_a_lock_that_is_never_given_free_is_an_error_and_changes_nothing(path, monkeypatch):
    monkeypatch.setattr(journal_module, "_LOCK_PATIENCE_S", 0.05)
    Journal(path).record([FIRST])
    with path.with_suffix(".lock").open() as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        with pytest.raises(JournalError, match="held by another process"):
            Journal(path).record([SECOND])
    assert len(changes_of(path)) == 1


@pytest.mark.parametrize("step", ["fsync", "replace"])
def test_a_full_disk_is_an_error_and_the_entries_before_stand(path, monkeypatch, step):
    Journal(path).record([FIRST])

    def full(*_arguments):
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, step, full) if step == "fsync" else patch.setattr("pathlib.Path.replace", full)
        with pytest.raises(JournalError, match=r"No space left on device.*nothing was changed.*make room"):
            Journal(path).record([SECOND])
    (kept,) = changes_of(path)
    assert kept.unique_id == A
    assert sorted(file.name for file in path.parent.iterdir()) == [
        "module_changes.json",
        "module_changes.lock",
    ]


def test_a_folder_that_cannot_be_made_is_an_error(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(JournalError, match="XDG_STATE_HOME"):
        Journal(tmp_path / "file" / "journal.json").record([SECOND])


def test_what_is_recorded_is_on_the_disk_file_and_name(path, monkeypatch):
    """The file's content before its name changes, its folder after that."""
    order = []
    fsync, replace = os.fsync, os.replace

    def synced(descriptor):
        order.append("folder" if os.path.isdir(f"/proc/self/fd/{descriptor}") else "file")
        fsync(descriptor)

    def replaced(source, target, **rest):
        order.append("name")
        replace(source, target, **rest)

    monkeypatch.setattr(os, "fsync", synced)
    monkeypatch.setattr(os, "replace", replaced)
    Journal(path).record([FIRST])
    assert order == ["file", "name", "folder"]


@pytest.mark.parametrize(
    "content", [b"{not json", b"[{}]", b"\xff\xfe", b'[{"key": "k", "modules": {"zz": {"before": {}}}}]']
)
def test_a_damaged_file_is_kept_aside_and_said(path, caplog, content):
    path.parent.mkdir()
    path.write_bytes(content)
    assert Journal(path).last() is None
    assert "cannot be undone; it is kept as" in caplog.text
    Journal(path).record([SECOND])
    assert path.with_suffix(".damaged-1").read_bytes() == content
    path.write_bytes(b"again")
    Journal(path).record([SECOND])
    assert path.with_suffix(".damaged-1").read_bytes() == content
    assert path.with_suffix(".damaged-2").read_bytes() == b"again"


def test_no_more_than_so_many_are_kept(path, monkeypatch):
    monkeypatch.setattr(journal_module, "_LONGEST", 3)
    _record_many(path, A, 5)
    assert len(journal_module._RECORDS.validate_json(path.read_bytes())) == 3
    assert changes_of(path)[0].before == {"label": "4"}
