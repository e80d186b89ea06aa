"""What gives way to too much load, on a simulated machine, and how it comes back."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.service import overload
from gateway.service.overload import CALM_S_FIRST, CAUGHT_UP_S, LATE_S, LATE_TICKS, SHED, TICK_S, LoadWatch

CHUNK_S = 0.01


class Machine:
    """Takes ``costs[stage]`` of a second's time for a second's data; what is too much waits."""

    def __init__(self, costs):
        self.watch, self.now_s, self.lag_s, self.costs = LoadWatch(), 1000.0, 0.0, costs
        self.history = []

    def run(self, seconds):
        for _ in range(round(seconds / CHUNK_S)):
            self.now_s += CHUNK_S
            self.lag_s = max(0.0, self.lag_s + (self.costs[self.watch.stage] - 1.0) * CHUNK_S)
            if self.watch.observe("suit", self.lag_s + 0.001, self.now_s):
                self.history.append((self.now_s, self.watch.stage))
        return self.watch.stage


def costs(*each):
    return (*each, *[each[-1]] * (len(SHED) - len(each)))


def test_a_machine_that_keeps_up_gives_nothing_up():
    machine = Machine(costs(0.95))
    assert machine.run(600) == 0
    assert machine.history == []


@pytest.mark.parametrize("enough", range(1, len(SHED)))
def test_it_stops_at_the_first_stage_that_is_enough(enough):
    machine = Machine(costs(*[1.5] * enough, 0.3))
    while machine.watch.stage < enough:
        machine.run(CHUNK_S)
    assert [stage for _, stage in machine.history] == list(range(1, enough + 1))
    machine.run(CAUGHT_UP_S)
    assert machine.watch.stage == enough
    assert machine.watch.statistics()["shed"] == [stage.name for stage in SHED[1 : enough + 1]]


def test_a_hiccup_is_no_overload():
    machine = Machine(costs(0.1))
    for _ in range(20):
        machine.lag_s = 0.4  # compiled code, a suspended host: gone in less than half a second
        machine.run(3.0)
    assert machine.history == []


def test_a_backlog_that_only_drains_slowly_takes_no_more_than_it_must():
    machine = Machine(costs(0.9))
    machine.lag_s = 5.0
    machine.run(200)
    assert machine.watch.stage == 0
    assert machine.lag_s == 0.0


@pytest.mark.parametrize("backlog_s", [0.5, 3.0, 60.0])
def test_after_a_burst_all_comes_back_within_a_second_of_catching_up(backlog_s):
    """What piled up while the process was stopped comes faster than it can be handled, for a while."""
    machine = Machine(costs(2.0))
    while machine.watch.stage < len(SHED) - 1:
        machine.run(CHUNK_S)
    machine.lag_s, machine.costs = max(machine.lag_s, backlog_s), costs(0.3)
    while machine.lag_s > 0.0:
        machine.run(CHUNK_S)
    machine.run(1.0)
    assert machine.watch.stage == 0
    machine.run(60.0)
    assert machine.watch.stage == 0


def test_a_load_that_lasts_is_back_at_its_stage_at_once_when_all_was_given_back():
    machine = Machine(costs(2.0, 2.0, 2.0, 2.0, 0.5))
    while len(machine.history) < 6:
        machine.run(CHUNK_S)
    assert [stage for _, stage in machine.history] == [1, 2, 3, 4, 0, 4]
    given_back_s, taken_s = machine.history[-2][0], machine.history[-1][0]
    assert taken_s - given_back_s <= LATE_TICKS * TICK_S + 2 * TICK_S
    machine.history.clear()
    machine.run(CALM_S_FIRST - 1.0)
    assert machine.history == []


def test_everything_comes_back_stage_by_stage_when_a_load_that_lasted_is_gone():
    machine = Machine(costs(2.0, 2.0, 2.0, 2.0, 0.5))
    machine.run(10)
    top = machine.watch.stage
    machine.costs = costs(0.3)
    machine.history.clear()
    machine.run(CALM_S_FIRST * (top + 3) + 10)
    assert [stage for _, stage in machine.history] == list(reversed(range(top)))
    gaps = [
        after - before for (before, _), (after, _) in zip(machine.history, machine.history[1:], strict=False)
    ]
    assert min(gaps) >= CALM_S_FIRST - TICK_S


def test_it_does_not_swing_between_two_stages():
    machine = Machine(costs(1.3, 0.5))
    machine.run(1200)
    in_ten_minutes = [at for at, _ in machine.history if at > machine.now_s - 600]
    assert len(in_ten_minutes) <= 2 * 600 / overload.CALM_S_LONGEST + 2
    spent_late = machine.watch.worst_s
    assert spent_late < 2.0


def test_recovers_also_when_nothing_comes_any_more():
    machine = Machine(costs(2.0, 0.9))
    machine.run(3)
    assert machine.watch.stage >= 1
    for _ in range(1000):
        machine.now_s += TICK_S
        machine.watch.look(machine.now_s)
    assert machine.watch.stage == 0


def test_one_link_that_keeps_up_does_not_hide_one_that_does_not():
    watch, now_s = LoadWatch(), 0.0
    for k in range(200):
        now_s += CHUNK_S
        watch.observe("quiet", 0.001, now_s)
        watch.observe("loaded", 0.001 * k + LATE_S, now_s + 0.001)
    assert watch.stage >= 1


@given(st.lists(st.tuples(st.floats(0, 3), st.floats(0, 2)), max_size=300))
def test_whatever_comes_nothing_is_taken_or_given_back_faster_than_said(steps):
    watch, now_s, before, changed_s = LoadWatch(), 0.0, 0, -1e9
    for lag_s, wait_s in steps:
        now_s += wait_s
        has_changed = watch.observe("suit", lag_s, now_s)
        assert has_changed == (watch.stage != before)
        assert 0 <= watch.stage < len(SHED)
        if has_changed:
            if watch.stage < before:
                least_s = CAUGHT_UP_S if watch.stage == 0 else CALM_S_FIRST
            else:
                least_s = TICK_S * LATE_TICKS
            assert now_s - changed_s >= least_s - 1e-9
            before, changed_s = watch.stage, now_s
