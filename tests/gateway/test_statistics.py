"""Sequence accounting: losses, duplicates, overtaking, wrap, restart."""

from hypothesis import given
from hypothesis import strategies as st

from gateway.statistics import SequenceCounter


@given(st.integers(0, 65535), st.sets(st.integers(1, 399), max_size=60))
def test_every_lost_packet_is_counted_across_the_wrap(first, lost):
    counter = SequenceCounter()
    arrived = [k for k in range(401) if k not in lost]
    unwrapped = [counter.count((first + k) % 65536) for k in arrived]
    assert [full - unwrapped[0] for full in unwrapped] == arrived
    assert (counter.received, counter.lost, counter.duplicates) == (401 - len(lost), len(lost), 0)


def test_overtaken_packets_are_not_lost_and_duplicates_are_refused():
    counter = SequenceCounter()
    assert [counter.count(n) for n in (10, 11, 14, 12, 13, 13, 14, 15)] == [0, 1, 4, 2, 3, None, None, 5]
    assert (counter.received, counter.lost, counter.duplicates) == (6, 0, 2)


def test_after_a_restart_the_count_goes_on():
    counter = SequenceCounter()
    for n in (500, 501, 502):
        counter.count(n)
    counter.restart()
    assert [counter.count(n) for n in (0, 1, 3)] == [3, 4, 6]
    assert (counter.received, counter.lost) == (6, 1)
