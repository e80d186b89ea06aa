"""The comparison of a soak in simulated time, for a machine that is too busy for one in real time.

The same faults befall the same suit, and its bytes go through the pipeline alone, each chunk when it would
have come: what else the machine does meanwhile makes no difference.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

from benchmarks.asked_suit import asked
from benchmarks.fault_bench import METHOD
from benchmarks.soak_reference import Comparison, FaultFree, Orientations
from devices.emulators import IDEAL, SuitSettings, SuitTraffic
from devices.emulators.faults.fault_plan import FaultPlan, FaultWindows, Unplug
from devices.emulators.faults.faulty_suit import FaultySuit
from devices.link import Chunk, Framing, SentChunk
from gateway.emulation.simulation import LINK, suit_17
from gateway.pipeline import Pipeline
from gateway.settings import AssemblySettings

START_NS = 1_000_000_000


def simulated(plan: FaultPlan, seconds: float) -> list[dict[str, float]]:
    """The rows of ``Comparison.summary``."""
    free = FaultFree(START_NS)
    comparison = Comparison(free.worn, plan, START_NS)
    pipeline = Pipeline(free.worn, AssemblySettings().params(), METHOD)
    pipeline.add_link(LINK, Framing.BYTE_STREAM)
    for chunk in _chunks(plan, seconds, pipeline.stream.sent):
        for frame in pipeline.feed(chunk):
            late_s = (chunk.arrived_ns - frame.time_ns) * 1e-9
            pose = Orientations(frame.q_wb, frame.angular_rate)
            comparison.take(frame.time_ns, frame.status, pose, free.at(frame.time_ns), late_s)
    return comparison.summary()


def _chunks(plan: FaultPlan, seconds: float, note: Callable[[SentChunk], None]) -> Iterator[Chunk]:
    """What comes through the cable, while it is plugged in. note: told of every question."""
    _, motion = suit_17()
    suit = FaultySuit(SuitTraffic(motion, SuitSettings(has_relay=True), IDEAL, seed=1), plan)
    pulls = FaultWindows(plan.windows(Unplug))
    for chunk in asked(suit, note, START_NS, LINK):
        at_s = (chunk.arrived_ns - START_NS) * 1e-9
        if at_s > seconds:
            return
        if not pulls.on(at_s):
            yield chunk
