"""A marker trial solved into a recording: it replays, exports and reports like any other."""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from devices import recording_format as fmt
from devices.extras import how_to_add
from devices.link import Chunk
from devices.links.marker_file_link import trial_chunks
from devices.marker_files import MarkerTrial
from devices.marker_files.naming import spelt
from devices.recording_writer import DerivedRecordingWriter, RecordingWriter
from gateway.body.skeleton import BodyMarkers, WornSuit
from gateway.errors import GatewayError
from gateway.frames import FloatArray, MarkerFit, MarkerFrame
from gateway.pipeline import Pipeline
from gateway.reconstruction import BOTH_WAYS, PUBLISHED
from gateway.reconstruction.optical.both_ways import solve_both_ways
from gateway.reconstruction.optical.fitted_body import MOST_REST_MM
from gateway.reconstruction.optical.landmarks import to_world
from gateway.reconstruction.optical.published_trial import published_trial
from gateway.recording.imported import add_solved, imported_session, origin_event, solve_into, solved_settings
from gateway.recording.reading import Progress
from gateway.recording.snapshot import attachments_of
from gateway.settings import GatewaySettings
from gateway.sources.link_settings import MarkersLinkSettings
from gateway.sources.markers import MarkerFrames
from gateway.stages.markers import MarkerStage

LINK = "markers"
CARRIES = "markers"
_BEGUN_NS = 10**9
"""Gateway time of 0 s of a trial's own time, or of its first frame where that comes before."""
_FASTEST_HZ = 4000.0
LEAST_USED = 0.5
"""Of the points seen, that had a say in a pose."""
_SHOWN_MM = 30.0
"""The largest residual that a plot tells apart."""
_FEWEST_MARKERS = 3
"""Fewer show no pose of anything. Names that two marker sets share by chance are as few."""


@dataclass(frozen=True)
class SolvedTrial:
    """What came of it."""

    path: Path
    frames: int
    labels: tuple[str, ...]
    residuals: FloatArray
    """(F, M) m; NaN where a marker was not seen, or there was no pose."""
    used: NDArray[np.bool_]
    """(F, M) had a say in the pose."""
    renamed: tuple[tuple[int, str, str], ...]
    """(frame, marker, whose point it had been; empty: a nameless one)."""
    counts: dict[str, int]
    ms_per_frame: float
    """Processor time, with decoding the markers and all else that a live frame costs."""

    @property
    def rmse(self) -> float:
        """m, of all markers that had a say; NaN with none."""
        return float(np.sqrt(np.mean(self.residuals[self.used] ** 2))) if self.used.any() else float("nan")

    @property
    def share_used(self) -> float:
        """Share of the points seen that had a say, 0 to 1."""
        seen = np.isfinite(self.residuals)
        return float(self.used[seen].mean()) if seen.any() else 0.0

    @property
    def is_poor(self) -> bool:
        """Whether this may be another person's trial, or one in another unit than its file tells."""
        return self.share_used < LEAST_USED or 1e3 * self.rmse > MOST_REST_MM

    def markers(self) -> dict[str, dict[str, float | None]]:
        """Return for each marker its residual, mm RMS (None: never seen), and how often it was seen and
        had a say, %."""
        seen = np.isfinite(self.residuals)
        squares = np.where(seen, self.residuals, 0.0) ** 2
        means = np.sqrt(squares.sum(axis=0) / np.maximum(seen.sum(axis=0), 1))
        return {
            label: {
                "rmse_mm": None if not seen[:, m].any() else round(1e3 * float(means[m]), 2),
                "seen_percent": round(100 * float(seen[:, m].mean()), 1),
                "used_percent": round(100 * float(self.used[:, m].mean()), 1),
            }
            for m, label in enumerate(self.labels)
        }

    def figures(self) -> dict[str, object]:
        """Return what came of it, as JSON takes it."""
        return {
            "file": str(self.path),
            "frames": self.frames,
            "rmse_mm": round(1e3 * self.rmse, 2),
            "ms_per_frame": round(self.ms_per_frame, 3),
            "counts": self.counts,
            "renamed": [{"frame": f, "marker": m, "was": was or None} for f, m, was in self.renamed],
            "markers": self.markers(),
        }


class _Fits:
    """What became of every marker in every frame."""

    def __init__(self, n_frames: int, markers: BodyMarkers) -> None:
        self.residuals = np.full((n_frames, len(markers.labels)), np.nan)
        self.used = np.zeros(self.residuals.shape, dtype=bool)
        self.renamed: list[tuple[int, str, str]] = []
        self._labels = markers.labels

    def add(self, index: int, fit: MarkerFit | None) -> None:
        """Keep the residuals of one frame; None: it has no pose."""
        if fit is None:
            return
        self.residuals[index], self.used[index] = fit.residuals, fit.used
        self.renamed += [
            (index, self._labels[marker], "" if had < 0 else self._labels[had]) for marker, had in fit.renamed
        ]


def optical_settings(subject: str, rate_hz: float, url: str) -> GatewaySettings:
    """Return a configuration that plays a file of markers."""
    return solved_settings(subject, rate_hz, MarkersLinkSettings(name=LINK, url=url), "optical")


def write_solved_trial(
    trial: MarkerTrial,
    source: Path,
    suit: WornSuit,
    subject: str,
    target: Path,
    progress: Progress | None = None,
    person: str | None = None,
    method: str = "default",
) -> SolvedTrial:
    """Solve every frame of a trial, and write poses and input to ``target``.

    person: whose markers, as in ``spellings``. method: one of ``METHODS``. Raises ``RecordingError`` when
    ``target`` exists, OSError as ``open`` does, ``FormatError`` where it is open whose markers are meant,
    ``GatewayError`` when it has hardly any of them.
    """
    markers, trial = _called(suit, subject, trial, source, person)
    settings = optical_settings(subject, trial.rate_hz, f"markers://{source.resolve()}")
    task = _Task(trial, source, suit, markers, settings, target)
    return METHODS[method](task, progress)


@dataclass(frozen=True)
class _Task:
    """A trial to solve, its markers named as the subject's, and where it goes."""

    trial: MarkerTrial
    source: Path
    suit: WornSuit
    markers: BodyMarkers
    settings: GatewaySettings
    target: Path

    def chunks(self) -> list[Chunk]:
        """Return the markers as a link gives them, a chunk a frame."""
        return list(trial_chunks(self.trial, _begun_ns(self.trial), LINK))

    @contextlib.contextmanager
    def writer(self, suit: WornSuit, solved_by: str = "") -> Iterator[RecordingWriter]:
        """Open the recording of a suit; solved_by: the method, where no pipeline can have it."""
        origin_ns, first_ns = _origin_ns(self.trial), _begun_ns(self.trial)
        session = imported_session({LINK: CARRIES}, self.target, "optical", origin_ns, solved_by=solved_by)
        kind = self.source.suffix.lstrip(".").lower()
        attachments = attachments_of(self.settings, suit)
        with DerivedRecordingWriter(self.target, session, attachments, origin_ns) as writer:
            writer.add(fmt.EVENTS, first_ns, origin_event(kind, [self.source], first_ns))
            yield writer


def _solve_live(task: _Task, progress: Progress | None) -> SolvedTrial:
    """Solve as a running gateway does, frame by frame."""
    trial, markers = task.trial, task.markers
    pipeline = Pipeline.from_settings(task.settings, task.suit)
    pipeline.add_link(LINK, CARRIES)
    stage = pipeline.stage_of(MarkerFrame)
    assert isinstance(stage, MarkerStage)
    optical = stage.reconstructor
    fits = _Fits(trial.n_frames, markers)
    with task.writer(task.suit) as writer:
        frames, spent = solve_into(
            writer, pipeline, task.chunks(), CARRIES, lambda index: fits.add(index, optical.last), progress
        )
        end_ns = _begun_ns(trial) + round(trial.duration_s * 1e9)
        writer.add(fmt.STATISTICS, end_ns, json.dumps(pipeline.statistics()).encode())
    return SolvedTrial(
        path=task.target,
        frames=frames,
        labels=markers.labels,
        residuals=fits.residuals,
        used=fits.used,
        renamed=tuple(fits.renamed),
        counts=dict(optical.counts),
        ms_per_frame=1e3 * spent / max(trial.n_frames, 1),
    )


def _solve_published(task: _Task, progress: Progress | None) -> SolvedTrial:
    """Solve by the published method, which goes through the whole trial several times; the suit of the
    recording has the virtual markers as it found them."""
    trial, markers = task.trial, task.markers
    began = time.process_time()
    observed = to_world(trial.columns(markers.labels), markers.vertical)
    solved = published_trial(task.suit.skeleton, markers, observed, trial.rate_hz, progress)
    spent = time.process_time() - began
    chunks = task.chunks()
    with task.writer(replace(task.suit, markers=solved.motion.markers), PUBLISHED) as writer:
        frames = solved.frames([chunk.arrived_ns for chunk in chunks])
        for chunk, frame in zip(chunks, frames, strict=True):
            add_solved(writer, chunk, CARRIES, [frame])
    return SolvedTrial(
        path=task.target,
        frames=trial.n_frames,
        labels=markers.labels,
        residuals=solved.residuals,
        used=solved.seen,
        renamed=(),
        counts={"passes": solved.motion.passes},
        ms_per_frame=1e3 * spent / max(trial.n_frames, 1),
    )


def _solve_both_ways(task: _Task, progress: Progress | None) -> SolvedTrial:
    """Solve with what comes after a gap too."""
    markers, chunks = task.markers, task.chunks()
    receiver = MarkerFrames(markers)
    observed = [frame for chunk in chunks for frame in receiver.receive(chunk)]
    began = time.process_time()
    solved, counts = solve_both_ways(task.suit.skeleton, markers, observed, progress)
    spent = time.process_time() - began
    fits = _Fits(len(solved), markers)
    with task.writer(task.suit, BOTH_WAYS) as writer:
        for index, (chunk, frame) in enumerate(zip(chunks, solved, strict=True)):
            add_solved(writer, chunk, CARRIES, [frame])
            fits.add(index, frame.markers)
    return SolvedTrial(
        path=task.target,
        frames=len(solved),
        labels=markers.labels,
        residuals=fits.residuals,
        used=fits.used,
        renamed=tuple(fits.renamed),
        counts=dict(counts),
        ms_per_frame=1e3 * spent / max(len(solved), 1),
    )


METHODS = {"default": _solve_live, BOTH_WAYS: _solve_both_ways, PUBLISHED: _solve_published}
"""By the word of ``optical solve --method``."""


def write_residual_plot(solved: SolvedTrial, rate_hz: float, path: Path) -> None:
    """Plot the residuals of all markers over time: a row a marker, a column a frame.

    Raises ``GatewayError`` without the extra ``plot``, or for a file that cannot be written.
    """
    try:
        from matplotlib.figure import Figure  # noqa: PLC0415 - an extra
    except ImportError:
        raise GatewayError(f"--plot needs the extra 'plot': {how_to_add('plot')}") from None
    residuals = 1e3 * np.asarray(solved.residuals)
    seconds = len(residuals) / rate_hz
    figure = Figure(figsize=(10, 0.16 * len(solved.labels) + 3), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(1, 3))
    times = np.arange(len(residuals)) / rate_hz
    with np.errstate(invalid="ignore"):
        rms = np.sqrt(np.nansum(residuals**2, axis=1) / np.maximum(np.isfinite(residuals).sum(axis=1), 1))
    above.plot(times, rms, linewidth=1)
    above.set_ylabel("RMS, mm")
    above.set_ylim(bottom=0)
    image = below.imshow(
        residuals.T, aspect="auto", interpolation="nearest", vmin=0, vmax=_SHOWN_MM, cmap="viridis",
        extent=(0.0, seconds, len(solved.labels) - 0.5, -0.5),
    )  # fmt: skip
    below.set_yticks(range(len(solved.labels)), solved.labels, fontsize=6)
    below.set_xlabel("time, s (white: not seen)")
    figure.colorbar(image, ax=below, label="distance of marker and body, mm", extend="max")
    try:
        figure.savefig(path, dpi=120)
    except (OSError, ValueError) as error:
        raise GatewayError(f"{path} cannot be written: {error}") from error


def _called(
    suit: WornSuit, subject: str, trial: MarkerTrial, source: Path, person: str | None
) -> tuple[BodyMarkers, MarkerTrial]:
    """Return the subject's markers, and the trial with its markers named as the subject's.

    Raises ``GatewayError`` if there are too few of them, or the rate is too high.
    """
    if not trial.rate_hz <= _FASTEST_HZ:
        raise GatewayError(
            f"{source}: {trial.rate_hz:g} frames a second, of which {_FASTEST_HZ:g} are solved at the most: "
            "correct the rate in the file (POINT:RATE, or DataRate), or leave frames out"
        )

    markers = suit.markers
    if markers is None:
        raise GatewayError(f"{subject} is no fitted subject: make one with `mocap-gateway optical fit`")
    called = spelt(trial, markers.labels, person=person)
    shared = sorted(set(markers.labels) & set(called.labels))
    if len(shared) < _FEWEST_MARKERS:
        raise GatewayError(
            f"{source} has {'only ' + ', '.join(shared) if shared else 'none'} of the markers of {subject} "
            f"({', '.join(markers.labels[:6])}, …); it has "
            + (", ".join([label for label in trial.labels if label][:6]) or "no named ones")
        )
    # Enough names are not enough frames: a label may stand for a marker that was never seen.
    seen = np.isfinite(called.columns(markers.labels)).all(axis=2).sum(axis=1)
    if not (seen >= _FEWEST_MARKERS).any():
        raise GatewayError(
            f"{source}: no frame shows {_FEWEST_MARKERS} of the markers of {subject}: "
            "its points are empty, zero or farther than 1 km from the origin; export the trial again"
        )
    return markers, called


def _origin_ns(trial: MarkerTrial) -> int:
    """Return the gateway time of 0 s of a trial's own time."""
    return _BEGUN_NS + max(0, -round(trial.begins_s * 1e9))


def _begun_ns(trial: MarkerTrial) -> int:
    """Return the gateway time of a trial's first frame."""
    return _origin_ns(trial) + round(trial.begins_s * 1e9)
