"""Sequence accounting: losses, duplicates, overtaking, wrap, restart."""

from hypothesis import given
from hypothesis import strategies as st

from gateway.clocks import EstimatedClock
from gateway.losses import Cause, LinkLosses
from gateway.statistics import ModuleRecord, SequenceCounter

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
    assert record.lost == sum(length * count for length, count in counter.gaps.items())
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
