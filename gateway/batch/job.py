"""One recording of a batch: what is wanted of it, and the doing of it. Runs in a process of its own."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path

import gateway
from devices.link import LinkError
from gateway.batch import REPORT, SOLVED
from gateway.errors import GatewayError
from gateway.recording import Recording, open_recording
from gateway.recording.exporters.formats import FORMATS, Axes
from gateway.recording.exporters.take import take_of
from gateway.recording.snapshot import decode_suit
from gateway.recording.solving import SolvingSetup, recorded_setup, write_solved
from gateway.report import gather, write_report


@dataclass(frozen=True)
class Task:
    """What is wanted of every recording. Plain values: it travels to other machines."""

    to: tuple[str, ...]
    """Of ``KINDS``."""
    axes: str | None = None
    units_per_m: float | None = None
    suit: bytes | None = None
    """Solve with this suit (``snapshot``) instead of the recorded one."""
    reconstructor: str | None = None
    """Solve by this method instead of the recorded one."""
    delay_ms: float | None = None
    """Solve with this delay instead of the recorded one."""
    smooth: bool | None = None
    """Solve forward and backward, or not; None: as recorded."""

    @property
    def is_solved(self) -> bool:
        """Whether poses are made anew."""
        others = (self.suit, self.reconstructor, self.delay_ms, self.smooth)
        return any(other is not None for other in others) or SOLVED in self.to

    @property
    def key(self) -> str:
        """The same for the same results: wishes and version."""
        plain = asdict(self) | {
            "suit": self.suit.decode() if self.suit else None,
            "version": gateway.__version__,
        }
        return hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).hexdigest()[:16]


@dataclass(frozen=True)
class Job:
    """One recording and where its results go."""

    name: str
    """Path below the folder of the batch, for people and for the manifest."""
    source: Path
    folder: Path
    task: Task


@dataclass(frozen=True)
class JobResult:
    """What became of a job."""

    name: str
    outputs: dict[str, int] = field(default_factory=dict)
    """File name to bytes."""
    seconds: float = 0.0
    error: str | None = None
    note: str | None = None
    """What was wrong with the recording, where something could be made of it all the same."""


def partial_folder(job: Job, process: int | None) -> Path:
    """Return where a process has what it makes until all of it is there."""
    return job.folder / f".partial-{process}-{job.source.stem}"


def perform(job: Job) -> JobResult:
    """Do it. Never raises for what is wrong with one recording: that is its outcome."""
    begun = time.perf_counter()
    partial = partial_folder(job, os.getpid())
    try:
        partial.mkdir(parents=True, exist_ok=True)
        note = _make(job, partial)
        outputs = {}
        for path in sorted(partial.iterdir()):
            outputs[path.name] = path.stat().st_size
            # Moved only when all are whole, so that no half file is ever left.
            os.replace(path, job.folder / path.name)
        return JobResult(job.name, outputs, time.perf_counter() - begun, note=note)
    except (GatewayError, LinkError, OSError, ValueError, MemoryError) as error:
        what = str(error).splitlines()[0] if str(error) else type(error).__name__
        return JobResult(job.name, seconds=time.perf_counter() - begun, error=what)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _make(job: Job, folder: Path) -> str | None:
    """Write all results into ``folder``; return what was wrong with the recording, or None."""
    task, recording = job.task, open_recording(job.source)
    name = job.source.stem
    if task.is_solved:
        solved = folder / f"{name}.mcap"
        write_solved(recording, solved, _setup(recording, task))
        note, recording = recording.defect, open_recording(solved)
    else:
        note = None
    lacks = _export(recording, task, folder, name)
    if REPORT in task.to:
        # The solved recording was only a step on the way to the other results.
        write_report(gather(recording), folder / f"{name}.html")
    if task.is_solved and SOLVED not in task.to:
        (folder / f"{name}.mcap").unlink()
    return "; ".join(filter(None, [note or recording.defect, *lacks])) or None


def _export(recording: Recording, task: Task, folder: Path, name: str) -> list[str | None]:
    """Write the formats that are asked for; return what of the motion each cannot hold."""
    wanted = [kind for kind in task.to if kind in FORMATS]
    if not wanted:
        return []
    arrays, lacks = recording.skeleton_arrays(), []
    for kind in wanted:
        exported = FORMATS[kind]
        axes = Axes(task.axes) if task.axes else exported.axes
        take = take_of(arrays, name, axes, recording, as_recorded=exported.as_recorded)
        unit = task.units_per_m or exported.units_per_m
        lacks.append(exported.write(take, folder / f"{name}{exported.suffix}", unit))
    return lacks


def _setup(recording: Recording, task: Task) -> SolvingSetup:
    recorded = recorded_setup(recording)
    suit = recorded.suit if task.suit is None else decode_suit(task.suit)
    settings = recorded.settings.solved_by(task.reconstructor, task.delay_ms)
    return SolvingSetup(suit, settings, recorded.smoothed if task.smooth is None else task.smooth)
