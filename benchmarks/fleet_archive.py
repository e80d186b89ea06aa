"""The archive of a fleet: rows in and out, recordings solved again on Dask, one wearer forgotten."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import orjson
import psutil

from benchmarks import batch
from benchmarks.figures import Figure, Report, table
from gateway.fleet import solving
from gateway.fleet.archive import Archive
from gateway.fleet.collecting import Collector
from gateway.recording import open_recording

ROWS = 20_000


def run() -> Report:
    """Rows of a stream, then recordings solved by one and two workers, one of which dies."""
    report = Report("fleet_archive")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        report.figures += _rows_in_and_out(Archive(folder / "streams", is_new=True))
        batch._record_sessions(folder / "sessions")
        archive = Archive(folder / "archive", is_new=True)
        for number, path in enumerate(sorted((folder / "sessions").glob("*.mcap"))):
            archive.add(open_recording(path), path, "bench", f"wearer{number % 4}")
        rows, results = [], []
        for what, workers, kills in (
            ("kernels compiled", 1, False),
            ("1 worker", 1, False),
            ("2 workers", 2, False),
            ("2 workers, one killed", 2, True),
        ):
            for path in archive.poses.rglob("*.parquet"):
                path.unlink()
            seconds, errors, killed = _solved(archive, workers, kills)
            results.append(tuple(path.read_bytes() for path in sorted(archive.poses.rglob("*.parquet"))))
            rows.append([what, f"{seconds:.1f}", str(errors), str(killed)])
        heads = ["on Dask", "seconds", "recordings failed", "workers killed"]
        report.tables.append(f"## {batch.SESSIONS} recordings solved again\n\n" + table(heads, rows))
        report.figures.append(
            Figure("fleet_solved_differing", len(set(results)) - 1.0, "results", "<=0", "bytes of all files")
        )
        files, left = archive.forget("wearer1")
        report.figures.append(
            Figure("fleet_forgotten_left", float(left), "files", "<=0", f"naming a wearer, {files} deleted")
        )
    return report


def _solved(archive: Archive, workers: int, kills: bool) -> tuple[float, int, int]:
    """Solve all; return seconds, recordings that failed, and workers killed after the first one."""
    outcomes: list[solving.SolvedRecording] = []
    killed: list[int] = []

    def done(outcome: solving.SolvedRecording) -> None:
        outcomes.append(outcome)
        if kills and not killed:
            children = psutil.Process().children(recursive=True)
            worker = next(each for each in children if "spawn_main" in " ".join(each.cmdline()))
            worker.kill()
            killed.append(worker.pid)

    begun = time.monotonic()
    solving.run(solving.jobs_of(archive, "independent"), done, workers)
    return time.monotonic() - begun, sum(each.error is not None for each in outcomes), len(killed)


def _rows_in_and_out(archive: Archive) -> list[Figure]:
    """Poses of seventeen segments and their knee angle, as they come from a broker, and asked for."""
    collector = Collector(archive, "bench", "mocap", {})
    segments = {f"segment_{i}": [0.5, 0.5, 0.5, 0.5] for i in range(17)}
    info = (
        b'{"version":"1","gateway":"g","reconstructor":"joint","frame_rate":100,"instance":"i",'
        b'"utc":{"t_ns":0,"utc_ns":0,"offset_ns":0,"steps":0}}'
    )
    messages = [_Message("mocap/g/bridge/info", info)]
    for seq in range(ROWS):
        pose = {"t_ns": seq * 10**7, "seq": seq, "segments": segments}
        pose["joint_angles"] = {"right_knee": {"flexion": float(seq % 90)}}
        messages.append(_Message("mocap/g/pose", orjson.dumps(pose)))
    begun = time.perf_counter()
    for message in messages:
        collector.take(message)
    collector.flush()
    into = ROWS / (time.perf_counter() - begun)
    archive.renew_catalogue()
    begun = time.perf_counter()
    _, answer = archive.query("SELECT count(*) FROM poses WHERE right_knee_flexion_deg > 60")
    assert next(answer) == (sum(seq % 90 > 60 for seq in range(ROWS)),)
    out = ROWS / (time.perf_counter() - begun)
    size = sum(path.stat().st_size for path in archive.poses.rglob("*.parquet"))
    return [
        Figure("fleet_archive_rows_in", into, "rows/s", "", "messages of 17 segments to Parquet, one core"),
        Figure("fleet_archive_rows_out", out, "rows/s", "", "all knee angles above 60°, DuckDB started anew"),
        Figure("fleet_archive_row_bytes", size / ROWS, "B", "", "a row of constant orientations"),
    ]


class _Message:
    """As aiomqtt gives it."""

    retain = False

    def __init__(self, topic: str, payload: bytes) -> None:
        self.topic = type("Topic", (), {"value": topic})
        self.payload = payload
