"""Sequence accounting: losses, duplicates, overtaking, wrap, restart."""

import random
import sys

from hypothesis import given
from hypothesis import strategies as st

from gateway.clocks import EstimatedClock
from gateway.sources.statistics import Cause, LinkLosses, ModuleRecord, SequenceCounter

LINK = LinkLosses()


@given(st.integers(0, 65535), st.sets(st.integers(1, 399), max_size=60))
def test_every_lost_packet_is_counted_across_the_wrap(first, lost):
    counter = SequenceCounter()
    arrived = [k for k in range(401) if k not in lost]
    unwrapped = [counter.count((first + k) % 65536, LINK) for k in arrived]
    assert [full - unwrapped[0] for full in unwrapped] == arrived
    assert (counter.received, counter.lost, counter.duplicates) == (401 - len(lost), len(lost), 0)


def test_overtaken_packets_are_not_lost_and_duplicates_are_refused():
    counter = SequenceCounter()
    assert [counter.count(n, LINK) for n in (10, 11, 14, 12, 13, 13, 14, 15)] == [
        0,
        1,
        4,
        2,
        3,
        None,
        None,
        5,
    ]
    assert (counter.received, counter.lost, counter.duplicates) == (6, 0, 2)


def test_after_a_restart_the_count_goes_on():
    counter = SequenceCounter()
    for n in (500, 501, 502):
        counter.count(n, LINK)
    counter.restart()
    assert [counter.count(n, LINK) for n in (0, 1, 3)] == [3, 4, 6]
    assert (counter.received, counter.lost) == (6, 1)


def test_gaps_are_counted_by_length_and_shrink_when_packets_come_after_all():
    record = ModuleRecord(3, EstimatedClock())
    counter = record.sequences[0x10] = SequenceCounter()
    for n in (0, 2, 3, 10, 20, 60):
        counter.count(n, LINK)
    assert record.gap_histogram == {"1": 1, "5-8": 1, "9-16": 1, "33-64": 1}
    counter.count(1, LINK)
    counter.count(6, LINK)  # 4, 5 and 7, 8, 9 are still missing
    assert record.gap_histogram == {"2": 1, "3-4": 1, "9-16": 1, "33-64": 1}
    assert record.lost == 2 + 3 + 9 + 39
    assert record.summary()["gaps"] == record.gap_histogram


def test_a_gap_is_put_down_to_what_happened_on_the_link_in_between():
    link, counter = LinkLosses(), SequenceCounter()
    numbers = iter(range(0, 1000, 5))

    def chunk_with_a_gap(*noticed: Cause) -> None:
        for cause in noticed:
            link.notice(cause)
        link.chunk += 1
        counter.count(next(numbers), link)

    chunk_with_a_gap()
    chunk_with_a_gap()
    assert counter.lost_by == {Cause.UNSEEN: 4}
    chunk_with_a_gap(Cause.DAMAGED)
    chunk_with_a_gap()  # not again
    chunk_with_a_gap(Cause.OVERRUN, Cause.DAMAGED)
    chunk_with_a_gap(Cause.LINK_DOWN)
    assert counter.lost_by == {Cause.UNSEEN: 8, Cause.DAMAGED: 4, Cause.OVERRUN: 4, Cause.LINK_DOWN: 4}
    counter.count(23, link)  # one of the last gap comes after all
    assert counter.lost_by[Cause.LINK_DOWN] == 3
    assert counter.lost == 19


class LiteralCounter:
    """What ``SequenceCounter`` counts, as one would write it down: every missing number by itself."""

    def __init__(self):
        self.newest, self.received, self.duplicates, self.missing, self.known = -1, 0, 0, set(), []

    def take(self, full):
        if full > self.newest:
            new = list(range(self.newest + 1, full))
            self.missing.update(new)
            self.known = (self.known + new)[-256:]
            self.newest = full
        elif full in self.known:
            self.known.remove(full)
            self.missing.remove(full)
        else:
            self.duplicates += 1
            return None
        self.received += 1
        return full

    @property
    def runs(self):
        found, run = {}, 0
        for number in range(self.newest + 2):
            if number in self.missing:
                run += 1
            elif run:
                name = next(name for top, name in TOPS if run <= top)
                found[name], run = found.get(name, 0) + 1, 0
        return found


TOPS = [
    (1, "1"),
    (2, "2"),
    *((2 ** (k + 1), f"{2**k + 1}-{2 ** (k + 1)}") for k in range(1, 8)),
    (1e9, "more"),
]


@given(st.lists(st.integers(-400, 500), max_size=80))
def test_any_order_and_any_jumps_are_counted_as_written_down_one_by_one(steps):
    counter, literal, record = SequenceCounter(), LiteralCounter(), ModuleRecord(3, EstimatedClock())
    record.sequences[0x10] = counter
    number = 0
    for step in [0, *steps]:
        number = max(literal.newest + step, 0)
        assert counter.count(number, LINK) == literal.take(number)
    assert (counter.received, counter.duplicates) == (literal.received, literal.duplicates)
    assert counter.lost == len(literal.missing)
    assert sum(record.gap_histogram.values()) == sum(literal.runs.values())
    assert record.gap_histogram == literal.runs
    assert counter.numbered == counter.received + counter.lost


def work(numbers):
    """Function calls and lines that counting them takes: unlike time the same on every machine."""
    counter, steps = SequenceCounter(), 0

    def trace(_frame, _event, _argument):
        nonlocal steps
        steps += 1
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        for number in numbers:
            counter.count(number, LINK)
    finally:
        sys.settrace(before)
    return steps


def test_a_packet_costs_the_same_however_its_number_jumps():
    draw = random.Random(1)
    in_order = work(range(2000))
    assert work(draw.randrange(65536) for _ in range(2000)) < 8 * in_order
    assert work(k * 20_000 % 65536 for k in range(2000)) < 8 * in_order
