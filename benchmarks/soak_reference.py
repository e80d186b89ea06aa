"""``python -m benchmarks.soak_reference TRACK``: follows a soak, comparing its poses with a fault-free run.

A process of its own, so that what it needs does not count as the gateway's. The same suit without any fault
goes through a second pipeline; poses of both are compared at the same instants. A segment is intact at an
instant since its module's samples last were anything but measured (``status``) and in time, and since the
last fault of that module or of its sensors. When samples come is an input as well, from which clocks are
estimated: where a burst or a busy machine makes them late, it is not what the fault-free run had.

What the estimator remembers is an input too: so angles are told by how long the segment has been intact.
After a gap a module settles for 3 s, and what is left of its heading's error fades within 9 s (VQF,
``tauMag``).
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.asked_suit import asked
from benchmarks.fault_bench import METHOD
from devices.emulators import IDEAL, SuitSettings, SuitTraffic
from devices.emulators.faults.fault_plan import Fault, FaultPlan, FaultWindows
from devices.link import Framing
from gateway.body.skeleton import WornSuit
from gateway.emulation.simulation import suit_17
from gateway.frames import FloatArray, SkeletonFrame, Status
from gateway.pipeline import Pipeline
from gateway.settings import AssemblySettings

SETTLED_S = 20.0
"""Both runs have found their heading by then."""
AFTER_FAULT_S = 0.1
"""A fault of a module is over so much later for its samples, at the latest."""
LATEST_S = 0.1
"""Time from the instant of a pose to the pose beyond which its samples were late; usually 13 ms."""
SINCE_S = (0.0, 1.0, 3.0, 10.0, 20.0)
"""Lower ends of the classes: for how long a segment has been intact."""
_STEP, _LARGEST = 0.01, 180.0
"""Width of the bins of angles (degrees) and rates (rad/s), and the last one's end."""
_LINK = "suit"
_POLL_S = 0.2
_LARGEST_STEP_NS = 15_000_000


def record_type(n_segments: int) -> np.dtype[Any]:
    """A pose in the track: instant (ns; -1: the end), lateness; by segment status, orientation, rate."""
    vectors = [("q_wb", "<f4", (n_segments, 4)), ("angular_rate", "<f4", (n_segments, 3))]
    return np.dtype([("time_ns", "<i8"), ("late_s", "<f4"), ("status", "u1", n_segments), *vectors])


class Orientations(NamedTuple):
    """What is compared, at one instant."""

    q_wb: FloatArray  # (S, 4)
    angular_rate: FloatArray  # (S, 3) rad/s


class Comparison:
    """Angles between poses and those of a fault-free run, by how long their segments have been intact."""

    def __init__(self, worn: WornSuit, plan: FaultPlan, start_ns: int) -> None:
        """start_ns: gateway time of motion time 0."""
        self._sensed = np.flatnonzero(worn.module_of_segment >= 0)
        module_of = [worn.module_ids[worn.module_of_segment[segment]] for segment in self._sensed]
        of_module = {row: _faults_of(plan, module) for row, module in enumerate(module_of)}
        self._faults = {row: FaultWindows(some, AFTER_FAULT_S) for row, some in of_module.items() if some}
        """By row of ``_sensed``, where there are any."""
        self._start_ns = start_ns
        self._disturbed_s = np.full(len(self._sensed), SETTLED_S)
        self._last_ns = 0
        bins = round(_LARGEST / _STEP)
        self._angles = np.zeros((len(SINCE_S), bins), dtype=np.int64)
        self._rates = np.zeros((len(SINCE_S), bins), dtype=np.int64)

    def take(
        self,
        time_ns: int,
        status: NDArray[np.uint8],
        pose: Orientations,
        free: Orientations,
        late_s: float = 0.0,
    ) -> None:
        """One pose with its status (S,), the fault-free one at its instant, and how late it was."""
        now_s = (time_ns - self._start_ns) * 1e-9
        is_disturbed = status[self._sensed] != Status.MEASURED
        is_disturbed |= time_ns - self._last_ns > _LARGEST_STEP_NS or late_s > LATEST_S
        for row, windows in self._faults.items():
            is_disturbed[row] |= windows.near(now_s)
        self._last_ns = time_ns
        self._disturbed_s[is_disturbed] = max(now_s, SETTLED_S)
        intact_s = now_s - self._disturbed_s
        cosine = np.abs(np.sum(pose.q_wb * free.q_wb, axis=1))[self._sensed]
        angle_deg = np.degrees(2.0 * np.arccos(np.clip(cosine, 0.0, 1.0)))
        rate = np.linalg.norm(pose.angular_rate - free.angular_rate, axis=1)[self._sensed]
        usable = ~is_disturbed & np.isfinite(angle_deg) & np.isfinite(rate) & (intact_s > 0.0)
        classes = np.searchsorted(SINCE_S, intact_s[usable], side="right") - 1
        for counts, values in ((self._angles, angle_deg), (self._rates, rate)):
            places = np.minimum(values[usable] / _STEP, counts.shape[1] - 1).astype(int)
            np.add.at(counts, (classes, places), 1)

    def summary(self) -> list[dict[str, float]]:
        """A row a class: ``intact_s`` from, how many poses of segments, percentiles of angle and rate."""
        return [
            {
                "intact_s": since_s,
                "count": int(angles.sum()),
                **{f"p{q:g}_deg": _percentile(angles, q) for q in (50, 99, 99.9, 100)},
                **{f"p{q:g}_rad_s": _percentile(rates, q) for q in (50, 99, 99.9)},
            }
            for since_s, angles, rates in zip(SINCE_S, self._angles, self._rates, strict=True)
        ]


def _percentile(counts: NDArray[np.int64], percent: float) -> float:
    """Upper end of the bin that holds it; 0 for no counts."""
    if not counts.any():
        return 0.0
    reached = np.cumsum(counts) >= percent * 0.01 * counts.sum()
    return round((int(np.argmax(reached)) + 1) * _STEP, 2)


def _faults_of(plan: FaultPlan, module: int) -> list[Fault]:
    """Faults of a module or its sensors, also where another one takes its id."""
    return [
        fault
        for fault in plan.faults
        if module in (getattr(fault, "module", None), getattr(fault, "takes", None))
    ]


class FaultFree:
    """The same suit through the same pipeline, as if nothing ever went wrong."""

    def __init__(self, start_ns: int) -> None:
        worn, motion = suit_17()
        self.worn = worn
        self._pipeline = Pipeline(worn, AssemblySettings().params(), METHOD)
        self._pipeline.add_link(_LINK, Framing.BYTE_STREAM)
        self._traffic = SuitTraffic(motion, SuitSettings(has_relay=True), IDEAL, seed=1)
        self._start_ns = start_ns
        self._frames = self._run()
        self._before, self._after = next(self._frames), next(self._frames)

    def at(self, time_ns: int) -> Orientations:
        """At an instant; instants come in order of time. NaN before the first."""
        while self._after.time_ns < time_ns:
            self._before, self._after = self._after, next(self._frames)
        before, after = self._before, self._after
        share = (time_ns - before.time_ns) / (after.time_ns - before.time_ns)
        if share < 0.0:
            return Orientations(np.full_like(after.q_wb, np.nan), np.full_like(after.angular_rate, np.nan))
        sign = np.where(np.sum(before.q_wb * after.q_wb, axis=1) < 0.0, -1.0, 1.0)
        between = (1.0 - share) * before.q_wb + share * sign[:, None] * after.q_wb
        rate = (1.0 - share) * before.angular_rate + share * after.angular_rate
        return Orientations(between / np.linalg.norm(between, axis=1, keepdims=True), rate)

    def _run(self) -> Iterator[SkeletonFrame]:
        for chunk in asked(self._traffic, self._pipeline.stream.sent, self._start_ns, _LINK):
            yield from self._pipeline.feed(chunk)


def follow(track: Path, plan: FaultPlan, start_ns: int) -> list[dict[str, float]]:
    """Read the track while it is written, up to its end; the comparison's rows."""
    free = FaultFree(start_ns)
    comparison = Comparison(free.worn, plan, start_ns)
    record = record_type(len(free.worn.skeleton.segment_names))
    with track.open("rb") as file:
        rest = b""
        while True:
            rest += file.read(1 << 20)
            whole = len(rest) // record.itemsize * record.itemsize
            for pose in np.frombuffer(rest[:whole], dtype=record):
                if pose["time_ns"] < 0:
                    return comparison.summary()
                time_ns = int(pose["time_ns"])
                live = Orientations(pose["q_wb"].astype(float), pose["angular_rate"].astype(float))
                comparison.take(time_ns, pose["status"], live, free.at(time_ns), float(pose["late_s"]))
            rest = rest[whole:]
            time.sleep(_POLL_S)


def main(arguments: Sequence[str]) -> None:
    """TRACK: the file of poses; beside it TRACK.json with ``plan`` and ``start_ns``. Prints rows as JSON."""
    track = Path(arguments[0])
    recorded = json.loads(track.with_suffix(".json").read_text())
    print(json.dumps(follow(track, FaultPlan.model_validate(recorded["plan"]), recorded["start_ns"])))


if __name__ == "__main__":
    main(sys.argv[1:])
