"""Suite ``batch``: many recordings solved anew, on one worker and on two, of Dask and of this machine."""

from __future__ import annotations

import hashlib
import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from distributed import LocalCluster

from benchmarks.figures import Figure, Report, table
from devices.emulators import SuitSettings, SuitTraffic
from devices.emulators.imperfections import TYPICAL
from devices.link import Chunk, Framing
from devices.recording_writer import RecordingWriter, session_record
from gateway.batch.job import Job, JobResult, Task
from gateway.batch.running import jobs_in, run_jobs
from gateway.body.rig import load_rig
from gateway.emulation.rig import dress, move
from gateway.recording import open_recording
from gateway.recording.snapshot import attachments_of
from gateway.recording.solving import solve
from gateway.settings import GatewaySettings
from gateway.sources.link_settings import LinkSettings

RIG = "suit_17"
SECONDS = 10.0
SESSIONS = 8
LINK = "suit"
TASK = Task(("csv", "mcap"))
Runner = Callable[[list[Job], Callable[[Job, JobResult], None]], None]


def run() -> Report:
    """Sessions of seventeen modules, raw bytes alone: solve each and write it as CSV."""
    report = Report("batch")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        _record_sessions(folder / "sessions")
        report.figures += _offline_speed(folder / "sessions/s00.mcap")
        rows, digests = [], []
        for what, workers, runner in _runners():
            load = os.getloadavg()[0]
            seconds, digest = _timed(folder, what, runner)
            digests.append(digest)
            rows.append(
                [what, str(workers), f"{seconds:.1f}", f"{SESSIONS * SECONDS / seconds:.1f}", f"{load:.1f}"]
            )
            report.figures.append(
                Figure(f"batch_{what}_{workers}", seconds, "s", note=f"{SESSIONS} sessions")
            )
        report.figures.append(
            Figure("batch_dask_speed_up", _ratio(rows, "dask"), "×", ">=1.6", "2 workers against 1")
        )
        report.figures.append(
            Figure(
                "batch_differing",
                float(len(set(digests)) - 1),
                "results",
                "<=0",
                "bytes of all files, all runs",
            )
        )
    heads = ["on", "workers", "seconds", "× real time", "load of the machine before"]
    report.tables.append(f"## {SESSIONS} sessions of {SECONDS:g} s\n\n" + table(heads, rows))
    return report


def _record_sessions(folder: Path) -> None:
    """Sessions that differ, as a link would have given them."""
    folder.mkdir()
    suit = load_rig(RIG)
    settings = GatewaySettings(links=[LinkSettings(name=LINK, url="/dev/null")], rig=RIG)
    for seed in range(SESSIONS):
        traffic = SuitTraffic(
            move(dress(suit), suit.skeleton.name, seed=seed), SuitSettings(), TYPICAL, seed=seed
        )
        session = session_record(
            {LINK: Framing.BYTE_STREAM}, session=f"s{seed:02d}", begun_ns="0", from_start="1"
        )
        path = folder / f"s{seed:02d}.mcap"
        with RecordingWriter(path, session, attachments_of(settings, suit), 0) as writer:
            for sent in traffic.transmissions(SECONDS):
                chunk = Chunk(sent.data, 10**9 + round(sent.time_s * 1e9), LINK)
                writer.add_chunk(chunk, Framing.BYTE_STREAM)


def _offline_speed(path: Path) -> list[Figure]:
    """One core, processor time, minimum of three; the kernels are compiled by the first."""
    spent = []
    for _ in range(3):
        recording = open_recording(path)
        begun = time.process_time()
        frames = sum(1 for _ in solve(recording))
        spent.append(time.process_time() - begun)
    return [
        Figure(
            "batch_offline_x_realtime",
            SECONDS / min(spent),
            "×",
            ">=1",
            f"17 modules, {frames} poses",
        ),
    ]


def _runners() -> list[tuple[str, int, Runner]]:
    return [
        ("dask", 1, _dask(1)),
        ("dask", 2, _dask(2)),
        ("processes", 1, _local(1)),
        ("processes", 2, _local(2)),
    ]


def _dask(workers: int) -> Runner:
    def perform(jobs: list[Job], done: Callable[[Job, JobResult], None]) -> None:
        with LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address=None) as cluster:
            run_jobs(jobs, done, dask=cluster.scheduler_address)

    return perform


def _local(workers: int) -> Runner:
    return lambda jobs, done: run_jobs(jobs, done, workers=workers)


def _timed(folder: Path, what: str, runner: Runner) -> tuple[float, str]:
    """Wall clock from the first to the last result, and the digest of all results."""
    results = folder / f"{what}-{time.monotonic_ns()}"
    outcomes: list[JobResult] = []
    begun = time.perf_counter()
    runner(jobs_in(folder / "sessions", results, TASK), lambda _job, outcome: outcomes.append(outcome))
    seconds = time.perf_counter() - begun
    failed = [outcome.error for outcome in outcomes if outcome.error]
    if failed:
        raise SystemExit(f"a session failed: {failed[0]}")
    digest = hashlib.sha256()
    for path in sorted(results.rglob("*.*")):
        digest.update(path.name.encode() + path.read_bytes())
    return seconds, digest.hexdigest()


def _ratio(rows: list[list[str]], what: str) -> float:
    one, two = (float(row[2]) for row in rows if row[0] == what)
    return one / two
