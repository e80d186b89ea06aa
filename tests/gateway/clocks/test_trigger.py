"""Mode 2: triggers on the gateway's own timer, answers by number."""

import pytest

from gateway.clocks import TriggerScheduler

MS = 1_000_000


def scheduler(interval_ns=10 * MS):
    triggers = TriggerScheduler((1, 2), interval_ns, patience_ns=25 * MS)
    triggers.start(1000 * MS)
    return triggers


def test_numbers_come_on_the_grid_and_never_drift():
    triggers = scheduler(interval_ns=1e9 / 3)
    times = []
    for _ in range(10):
        now = triggers.next_ns
        assert triggers.due(now - 1) is None
        number = triggers.due(now)
        triggers.sent(number, now + 1000)
        times.append((number, now))
    assert [number for number, _ in times] == list(range(10))
    assert times[9][1] == 1000 * MS + 3_000_000_000
    assert triggers.figures.jitter_rms_us == pytest.approx(1.0)


def test_answers_get_the_instant_of_their_trigger_whenever_they_come():
    triggers = scheduler()
    for k in range(2):
        now = 1000 * MS + 10 * k * MS + 50_000
        triggers.sent(triggers.due(now), now)
    assert triggers.answered(1, 1, 1012 * MS) == 1010 * MS + 50_000
    assert triggers.answered(1, 0, 1013 * MS) == 1000 * MS + 50_000
    assert triggers.answered(1, 0, 1014 * MS) is None  # a second time
    assert triggers.answered(2, 7, 1014 * MS) is None  # never sent
    assert triggers.figures.unexpected == 2
    triggers.expire(1100 * MS)
    assert triggers.figures.missed == {2: 2}
    assert triggers.figures.answered == {1: 2}
    assert triggers.answered(2, 1, 1101 * MS) is None  # too late


def test_times_gone_by_are_skipped_and_counted():
    triggers = scheduler()
    assert triggers.due(1035 * MS) == 3
    triggers.sent(3, 1035 * MS)
    assert triggers.figures.skipped == 3
    assert triggers.next_ns == 1040 * MS
    assert triggers.figures.worst_jitter_us == 5000
    assert triggers.figures.summary()["skipped"] == 3


def test_numbers_wrap():
    triggers = scheduler()
    for k in range(65_540):
        now = 1000 * MS + 10 * k * MS
        number = triggers.due(now)
        assert number == k % 65_536
        triggers.sent(number, now)
        assert triggers.answered(1, number, now + MS) == now
        assert triggers.answered(2, number, now + MS) == now
    assert not triggers.figures.missed


def test_an_ambiguous_setting_is_refused():
    with pytest.raises(ValueError, match="outstanding"):
        TriggerScheduler((1,), 1000, patience_ns=10**9)
