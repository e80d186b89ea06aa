"""Where everything went: balances that must come out even, from counters that know nothing of each other.

    sent by the modules (their numbers)  =  received + lost, by what happened on the link meanwhile
    bytes that a link took               =  handed to the decoder + dropped for a slow reader + waiting
    packets out of the decoders          =  new ones + repeated + our own echoed + answers nobody awaited
    readings out of the sources          =  taken for frames + each kind of drop + held back by the despiker
    instants of the grid                 =  frames + instants left out in silence
    frames assembled                     =  poses reconstructed + left out in overload
                                            + instants of cameras before the first smoothed pose
    poses offered to an output           =  published + dropped + thinned + queued + kept to be sent later
    chunks handed to the recorder        =  written + lost + waiting for the disk

Every part of the pipeline gives its share, and all of it belongs to one event loop: between two chunks
every balance is even. What is left over is a defect of the gateway, never of the suit. What a module sent
after its last packet that was heard and before it lost its power nobody can know; nor what it sent before its
first one.
"""

from __future__ import annotations

from collections.abc import Mapping

from devices.links.link_counts import LinkCounts
from gateway.contract.balances import Balance
from gateway.contract.messages import OutputCounters
from gateway.pipeline import Pipeline
from gateway.recording.recorder import RecorderBalance


def balances_of(
    pipeline: Pipeline,
    outputs: Mapping[str, OutputCounters] | None = None,
    recording: RecorderBalance | None = None,
    links: Mapping[str, LinkCounts] | None = None,
) -> list[Balance]:
    """Return all balances of a pipeline, its outputs and links (by name) and the recording, if there is
    one."""
    # Every balance has the same form: a total, and parts that must add up to it.
    balances = pipeline.balances()
    for name, counters in (outputs or {}).items():
        parts = {
            part: getattr(counters, part) for part in ("published", "dropped", "thinned", "queued", "late")
        }
        balances.append(Balance(f"output_{name}", pipeline.skeleton_frames, parts))
    for name, counts in (links or {}).items():
        parts = {"handed": counts.handed, "behind": counts.behind, "waiting": counts.waiting}
        balances.append(Balance(f"link_{name}_bytes", counts.taken, parts))
    if recording is not None:
        parts = {"written": recording.written, "lost": recording.lost, "waiting": recording.waiting}
        balances.append(Balance("recorded_chunks", recording.handed, parts))
    return balances
