"""Samples with stamps and no numbers are numbered by their interval."""

from hypothesis import given
from hypothesis import strategies as st

from gateway.sources.makers import StampCounter

PERIOD_US = 10_000


@given(st.sets(st.integers(10, 400), max_size=20), st.data())
def test_lost_samples_leave_their_gaps(lost, data):
    """Whatever is lost, unless it is most; and however the timer trembles, by a tenth of the interval."""
    counter = StampCounter()
    given_numbers = [k for k in range(401) if k not in lost]
    found = []
    for k in given_numbers:
        tremble = data.draw(st.integers(-PERIOD_US // 10, PERIOD_US // 10)) if k % 40 == 7 else 0
        found.append(counter.number(k * PERIOD_US + tremble))
    assert found == given_numbers


def test_a_device_that_begins_anew_goes_on_counting():
    counter = StampCounter()
    first = [counter.number(10**9 + k * PERIOD_US) for k in range(20)]
    again = [counter.number(500 + k * PERIOD_US) for k in range(20)]
    assert first + again == list(range(40))
