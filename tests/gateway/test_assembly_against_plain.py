"""The compiled frame assembly against the one in plain Python, whatever arrives and however it does."""

from dataclasses import dataclass

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from gateway.frames import INERTIAL_SAMPLE
from gateway.stages.frame_assembler import AssemblyParams, FrameAssembler
from tests.gateway.plain_assembler import PlainAssembler

MS = 1_000_000
UNKNOWN = 99
ARRAYS = ("specific_force", "angular_rate", "magnetic_field", "status", "gap_ns")


@dataclass(frozen=True)
class Traffic:
    """What comes of a suit, and what goes wrong on the way."""

    n: int
    interval_ns: int
    steps: int
    batch: int
    """Samples in one chunk."""
    first_ns: int
    jitter_ns: int
    """By how much samples come later than at best."""
    lost: float
    """Share of all samples; likewise the next four."""
    duplicated: float
    unknown: float
    overtaken: float
    unread: float
    """Sensors that were not read."""
    silences: tuple[tuple[int, int, int], ...]
    """Module (-1: all), and from which step to which."""
    stalls: tuple[tuple[int, int], ...]
    """From which step to which nothing arrives, then all at once."""
    restarts: tuple[tuple[int, int, int], ...]
    """Module, step, and by how many ns its clock then jumps."""
    seed: int


params = st.builds(
    AssemblyParams,
    frame_interval_ns=st.sampled_from([1e6, 10e6, 10e6 / 3, 33_333_333.25, 200e6, 1.7e9]),
    max_wait_ns=st.sampled_from([0, MS, 20 * MS, 300 * MS]),
    max_gap_ns=st.sampled_from([0, 15 * MS, 50 * MS, 2000 * MS]),
    hold_ns=st.sampled_from([0, 30 * MS, 200 * MS, 1500 * MS]),
    start_wait_ns=st.sampled_from([0, 100 * MS, 1000 * MS]),
)
shares = st.sampled_from([0.0, 0.0, 0.02, 0.3])
steps = st.integers(0, 150)
modules = st.integers(0, 3)
traffic = st.builds(
    Traffic,
    n=st.integers(1, 4),
    interval_ns=st.sampled_from([MS, 10 * MS, 9_999_999]),
    steps=st.integers(1, 150),
    batch=st.sampled_from([1, 3, 17, 400]),
    first_ns=st.sampled_from([0, 5, 7_000_000_123]),
    jitter_ns=st.sampled_from([1, 3 * MS, 15 * MS]),
    lost=shares,
    duplicated=shares,
    unknown=shares,
    overtaken=shares,
    unread=shares,
    silences=st.lists(st.tuples(st.integers(-1, 3), steps, steps), max_size=3).map(tuple),
    stalls=st.lists(st.tuples(steps, steps), max_size=2).map(tuple),
    restarts=st.lists(st.tuples(modules, steps, st.sampled_from([-700 * MS, 3, 2500 * MS])), max_size=2).map(
        tuple
    ),
    seed=st.integers(0, 2**32 - 1),
)


def chunks_of(coming):
    """Samples and when they arrived, chunk by chunk."""
    rng = np.random.default_rng(coming.seed)
    samples, arrivals = [], []
    for step in range(coming.steps):
        for module in range(coming.n):
            if rng.random() < coming.lost or is_silent(coming, module, step):
                continue
            sample = sample_of(coming, module, step, rng)
            for _ in range(2 if rng.random() < coming.duplicated else 1):
                samples.append(sample)
                arrivals.append(arrival_ns(coming, step) + int(rng.integers(coming.jitter_ns)))
    arrivals = np.maximum.accumulate(np.array([0, *arrivals], np.int64))[1:].tolist()
    order = np.arange(len(samples), dtype=float)
    order += np.where(rng.random(len(samples)) < coming.overtaken, rng.integers(0, 90, len(samples)), 0)
    rows = np.argsort(order, kind="stable")
    ordered = np.concatenate([np.zeros(0, INERTIAL_SAMPLE), *samples])[rows]
    for begin in range(0, len(ordered), coming.batch):
        yield ordered[begin : begin + coming.batch], arrivals[min(begin + coming.batch, len(ordered)) - 1]


def is_silent(coming, module, step):
    return any(who in {-1, module} and begin <= step < end for who, begin, end in coming.silences)


def arrival_ns(coming, step):
    for begin, end in coming.stalls:
        if begin <= step < end:
            step = end
    return coming.first_ns + step * coming.interval_ns


def sample_of(coming, module, step, rng):
    sample = np.zeros(1, INERTIAL_SAMPLE)
    jump = sum(by for who, at, by in coming.restarts if who == module and step >= at)
    sample["module"] = UNKNOWN if rng.random() < coming.unknown else 10 + module
    sample["sequence"] = step
    sample["time_ns"] = coming.first_ns + step * coming.interval_ns + module * 137 + jump
    sample["measured"] = rng.normal(size=(3, 3))
    sample["measured"][0, rng.random(3) < coming.unread] = np.nan
    sample["clipped"] = rng.choice([0, 0, 0, 1, 2, 3])
    return sample


def assert_same(made, expected):
    assert [f.sequence for f in made] == [f.sequence for f in expected]
    assert [f.time_ns for f in made] == [f.time_ns for f in expected]
    for one, other in zip(made, expected, strict=True):
        for name in ARRAYS:
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name), name, strict=True)
        assert (one.clipped is None) == (other.clipped is None)
        if other.clipped is not None:
            np.testing.assert_array_equal(one.clipped, other.clipped, strict=True)


@settings(max_examples=150)
@given(params, traffic)
def test_frames_and_counters_are_those_of_the_plain_assembler(params, traffic):
    ids = tuple(10 + module for module in range(traffic.n))
    compiled, plain = FrameAssembler(ids, params), PlainAssembler(ids, params)
    for samples, arrived_ns in chunks_of(traffic):
        assert_same(compiled.add(samples, arrived_ns), plain.add(samples, arrived_ns))
        assert compiled.lost == +plain.lost
        assert compiled.late == plain.late
        assert (compiled.taken, compiled.frames, compiled.instants) == (
            plain.taken,
            plain.frames,
            plain.instants,
        )


def test_more_frames_than_a_block_holds_come_of_one_sample():
    """After a pause a sample completes hundreds of instants: the kernel is called again for each block."""
    ids, params = (10,), AssemblyParams(MS, 0, 2000 * MS, 1000 * MS)
    compiled, plain = FrameAssembler(ids, params), PlainAssembler(ids, params)
    samples = np.zeros(3, INERTIAL_SAMPLE)
    samples["module"], samples["sequence"] = 10, [0, 1, 2]
    samples["time_ns"], samples["measured"] = [0, 700 * MS, 701 * MS], 1.0
    made = compiled.add(samples, 0)
    assert_same(made, plain.add(samples, 0))
    assert len(made) == 702


def test_a_queue_of_arrivals_grows_when_a_frame_waits_for_long():
    """Every sample in a chunk of its own, while a module is awaited that never speaks again."""
    ids, params = (10, 11), AssemblyParams(10e6, 900 * MS, 50 * MS, 900 * MS)
    compiled, plain = FrameAssembler(ids, params), PlainAssembler(ids, params)
    samples = np.zeros(1, INERTIAL_SAMPLE)
    for k in range(2500):
        samples["module"], samples["sequence"], samples["time_ns"] = 11 if k == 0 else 10, k, k * MS
        assert_same(compiled.add(samples, k * MS), plain.add(samples, k * MS))
    assert compiled.frames > 100
