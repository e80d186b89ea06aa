"""Many recordings at once: the same results as one by one, whatever fails, stops or is repeated."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time

import psutil
import pytest

from gateway.batch.job import Job, JobResult, Task, perform
from gateway.batch.manifest import Manifest
from gateway.batch.running import _interrupts_for_this_process, jobs_in, run_jobs
from gateway.errors import GatewayError
from gateway.recording import open_recording
from tests.patience import PATIENCE_S


@pytest.fixture
def sessions(record, tmp_path):
    """A folder with three recordings, one below it, one of them cut off, and one file that is none."""
    folder = tmp_path / "sessions"
    (folder / "monday").mkdir(parents=True)
    path = record()
    for name in ("a.mcap", "monday/b.mcap"):
        shutil.copy(path, folder / name)
    (folder / "cut.mcap").write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])
    (folder / "bad.mcap").write_text("nothing of the kind")
    return folder


@pytest.fixture
def here(monkeypatch):
    """Jobs in this process: what is tested is not the pool."""

    def run(jobs, done, _workers=None, _dask=None):
        for job in jobs:
            done(job, perform(job))

    monkeypatch.setattr("gateway.batch.running.run_jobs", run)


def test_results_are_those_of_the_single_commands(sessions, typed, tmp_path, here):
    """By the byte, also for poses solved anew."""
    out = tmp_path / "out"
    kinds = ("--to", "csv", "--to", "report", "--to", "mcap")
    code, told = typed("batch", sessions, *kinds, "-o", out, "--json")
    assert (code, told["done"], list(told["failed"])) == (3, 3, ["bad.mcap"])
    assert "is no recording" in told["failed"]["bad.mcap"]
    assert "was not closed" in told["notes"]["cut.mcap"]
    single = tmp_path / "single"
    single.mkdir()
    for name in ("a", "monday/b"):
        stem = name.rpartition("/")[2]
        solved = single / f"{stem}.mcap"
        typed("replay", sessions / f"{name}.mcap", "--output", solved)
        typed("export", solved, "--to", "csv")
        typed("report", solved)
        for suffix in (".mcap", ".csv", ".html"):
            assert (out / f"{name}{suffix}").read_bytes() == (single / f"{stem}{suffix}").read_bytes(), suffix
    assert not list(out.rglob(".partial*"))


def test_it_goes_on_where_it_was(sessions, typed, tmp_path, here):
    out = tmp_path / "out"
    (sessions / "bad.mcap").unlink()
    arguments = ("batch", sessions, "--to", "csv", "-o", out, "--json")
    assert (typed(*arguments)[1]["done"], typed(*arguments)[1]["skipped"]) == (3, 3)
    (out / "a.csv").unlink()
    os.utime(sessions / "monday/b.mcap")  # a copy: newer, same content
    with (sessions / "cut.mcap").open("r+b") as file:
        file.truncate((sessions / "cut.mcap").stat().st_size - 100)
    told = typed(*arguments)[1]
    assert (told["done"], told["skipped"]) == (2, 1)
    assert (out / "a.csv").exists()
    assert typed(*arguments, "--unit", "mm")[1]["done"] == 3, "other wishes, other results"
    assert typed(*arguments, "--unit", "mm", "--again")[1]["done"] == 3


def test_a_manifest_cut_off_in_a_line_loses_that_line_only(sessions, typed, tmp_path, here):
    out = tmp_path / "out"
    arguments = ("batch", sessions, "--to", "sto", "-o", out, "--json")
    typed(*arguments)
    lines = (out / "manifest.jsonl").read_text().splitlines(keepends=True)
    good = [line for line in lines if json.loads(line)["error"] is None]
    (out / "manifest.jsonl").write_text("".join(good)[:-40])
    told = typed(*arguments)[1]
    assert (told["done"], told["skipped"]) == (1, 2)
    assert typed(*arguments)[1]["skipped"] == 3


def test_other_rigs_and_methods(sessions, typed, tmp_path, here):
    told = typed("batch", sessions / "monday", "--to", "csv", "--to", "mcap", "--with", "robot_arm_4",
                 "--reconstructor", "articulated", "-o", tmp_path / "out", "--json")[1]  # fmt: skip
    assert told["done"] == 1
    info = typed("info", tmp_path / "out/b.mcap")[1]
    assert "articulated" in info


def test_a_delay_is_told_to_every_recording(sessions, typed, tmp_path, here):
    method = ("--reconstructor", "gyro_free", "--delay-ms", 200)
    told = typed("batch", sessions / "monday", "--to", "mcap", *method, "-o", tmp_path / "out", "--json")[1]
    assert told["done"] == 1
    assert open_recording(tmp_path / "out/b.mcap").meta.settings.reconstructor_delay_ms == 200


def test_later_parts_results_and_what_was_not_finished_are_no_recordings_of_their_own(tmp_path):
    unfinished = "earlier/.partial-7-a/a.mcap"
    for name in ("a.mcap", "a_part2.mcap", "b_part2.mcap", "out/a.mcap", unfinished):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    jobs = jobs_in(tmp_path, tmp_path / "out", Task(("csv",)))
    assert [job.name for job in jobs] == ["a.mcap", "b_part2.mcap"]
    with pytest.raises(GatewayError, match="has no recording"):
        jobs_in(tmp_path / "out", tmp_path, Task(("csv",)))
    with pytest.raises(GatewayError, match="is no folder"):
        jobs_in(tmp_path / "absent", tmp_path, Task(("csv",)))


@pytest.mark.parametrize("moment", ["processes start", "recordings are worked on"])
def test_ctrl_c_ends_it_with_one_line_and_nothing_half_made(record, tmp_path, moment):
    """As a terminal sends it: to all processes at once."""
    folder, out = tmp_path / "sessions", tmp_path / "out"
    folder.mkdir()
    path = record()
    for k in range(40):
        shutil.copy(path, folder / f"{k:02}.mcap")
    typed = ["-m", "gateway", "batch", str(folder), "--to", "csv", "--to", "mcap", "-o", str(out)]
    batch = subprocess.Popen(
        [sys.executable, *typed, "--workers", "2"], stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    has_begun = {
        "processes start": lambda: len(psutil.Process(batch.pid).children()) > 2,
        "recordings are worked on": lambda: any(out.rglob(".partial*/*")),
    }[moment]
    deadline = time.monotonic() + PATIENCE_S
    while not has_begun() and time.monotonic() < deadline:
        time.sleep(0.005)
    os.killpg(batch.pid, signal.SIGINT)
    _, errors = batch.communicate(timeout=PATIENCE_S)
    assert "Traceback" not in errors
    assert "interrupted: " in errors
    assert batch.returncode == 130
    assert not list(out.rglob(".partial*"))
    manifest = [json.loads(line) for line in (out / "manifest.jsonl").read_text().splitlines()]
    assert len(manifest) < 40
    assert all(entry["error"] is None for entry in manifest)


def test_a_batch_that_is_killed_leaves_no_process_and_the_next_one_clears_up(record, tmp_path):
    """Killed alone, as by a machine that runs out of memory."""
    folder, out = tmp_path / "sessions", tmp_path / "out"
    folder.mkdir()
    path = record()
    for k in range(8):
        shutil.copy(path, folder / f"{k:02}.mcap")
    typed = ["-m", "gateway", "batch", str(folder), "--to", "mcap", "-o", str(out), "--workers", "2"]
    batch = subprocess.Popen([sys.executable, *typed], stderr=subprocess.DEVNULL, start_new_session=True)
    deadline = time.monotonic() + PATIENCE_S
    while not any(out.rglob(".partial*/*")) and time.monotonic() < deadline:
        time.sleep(0.005)
    processes = psutil.Process(batch.pid).children()
    batch.kill()
    batch.wait()
    _, left = psutil.wait_procs(processes, PATIENCE_S)
    for process in left:
        process.kill()
    assert not left

    (out / f".partial-{batch.pid}-00").mkdir()  # whatever the others were at just then
    jobs, outcomes = jobs_in(folder, out, Task(("mcap",))), list[JobResult]()
    run_jobs(jobs, lambda _job, outcome: outcomes.append(outcome), workers=1)
    assert [outcome.error for outcome in outcomes] == [None] * 8
    assert not list(out.rglob(".partial*"))


class _Deadly(Job):
    """A job that ends the process that unpacks it, as the kernel does when memory runs out."""

    def __reduce__(self):
        return os._exit, (9,)


def test_a_worker_that_dies_costs_its_own_recording_only(sessions, tmp_path):
    task = Task(("sto",))
    jobs = jobs_in(sessions / "monday", tmp_path / "out", task)
    deadly = _Deadly("deadly.mcap", sessions / "deadly.mcap", tmp_path / "out", task)
    outcomes: dict[str, JobResult] = {}
    run_jobs([deadly, *jobs], lambda job, outcome: outcomes.update({job.name: outcome}), workers=1)
    assert outcomes["deadly.mcap"].error == "the process that worked on it died (out of memory?)"
    assert sorted(name for name, outcome in outcomes.items() if not outcome.error) == ["b.mcap"]


def test_no_cluster_is_one_clear_line(monkeypatch):
    monkeypatch.setattr("gateway.batch.running._CONNECT_S", 0.5)
    job = Job("a", None, None, Task(("csv",)))
    with pytest.raises(GatewayError, match=r"no Dask scheduler with a worker at tcp://127\.0\.0\.1:9"):
        run_jobs([job], lambda *_: None, dask="tcp://127.0.0.1:9")


def test_a_dask_cluster_gives_the_same_bytes(sessions, typed, tmp_path):
    from distributed import LocalCluster  # noqa: PLC0415 - an extra

    kinds = ("--to", "csv", "--to", "mcap")
    with LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=None) as cluster:
        address = cluster.scheduler_address
        code, told = typed("batch", sessions, *kinds, "-o", tmp_path / "dask", "--dask", address, "--json")
    assert (code, told["done"]) == (3, 3)
    for job in jobs_in(sessions, tmp_path / "local", Task(("csv", "mcap"))):
        perform(job)
    files = sorted(path.relative_to(tmp_path / "local") for path in (tmp_path / "local").rglob("*.[cm]*[vp]"))
    assert len(files) == 6
    for name in files:
        assert (tmp_path / "dask" / name).read_bytes() == (tmp_path / "local" / name).read_bytes()


def test_a_failed_outcome_is_tried_again(sessions, tmp_path):
    job = jobs_in(sessions, tmp_path / "out", Task(("csv",)))[0]
    manifest = Manifest(tmp_path / "out")
    manifest.add(job, JobResult(job.name, error="disk full"))
    assert not manifest.is_done(job)
    manifest.close()


def test_an_interrupt_waits_until_all_processes_have_started():
    """It came in the middle of a start, by a thread that does not block it: that of the progress bar."""
    started, is_over = [], threading.Event()
    other = threading.Thread(target=is_over.wait)

    def start() -> None:
        with _interrupts_for_this_process():
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(0.1)
            started.append(True)

    before = signal.getsignal(signal.SIGINT)
    other.start()
    try:
        with pytest.raises(KeyboardInterrupt):
            start()
    finally:
        is_over.set()
        other.join()
    assert started
    assert signal.getsignal(signal.SIGINT) is before
