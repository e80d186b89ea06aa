"""Mode 2: triggers on the gateway's own timer."""

import pytest

from gateway.clocks import TriggerTimer

MS = 1_000_000


def timer(interval_ns=10 * MS):
    triggers = TriggerTimer(interval_ns)
    triggers.start(1000 * MS)
    return triggers


def test_numbers_come_on_the_grid_and_never_drift():
    triggers = timer(interval_ns=1e9 / 3)
    taken = []
    for _ in range(10):
        now = triggers.next_ns
        assert triggers.due(now - 1) is None
        trigger = triggers.due(now)
        triggers.sent(trigger, now + 1000)
        taken.append(trigger)
    assert [trigger.number for trigger in taken] == list(range(10))
    assert taken[9].planned_ns == 1000 * MS + 3_000_000_000
    assert triggers.figures.jitter_rms_us == pytest.approx(1.0)


def test_times_gone_by_are_skipped_and_counted_but_no_number_is():
    triggers = timer()
    assert triggers.due(1000 * MS) == (0, 1000 * MS)
    late = triggers.due(1045 * MS)
    assert late == (1, 1040 * MS)
    triggers.sent(late, 1045 * MS)
    assert triggers.figures.summary() == {
        "sent": 1,
        "unsent": 0,
        "skipped": 3,
        "jitter_rms_us": 5000.0,
        "worst_jitter_us": 5000.0,
    }
    assert triggers.next_ns == 1050 * MS


def test_numbers_wrap():
    triggers = timer()
    numbers = [triggers.due(triggers.next_ns).number for _ in range(65_540)]
    assert numbers[65_534:] == [65_534, 65_535, 0, 1, 2, 3]


def test_an_interval_that_is_none_is_refused():
    with pytest.raises(ValueError, match="positive"):
        TriggerTimer(0)
