"""Gateway time against a host's UTC that is set while the gateway runs."""

from hypothesis import given
from hypothesis import strategies as st

from gateway.clocks import AnchorWatch

HOUR_NS = 3600 * 10**9
SECOND_NS = 10**9


def test_a_step_of_an_hour_is_seen_with_its_size_and_moment():
    watch = AnchorWatch()
    assert [watch.observe(t * SECOND_NS, t * SECOND_NS + 77) for t in range(5)] == [False] * 5
    assert watch.observe(5 * SECOND_NS, 5 * SECOND_NS + 77 + HOUR_NS)
    assert not watch.observe(6 * SECOND_NS, 6 * SECOND_NS + 77 + HOUR_NS)
    reading = watch.newest
    assert (reading.offset_ns, reading.steps) == (77 + HOUR_NS, 1)
    assert (reading.last_step_ns, reading.last_step_gateway_ns) == (HOUR_NS, 5 * SECOND_NS)


@given(st.lists(st.integers(-900_000, 900_000), min_size=1, max_size=50))
def test_the_jitter_of_reading_two_clocks_is_no_step_and_does_not_add_up(jitter_ns):
    watch = AnchorWatch()
    watch.observe(0, 0)
    for n, late_ns in enumerate(jitter_ns, start=1):
        assert not watch.observe(n * SECOND_NS, n * SECOND_NS + late_ns)
    assert watch.newest.offset_ns == 0
    assert watch.newest.steps == 0


@given(st.lists(st.integers(-(10**13), 10**13).filter(lambda n: abs(n) >= 10**6), max_size=20))
def test_steps_add_up_to_the_offset(steps_ns):
    watch = AnchorWatch()
    watch.observe(0, 0)
    total_ns = 0
    for n, step_ns in enumerate(steps_ns, start=1):
        total_ns += step_ns
        assert watch.observe(n * SECOND_NS, n * SECOND_NS + total_ns)
    assert watch.newest.offset_ns == total_ns
    assert watch.newest.steps == len(steps_ns)
