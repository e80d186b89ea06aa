"""Unified control through the stream: wire bytes in, instants out, whatever the order of answers."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.link import Chunk, Framing, SentChunk
from firmware_protocol import (
    BROADCAST,
    FusedSample,
    Health,
    InertialSample,
    SamplingTrigger,
    encode_frame,
    wire_frame,
)
from gateway.clocks import TriggerAnswers
from gateway.sources.clock_mode import ClockMode
from gateway.sources.module_table import ModuleTable
from gateway.sources.suit import SuitSource

MS = 1_000_000
START_NS = 1_800_000_000_000_000_000


def new_stream(patience_ns=40 * MS):
    stream = SuitSource(ModuleTable(ClockMode.TRIGGER), TriggerAnswers((1, 2), patience_ns))
    for link in ("a", "b"):
        stream.add_link(link, Framing.BYTE_STREAM)
    return stream


def trigger(number, link, sent_ns):
    frame = wire_frame(SamplingTrigger(number), BROADCAST, number, 0)
    return SentChunk(encode_frame(frame), sent_ns, link)


def sample(module, sequence, link, arrived_ns, *, triggered=True, module_time_us=0):
    packet = InertialSample(angular_rate=(0.0, 0.0, 0.0), triggered=triggered)
    return Chunk(encode_frame(wire_frame(packet, module, sequence, module_time_us)), arrived_ns, link)


def test_a_module_that_samples_alone_then_follows():
    """Its own count and the triggers' are two counts: neither makes the other's samples duplicates."""
    stream = new_stream()
    for k in range(5):
        at = START_NS + 10 * k * MS
        assert stream.receive(sample(1, 5000 + k, "a", at, triggered=False, module_time_us=10_000 * k))
    readings = []
    for k in range(5, 10):
        at = START_NS + 10 * k * MS
        stream.sent(trigger(k, "a", at))
        readings += stream.receive(sample(1, k, "a", at + 3 * MS, module_time_us=10_000 * k))
    samples = np.concatenate([reading.samples for reading in readings])
    assert samples["time_ns"].tolist() == [START_NS + 10 * k * MS for k in range(5, 10)]
    assert np.diff(samples["sequence"]).tolist() == [1] * 4
    assert stream.modules[1].duplicates == stream.modules[1].lost == 0
    assert stream.triggers.figures.untriggered == {1: 5}


def test_what_fused_on_board_is_no_answer():
    stream = new_stream()
    fused = FusedSample((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0)
    stream.receive(Chunk(encode_frame(wire_frame(fused, 2, 0, 0)), START_NS, "a"))
    assert stream.triggers.figures.untriggered == {2: 1}


def test_a_restart_of_a_module_or_a_long_absence_of_a_link_loses_no_answer():
    stream = new_stream()
    stamps = [10_000_000 * 60, 10_000_000 * 60 + 10_000, 500, 10_500]  # it restarts in the middle
    numbers = [65_534, 65_535, 40_000, 40_001]  # and most triggers went out over the other link alone
    readings = []
    for k, (stamp, number) in enumerate(zip(stamps, numbers, strict=True)):
        at = START_NS + 10 * k * MS
        stream.sent(trigger(number, "a", at))
        readings += stream.receive(sample(1, number, "a", at + 2 * MS, module_time_us=stamp))
    times_ns = np.concatenate([reading.samples["time_ns"] for reading in readings])
    assert (times_ns - START_NS).tolist() == [0, 10 * MS, 20 * MS, 30 * MS]


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_every_reading_has_the_instant_of_its_trigger(data):
    """Two links, answers lost, late, overtaken, repeated; echoes; other packets between them."""
    events, sent_at = [], {}
    for k in range(data.draw(st.integers(1, 20))):
        for module, link in ((1, "a"), (2, "b")):
            at = START_NS + 10 * k * MS + data.draw(st.integers(0, 2 * MS))
            sent_at[module, k] = at
            events.append((at, 0, trigger(k, link, at)))
            delays = data.draw(st.lists(st.integers(1, 80 * MS), max_size=3))
            events += [(at + delay, 1, sample(module, k, link, at + delay)) for delay in delays]
            if data.draw(st.booleans()):
                echo = trigger(k, link, at)
                events.append((at + MS, 1, Chunk(echo.data, at + MS, link)))
    events.sort(key=lambda event: event[:2])
    streams = new_stream(), new_stream()
    seen = set()
    for _, _, event in events:
        of_both = []
        for stream in streams:
            if isinstance(event, SentChunk):
                stream.sent(event)
            else:
                of_both.append(stream.receive(event))
        if of_both:
            told = [repr([batch.samples.tolist() for batch in given]) for given in of_both]
            assert told[0] == told[1]  # the same inputs give the same readings
        for batch in of_both[0] if of_both else ():
            for row in batch.samples:
                name = int(row["module"]), int(row["sequence"])
                assert name not in seen
                seen.add(name)
                assert row["time_ns"] == sent_at[name]
    assert {(m, k) for m, k in seen} <= set(sent_at)


def test_health_is_no_sample():
    stream = new_stream()
    health = Health(None, None, None, None, 0, 0, 0, 0, 0)
    stream.receive(Chunk(encode_frame(wire_frame(health, 1, 0, 0)), START_NS, "a"))
    assert not stream.triggers.figures.untriggered
    stream.sent(trigger(0, "a", START_NS + MS))
    stream.sent(trigger(1, "a", START_NS + 60 * MS))
    assert stream.triggers.figures.missed == {1: 1}  # it is there, and does not answer
