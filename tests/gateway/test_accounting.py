"""Nothing goes astray: balances under random faults, and against the suit's own count of what it sent."""

from __future__ import annotations

from collections import Counter

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from devices.emulators import IDEAL, Encoding, SuitSettings, bench_suit
from devices.emulators.faults.fault_plan import FaultPlan
from devices.emulators.faults.faulty_suit import FaultySuit
from devices.link import Chunk, Framing
from firmware_protocol import InertialSample
from gateway.body.rig import load_rig
from gateway.contract.balances import unaccounted
from gateway.contract.messages import OutputCounters
from gateway.pipeline import Pipeline
from gateway.service.accounting import balances_of
from gateway.sources.clock_mode import ClockMode
from gateway.sources.despiking import Despiker
from gateway.stages.frame_assembler import AssemblyParams

N_MODULES, STEP_S, LINK = 3, 0.02, "suit"
PARAMS = AssemblyParams(
    1e7, max_wait_ns=50_000_000, max_gap_ns=50_000_000, hold_ns=200_000_000, start_wait_ns=100_000_000
)

shares = st.floats(0.01, 0.6)
starts = st.floats(0.0, 1.2)
lengths = st.floats(0.05, 0.6)
modules = st.integers(1, N_MODULES)


def _fault(kind: str, **fields: st.SearchStrategy) -> st.SearchStrategy:
    return st.fixed_dictionaries({"kind": st.just(kind), "at": starts, "lasts": lengths, **fields})


FAULTS = st.one_of(
    _fault("bit_errors", share=shares),
    _fault("loss", share=shares),
    _fault("duplication", share=shares),
    _fault("reordering", share=shares, delay=st.floats(0.005, 0.3)),
    _fault("burst"),
    _fault("stall"),
    _fault("slow_drip", bytes_per_s=st.floats(200, 20_000)),
    _fault("noise", bytes_per_s=st.floats(100, 20_000)),
    _fault("reset", module=modules),
    _fault("clock_jump", module=modules, by=st.floats(-20, 20)),
    _fault("saturated", module=modules),
    _fault("id_conflict", module=modules, takes=modules),
)
PLANS = st.builds(
    lambda seed, faults: FaultPlan.model_validate({"seed": seed, "faults": faults}),
    st.integers(0, 1000),
    st.lists(FAULTS, max_size=5),
)


def faulty(plan: FaultPlan, framing: Framing, has_relay: bool = False) -> FaultySuit:
    suit = SuitSettings(encoding=Encoding(framing), has_relay=has_relay)
    return FaultySuit(bench_suit(N_MODULES, 1, is_fresh=False, settings=suit, imperfections=IDEAL), plan)


def pipeline(framing: Framing, despiker: Despiker | None = None) -> Pipeline:
    made = Pipeline(load_rig("chain_5"), PARAMS, "independent", ClockMode.ESTIMATED, despiker=despiker)
    made.add_link(LINK, framing)
    return made


def fed(suit: FaultySuit, gateway: Pipeline, seconds: float) -> None:
    """Chunks as they come, a step at a time; balances are looked at after each."""
    steps = round(seconds / STEP_S)
    for step in range(1, steps + 2):
        sent = suit.advance(step * STEP_S) if step <= steps else suit.rest()
        if sent:
            data = b"".join(transmission.data for transmission in sent)
            gateway.feed(Chunk(data, round(step * STEP_S * 1e9), LINK))
        assert unaccounted(balances_of(gateway)) == {}


@settings(max_examples=25, deadline=None, suppress_health_check=list(HealthCheck))
@given(PLANS, st.sampled_from([Framing.BYTE_STREAM, Framing.CAN]), st.booleans(), st.booleans())
def test_random_faults_leave_nothing_unaccounted_for(plan, framing, despikes, relays):
    relays = relays and framing is Framing.BYTE_STREAM
    gateway = pipeline(framing, Despiker() if despikes else None)
    fed(faulty(plan, framing, relays), gateway, 1.6)


def by_name(gateway: Pipeline) -> dict[str, Counter[str]]:
    return {b.name: Counter(b.parts) + Counter(total=b.total) for b in balances_of(gateway)}


@pytest.mark.parametrize("kind", ["loss", "bit_errors", "duplication", "stall"])
def test_the_gateways_count_of_losses_is_the_suits_own(kind):
    """What the link destroyed, as the injector counts it, is what the gateway finds missing."""
    share = {} if kind == "stall" else {"share": 0.2}
    plan = FaultPlan.model_validate({"faults": [{"kind": kind, "at": 0.5, "lasts": 1.0, **share}]})
    suit, gateway = faulty(plan, Framing.BYTE_STREAM), pipeline(Framing.BYTE_STREAM)
    fed(suit, gateway, 2.0)
    befallen, records = suit.link.counts[kind], gateway.stream.modules.values()
    assert befallen > 10
    samples = [record.sequences[InertialSample.KIND] for record in records]
    sent = sum(sender.sequences[InertialSample.KIND] for sender in suit.traffic.senders.values())
    assert sum(counter.received + counter.lost for counter in samples) == sent
    lost, repeated = sum(record.lost for record in records), sum(record.duplicates for record in records)
    if kind == "duplication":
        assert (lost, repeated) == (0, befallen)
    elif kind == "bit_errors":
        damaged = sum(gateway.dropped()[LINK].values())
        # A bit of a delimiter joins two wire frames into one bad one.
        assert befallen <= lost <= 2 * befallen
        assert damaged >= befallen * 0.9
    else:
        # A report that is sent once a second, or in five, has no follower yet by which it would be missed.
        assert befallen - 2 * N_MODULES <= lost <= befallen
        assert repeated == 0


def test_samples_alone_are_counted_by_their_numbers():
    suit, gateway = faulty(FaultPlan(), Framing.BYTE_STREAM), pipeline(Framing.BYTE_STREAM)
    fed(suit, gateway, 1.0)
    sent = sum(sender.sequences[InertialSample.KIND] for sender in suit.traffic.senders.values())
    assert by_name(gateway)["samples_sent"] == Counter(total=sent, received=sent)
    assert by_name(gateway)["readings"]["total"] == sent


def test_restart_is_no_gap_and_what_was_sent_before_it_stays_counted():
    plan = FaultPlan.model_validate({"faults": [{"kind": "reset", "at": 2.5, "lasts": 0.3, "module": 2}]})
    suit, gateway = faulty(plan, Framing.BYTE_STREAM), pipeline(Framing.BYTE_STREAM)
    fed(suit, gateway, 4.0)
    assert gateway.modules.restarts()[2] == 1
    assert sum(module.lost for module in gateway.stream.modules.values()) == 0
    received = sum(module.received for module in gateway.stream.modules.values())
    assert received == suit.traffic.counts["sent"]


def test_a_pose_that_an_output_loses_shows():
    gateway = pipeline(Framing.BYTE_STREAM)
    fed(faulty(FaultPlan(), Framing.BYTE_STREAM), gateway, 1.0)
    poses = gateway.skeleton_frames
    assert poses > 50
    fair = OutputCounters(published=poses - 3, dropped=2, thinned=1, queued=0, connections=1)
    assert unaccounted(balances_of(gateway, {"mqtt": fair})) == {}
    short = fair.model_copy(update={"dropped": 1})
    assert unaccounted(balances_of(gateway, {"mqtt": short})) == {"output_mqtt": 1}
