"""The module that was shaken is found, among others that move too."""

from __future__ import annotations

import math
import random

import pytest

from firmware_protocol import InertialSample
from firmware_protocol.messages import Event
from gateway.modules.motion import Motion, MotionDetector

RATE = 100.0


def still(_t):
    return 0.0


def walking(t):
    return 6.0 * math.sin(2 * math.pi * 2 * t) ** 3


def shaken(start_s, duration_s=1.5, peak=15.0, base=still):
    def force(t):
        inside = start_s <= t < start_s + duration_s
        return base(t) + inside * peak * math.sin(2 * math.pi * 4 * (t - start_s))

    return force


def tapped(start_s, base=still):
    def force(t):
        ringing = 40.0 * math.exp(-(t - start_s) / 0.03) * math.cos(2 * math.pi * 40 * (t - start_s))
        return base(t) + (ringing if start_s <= t < start_s + 0.25 else 0.0)

    return force


class Run:
    """Feeds a detector with modules whose specific force along x is given as a function of time."""

    def __init__(self, **forces):
        self.detector = MotionDetector()
        self.now_s = 0.0
        self._forces = {int(name[1:]): force for name, force in forces.items()}
        self._noise = random.Random(1)

    def until(self, end_s):
        """The first decision before ``end_s``, and when it fell."""
        while self.now_s < end_s:
            self.now_s += 1 / RATE
            for module, force in self._forces.items():
                reading = (force(self.now_s) + self._noise.gauss(0, 0.05), 0.0, 9.81)
                self.detector.take_sample(module, InertialSample(specific_force=reading), self.now_s)
            decision = self.detector.decide(self.now_s)
            if decision is not None:
                return decision, self.now_s
        return None, end_s


@pytest.mark.parametrize("sign", [shaken, tapped])
@pytest.mark.parametrize("others", [still, walking])
def test_the_one_that_is_shaken_or_tapped_is_found_within_a_second(sign, others):
    base = others if sign is shaken else still
    run = Run(m1=others, m2=sign(4.0, base=base), m3=others)
    decision, at_s = run.until(8.0)
    assert decision == Motion(2, "motion")
    assert 4.0 < at_s < 5.0


@pytest.mark.parametrize("motion", [still, walking])
def test_nothing_is_found_where_nothing_is_meant(motion):
    run = Run(m1=motion, m2=motion)
    assert run.until(20.0) == (None, 20.0)


def test_two_at_once_are_named():
    run = Run(m1=shaken(4.0), m2=shaken(4.1), m3=still)
    assert run.until(8.0)[0] == (1, 2)


def test_one_that_is_still_being_shaken_is_not_taken_for_the_next():
    run = Run(m1=shaken(4.0, duration_s=3.0), m2=shaken(9.0), m3=still)
    assert run.until(12.0)[0] == Motion(1, "motion")
    decision, at_s = run.until(12.0)
    assert decision == Motion(2, "motion")
    assert at_s > 9.0


def test_the_same_one_can_be_shaken_again():
    twice = shaken(9.0, base=shaken(4.0))
    run = Run(m1=twice, m2=still)
    assert run.until(12.0)[0] == Motion(1, "motion")
    decision, at_s = run.until(12.0)
    assert decision == Motion(1, "motion")
    assert at_s > 9.0


def test_what_a_module_says_itself_is_believed():
    run = Run(m1=still, m2=walking)
    run.until(3.0)
    run.detector.take_event(1, Event(2), run.now_s)
    assert run.until(4.0)[0] == Motion(1, "tap")


def test_two_that_say_so_are_named_and_other_events_mean_nothing():
    run = Run(m1=still, m2=still)
    run.until(3.0)
    run.detector.take_event(1, Event(5), run.now_s)
    assert run.until(4.0)[0] is None
    run.detector.take_event(1, Event(4), run.now_s)
    run.detector.take_event(2, Event(2), run.now_s)
    assert run.until(5.0)[0] == (1, 2)


def test_what_moved_before_the_question_does_not_count():
    run = Run(m1=shaken(4.0, duration_s=0.4), m2=still)
    run.until(4.3)
    run.detector.begin_anew()
    assert run.until(8.0)[0] is None


def test_a_tap_is_believed_also_of_one_that_moves_more_than_it_used_to():
    def restless(t):
        return walking(t) * (1.7 if t > 3.5 else 1.0)

    run = Run(m1=restless, m2=still)
    assert run.until(4.0)[0] is None
    run.detector.begin_anew()
    run.detector.take_event(1, Event(2), run.now_s)
    assert run.until(5.0)[0] == Motion(1, "tap")
