"""What a soak notes of every pose, in memory that does not grow: latency, and a track for the comparison."""

from __future__ import annotations

import asyncio
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.fault_bench import Bench
from benchmarks.soak_reference import LATEST_S, record_type
from devices.emulators.faults.fault_plan import FaultPlan
from devices.link import gateway_time_ns
from gateway.frames import SkeletonFrame

_EDGES_MS = np.geomspace(0.1, 100_000.0, 1201)
"""Classes of latency, 1.2 % wide."""


class SoakWatch:
    """An output of a bench; starts the process that compares poses with a fault-free run."""

    def __init__(self, track: Path, plan: FaultPlan, bench: Bench) -> None:
        """track: the file that poses are written to."""
        start_ns = bench.suit.start_ns
        track.with_suffix(".json").write_text(
            json.dumps({"plan": plan.model_dump(mode="json"), "start_ns": start_ns})
        )
        self._file = track.open("wb")
        self._record = np.zeros(1, dtype=record_type(len(bench.service.pipeline.suit.skeleton.segment_names)))
        self._latencies = np.zeros(len(_EDGES_MS) + 1, dtype=np.int64)
        command = [sys.executable, "-m", "benchmarks.soak_reference", str(track)]
        self._suit = bench.suit
        self._poses = self._poses_of_late_suit = 0
        self._comparing = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        bench.watch.on_pose = self._note

    def _note(self, frame: SkeletonFrame) -> None:
        latency_s = (gateway_time_ns() - frame.time_ns) * 1e-9
        self._latencies[np.searchsorted(_EDGES_MS, 1e3 * latency_s)] += 1
        self._poses += 1
        self._poses_of_late_suit += self._suit.counts.lateness_s > LATEST_S
        self._record["late_s"] = max(latency_s, self._suit.counts.lateness_s)
        self._record["time_ns"], self._record["status"] = frame.time_ns, frame.status
        self._record["q_wb"], self._record["angular_rate"] = frame.q_wb, frame.angular_rate
        self._file.write(self._record.tobytes())

    @property
    def busy_share(self) -> float:
        """Of the time in which the emulated suit itself was late: the machine had no time for it."""
        return self._poses_of_late_suit / max(1, self._poses)

    def latency_ms(self) -> dict[str, float]:
        """Percentiles, ms: from the instant of a pose to its being handed to the outputs."""
        reached = np.cumsum(self._latencies) / max(1, self._latencies.sum())
        return {
            f"p{q:g}": round(float(_EDGES_MS[min(np.searchsorted(reached, q / 100), len(_EDGES_MS) - 1)]), 2)
            for q in (50, 95, 99, 99.9)
        }

    async def compared(self) -> list[dict[str, Any]]:
        """End the track, and wait for the comparison (see ``Comparison.summary``)."""
        self._record["time_ns"] = -1
        self._file.write(self._record.tobytes())
        self._file.close()
        output, _ = await asyncio.to_thread(self._comparing.communicate)
        rows: list[dict[str, Any]] = json.loads(output)
        return rows
