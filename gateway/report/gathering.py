"""What a report shows, gathered in one pass over a recording; memory does not grow with its length."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from devices.link import Chunk, InputEvent, SentChunk
from gateway.body.joint_angles import joint_angles
from gateway.body.skeleton import WornSuit
from gateway.frames import FloatArray, IntArray, SkeletonFrame, Status
from gateway.recording.arrays import SkeletonArrays, arrays_of
from gateway.recording.reading import Progress, RecordedStatistics, Recording
from gateway.recording.solving import recorded_sources
from gateway.recording.summary import RecordingSummary, summarise
from gateway.sources.sources import Sources

_MOST_BINS = 400
"""Of time: more cannot be seen."""
_MOST_POSES = 3000
_SHORTEST_BIN_S = 0.5
_LONGEST_EVENTS = 200


class ModuleFindings:
    """One module over time. Arrays have one element a bin of time; NaN before its first packet."""

    def __init__(self, module: int, segment: str, bins: int) -> None:
        self.module = module
        self.segment = segment
        self.lost, self.received, self.clock_ppm, self.residual_us = np.full((4, bins), np.nan)
        self.totals: dict[str, Any] = {}
        """As in ``bridge/health``, at the end."""

    @property
    def loss_percent(self) -> float:
        """Share of the packets sent that were lost, %."""
        sent = float(np.nansum(self.lost) + np.nansum(self.received))
        return 100.0 * float(np.nansum(self.lost)) / sent if sent else 0.0


@dataclass
class Findings:
    """All that the page shows."""

    recording: Recording
    summary: RecordingSummary
    suit: WornSuit | None
    bin_times_s: FloatArray
    modules: list[ModuleFindings]
    events: list[InputEvent]
    more_events: int
    poses: SkeletonArrays | None
    """Thinned to what a plot can show."""
    joint_angles: FloatArray | None
    """(F, J, 3) rad, of the same frames."""
    n_poses: int
    status_counts: IntArray
    """(S, 6) poses by status."""


class _Poses:
    """Keeps every k-th pose, k doubling as the recording goes on; counts all by status."""

    def __init__(self, n_segments: int) -> None:
        self.kept: list[SkeletonFrame] = []
        self.count = 0
        self.status = np.zeros((n_segments, len(Status)), np.int64)
        self._every = 1

    def add(self, frame: SkeletonFrame) -> None:
        """Count a frame, and keep it if it is due."""
        self.status[np.arange(len(frame.status)), frame.status] += 1
        if self.count % self._every == 0:
            # When too many are kept, every other one is dropped: memory stays bounded, spacing stays even.
            self.kept.append(frame)
            if len(self.kept) > 2 * _MOST_POSES:
                self.kept, self._every = self.kept[::2], 2 * self._every
        self.count += 1


class _Modules:
    """The stream decoded anew, and looked at every so often."""

    def __init__(
        self, sources: Sources | None, names: dict[int, str], begun_ns: int, bin_s: float, bins: int
    ) -> None:
        self._sources, self._names = sources, names
        self._begun_ns, self._bin_ns, self._bins = begun_ns, bin_s * 1e9, bins
        self._bin = 0
        self.found: dict[int, ModuleFindings] = {}
        self._before: dict[int, tuple[int, int]] = {}

    def take(self, item: Chunk | SentChunk) -> None:
        """Feed an input to the sources, and read the counters at the end of every bin."""
        if self._sources is None or not self._sources.has_modules(item.link):
            return
        if isinstance(item, SentChunk):
            self._sources.sent(item)
            return
        at = min(int(max(item.arrived_ns - self._begun_ns, 0) // self._bin_ns), self._bins - 1)
        if at > self._bin:
            self.look()
            self._bin = at
        self._sources.receive(item)

    def look(self) -> None:
        """Enter what the bin brought."""
        for module, record in self._sources.modules.records.items() if self._sources else ():
            found = self.found.get(module)
            if found is None:
                found = ModuleFindings(module, self._names.get(module, ""), self._bins)
                self.found[module] = found
            # Counters run from the beginning of the recording: a bin has what came since the last look.
            lost, received = self._before.get(module, (0, 0))
            figures = record.clock.figures()
            found.lost[self._bin] = record.lost - lost
            found.received[self._bin] = record.received - received
            found.clock_ppm[self._bin] = figures.skew_ppm
            found.residual_us[self._bin] = figures.residual_us
            found.totals = record.summary()
            self._before[module] = record.lost, record.received


def gather(recording: Recording, progress: Progress | None = None) -> Findings:
    """Return everything that can be read, also of a file that was cut off or has holes."""
    summary = summarise(recording)
    meta = recording.meta
    suit = meta.suit if meta.has_suit else None
    # Times of the report count from the first bytes, not from the file's creation.
    first_ns = next((chunk.arrived_ns for chunk in recording.chunks()), meta.begun_ns)
    bin_s = max(_SHORTEST_BIN_S, summary.duration_s / _MOST_BINS)
    bins = max(int(np.ceil(summary.duration_s / bin_s)), 1)
    sources = recorded_sources(recording) if suit else None
    modules = _Modules(sources, _names(suit), first_ns, bin_s, bins)
    poses = _Poses(suit.skeleton.n_segments if suit else 0)
    events: list[InputEvent] = []
    totals: dict[str, Any] = {}

    for item in recording.items(progress):
        if isinstance(item, Chunk | SentChunk):
            modules.take(item)
        elif isinstance(item, SkeletonFrame) and len(item.status) == len(poses.status):
            poses.add(item)
        elif isinstance(item, InputEvent):
            events.append(item)
        elif isinstance(item, RecordedStatistics):
            # Statistics are totals: the last ones hold for the whole recording.
            totals = item.values

    modules.look()
    bin_times_s = np.linspace(0.5, bins - 0.5, bins) * np.float64(bin_s)
    arrays = arrays_of(poses.kept, suit.skeleton) if suit else None
    summary.modules = summary.modules or _counts(totals)
    return Findings(
        recording=recording,
        summary=summary,
        suit=suit,
        bin_times_s=bin_times_s,
        modules=[modules.found[module] for module in sorted(modules.found)],
        events=events[:_LONGEST_EVENTS],
        more_events=max(len(events) - _LONGEST_EVENTS, 0),
        poses=arrays,
        joint_angles=None if arrays is None else joint_angles(arrays.skeleton, arrays.q_wb),
        n_poses=poses.count,
        status_counts=poses.status,
    )


def _names(suit: WornSuit | None) -> dict[int, str]:
    """Return module id to what carries it."""
    if suit is None:
        return {}
    names = suit.skeleton.segment_names
    worn = {
        suit.module_ids[row]: names[segment]
        for segment, row in enumerate(suit.module_of_segment.tolist())
        if row >= 0
    }
    devices = {device.device: f"{names[device.segment]} ({device.quantity.name.lower()})"
               for device in suit.local_devices if device.device is not None}  # fmt: skip
    return devices | worn


def _counts(totals: dict[str, Any]) -> dict[str, dict[str, int]]:
    modules = totals.get("modules", {})
    return {
        name: {key: int(each.get(key, 0)) for key in ("received", "lost")} for name, each in modules.items()
    }
