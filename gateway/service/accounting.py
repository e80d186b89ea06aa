"""Where everything went: balances that must come out even, from counters that know nothing of each other.

    sent by the modules (their numbers)  =  received + lost, by what happened on the link meanwhile
    bytes that a link took               =  handed to the decoder + dropped for a slow reader + waiting
    packets out of the decoders          =  new ones + repeated + our own echoed + answers nobody awaited
    readings out of the stream           =  taken for frames + each kind of drop + held back by the despiker
    instants of the grid                 =  frames + instants left out in silence
    frames assembled                     =  poses reconstructed + left out in overload
                                            + instants of cameras before the first smoothed pose
    poses offered to an output           =  published + dropped + thinned + queued
    chunks handed to the recorder        =  written + lost + waiting for the disk

All of it belongs to one event loop: between two chunks every balance is even. What is left over is a defect
of the gateway, never of the suit. What a module sent after its last packet that was heard and before it lost
its power nobody can know; nor what it sent before its first one.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from devices.link_counts import LinkCounts
from gateway.assembly.frame_assembler import FrameAssembler, Lost
from gateway.contract.balances import Balance
from gateway.contract.messages import OutputCounters
from gateway.pipeline import Pipeline
from gateway.recording.recorder import RecorderBalance
from gateway.sources.losses import Cause
from gateway.sources.stream import SAMPLE_KINDS


def balances_of(
    pipeline: Pipeline,
    outputs: Mapping[str, OutputCounters] | None = None,
    recording: RecorderBalance | None = None,
    links: Mapping[str, LinkCounts] | None = None,
) -> list[Balance]:
    """All balances of a pipeline, its outputs and links (by name) and the recording, if there is one."""
    balances = [*_stream(pipeline), _readings(pipeline), *_frames(pipeline)]
    for name, counters in (outputs or {}).items():
        parts = {part: getattr(counters, part) for part in ("published", "dropped", "thinned", "queued")}
        balances.append(Balance(f"output_{name}", pipeline.skeleton_frames, parts))
    for name, counts in (links or {}).items():
        parts = {"handed": counts.handed, "behind": counts.behind, "waiting": counts.waiting}
        balances.append(Balance(f"link_{name}_bytes", counts.taken, parts))
    if recording is not None:
        parts = {"written": recording.written, "lost": recording.lost, "waiting": recording.waiting}
        balances.append(Balance("recorded_chunks", recording.handed, parts))
    return balances


def _stream(pipeline: Pipeline) -> Iterator[Balance]:
    stream = pipeline.stream
    of_samples = [
        counter
        for record in stream.modules.values()
        for kind, counter in record.sequences.items()
        if kind & 0xFF in SAMPLE_KINDS
    ]
    yield Balance(
        "samples_sent",
        sum(counter.numbered for counter in of_samples),
        {
            "received": sum(counter.received for counter in of_samples),
            **{
                f"lost_{cause.name.lower()}": sum(counter.lost_by[cause] for counter in of_samples)
                for cause in Cause
            },
        },
    )
    parts = {
        "received": sum(record.received for record in stream.modules.values()),
        "repeated": sum(record.duplicates for record in stream.modules.values()),
        "from_host": stream.echoed,
    }
    if stream.triggers is not None:
        parts["unexpected"] = stream.triggers.figures.unexpected
    yield Balance("packets_decoded", stream.decoded, parts)


def _readings(pipeline: Pipeline) -> Balance:
    assembler = pipeline.fused_assembler or pipeline.assembler
    parts = {"taken": assembler.taken}
    parts |= {reason.name.lower(): n for reason, n in assembler.lost.items() if reason in _OF_READINGS}
    parts |= {f"unused_{kind}": n for kind, n in pipeline.unused.items()}
    if pipeline.despiker is not None:
        parts["held_back"] = pipeline.despiker.held_back
    seen = 0 if pipeline.hips is None else pipeline.hips.readings
    return Balance("readings", pipeline.stream.readings + pipeline.satellite_readings + seen, parts)


def _frames(pipeline: Pipeline) -> Iterator[Balance]:
    assembler = pipeline.fused_assembler or pipeline.assembler
    if isinstance(assembler, FrameAssembler):
        skipped = assembler.lost[Lost.SKIPPED_INSTANT]
        yield Balance("instants", assembler.instants, {"frames": assembler.frames, "skipped": skipped})
    assembled = assembler.frames + pipeline.marker_frames
    solved = {"reconstructed": pipeline.skeleton_frames, "left_out": pipeline.left_out}
    if pipeline.video is not None and pipeline.hips is None:
        assembled += pipeline.video.instants
        solved["settling"] = pipeline.video.settling
    yield Balance("frames", assembled, solved)


_OF_READINGS = frozenset(Lost) - {Lost.SKIPPED_INSTANT}
