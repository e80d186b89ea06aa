"""Faults by time: the same as asking every one of them."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from devices.emulators.faults.fault_plan import FaultPlan, FaultWindows, Stall

times = st.integers(0, 400).map(lambda tick: tick / 8)


@st.composite
def stalls(draw):
    lasts = (draw(times) + 0.125) / 8
    every = draw(st.none() | times.map(lambda s: lasts + 0.125 + s / 8))
    return Stall(kind="stall", at=draw(times), lasts=lasts, every=every)


@given(st.lists(stalls(), max_size=12), times, st.sampled_from([0.0, 0.125, 1.0]))
def test_those_that_last_are_those_that_say_so(faults, at_s, after_s):
    windows = FaultWindows(faults, after_s)
    assert windows.on(at_s) == [fault for fault in faults if fault.is_on(at_s)]
    once = [fault for fault in faults if fault.every is None]
    near = any(fault.at <= at_s <= fault.at + fault.lasts + after_s for fault in once)
    assert FaultWindows(once, after_s).near(at_s) == near


@given(st.lists(stalls(), max_size=12), times, times)
def test_those_that_begin_are_those_that_say_so(faults, one_s, other_s):
    from_s, to_s = sorted((one_s, other_s))
    expected = [(start_s, fault) for fault in faults for start_s in fault.starts(from_s, to_s)]
    assert list(FaultWindows(faults).starting(from_s, to_s)) == expected


def test_one_that_comes_again_is_near_after_each_time():
    windows = FaultWindows([Stall(kind="stall", at=1.0, lasts=1.0, every=10.0)], after_s=0.5)
    near = [windows.near(at_s) for at_s in (0.5, 1.0, 2.25, 2.75, 11.5, 12.25, 13.0)]
    assert near == [False, True, True, False, True, True, False]


@pytest.mark.parametrize(
    "fault", [{"kind": "loss", "share": 0.3}, {"kind": "noise"}, {"kind": "magnet", "module": 1}]
)
def test_one_that_would_never_happen_is_refused(fault):
    with pytest.raises(ValidationError, match="say how long it 'lasts', s"):
        FaultPlan.model_validate({"faults": [{**fault, "at": 3}]})


def test_one_that_happens_at_an_instant_need_not_last():
    plan = FaultPlan.model_validate({"faults": [{"kind": "reset", "module": 1, "at": 3}]})
    assert list(plan.faults[0].starts(0, 10)) == [3]
