"""Mode 2: which trigger a sample answers. A worked example, and any order of things by property."""

from hypothesis import given, settings
from hypothesis import strategies as st

from gateway.clocks import TriggerAnswers

MS = 1_000_000


def test_worked_example():
    """Modules 1 and 2 on link a, 3 on link b; triggers every 10 ms, answers taken for 25 ms."""
    answers = TriggerAnswers((1, 2, 3), 25 * MS)
    for module, link in ((1, "a"), (2, "a"), (3, "b"), (9, "a")):
        answers.note_link(module, link)
    answers.sent(0, "a", 1000 * MS + 50)
    answers.sent(0, "b", 1000 * MS + 90)  # the same trigger, a moment later on the other link
    assert answers.answered(1, 0, "a", 1003 * MS) == (0, 1000 * MS + 50)
    assert answers.answered(3, 0, "b", 1003 * MS) == (0, 1000 * MS + 90)
    answers.sent(1, "a", 1010 * MS)
    answers.sent(1, "b", 1010 * MS)
    assert answers.answered(1, 1, "a", 1012 * MS) == (1, 1010 * MS)
    assert answers.answered(2, 0, "a", 1013 * MS) == (0, 1000 * MS + 50)  # overtaken on its way
    assert answers.answered(2, 0, "a", 1014 * MS) == (0, 1000 * MS + 50)  # and once more
    assert answers.answered(2, 7, "a", 1014 * MS) is None  # never sent
    assert answers.answered(9, 1, "a", 1014 * MS) == (1, 1010 * MS)  # none of the rig's: not awaited
    answers.expire(1035 * MS + 1)
    assert answers.answered(2, 1, "a", 1036 * MS) is None  # too late
    assert answers.figures.summary() == {
        "answered": {"1": 2, "2": 1, "3": 1, "9": 1},
        "missed": {"2": 1, "3": 1},
        "repeated": 1,
        "unexpected": 2,
        "untriggered": {},
    }


def test_nothing_is_awaited_of_modules_that_are_away_or_sample_alone():
    answers = TriggerAnswers((1, 2, 3), 5 * MS)
    answers.note_link(1, "a")
    answers.note_link(2, "b")
    answers.sampled_alone(1)
    answers.sent(0, "a", 0)
    answers.expire(10 * MS)
    assert not answers.figures.missed
    answers.sent(1, "a", 10 * MS)
    assert answers.answered(1, 1, "a", 11 * MS) == (1, 10 * MS)  # it was set to follow
    answers.sent(2, "a", 20 * MS)
    answers.expire(30 * MS)
    assert answers.figures.missed == {1: 1}
    assert answers.figures.untriggered == {1: 1}


def test_numbers_wrap_and_a_link_may_have_been_away_for_long():
    answers = TriggerAnswers((1,), 25 * MS)
    answers.note_link(1, "a")
    numbers = [65_535, 0, 40_000, 10]  # 40000: more than half the range was sent over other links, or none
    full = []
    for k, number in enumerate(numbers):
        now = 10 * k * MS
        answers.sent(number, "a", now)
        full.append(answers.answered(1, number, "a", now + MS).full)
    assert full == [65_535, 65_536, 65_536 + 40_000, 2 * 65_536 + 10]


def test_an_answer_that_came_before_its_trigger_left_is_not_ours():
    answers = TriggerAnswers((1,), 25 * MS)
    answers.sent(5, "a", 1000 * MS)
    assert answers.answered(1, 5, "a", 999 * MS) is None
    assert answers.figures.unexpected == 1


@settings(max_examples=200, deadline=None)
@given(st.data())
def test_no_order_of_answers_gives_a_wrong_instant(data):
    """Every answer is lost, delayed, repeated at will: its instant is that of its own trigger or none."""
    interval, patience, links = 10 * MS, 30 * MS, ("a", "b")
    first = data.draw(st.integers(0, 2**16 - 1))
    happenings, truth = [], {}
    for k in range(data.draw(st.integers(1, 30))):
        for module, link in enumerate(links):
            sent_ns = k * interval + data.draw(st.integers(0, 3 * MS))
            number = (first + k) % 2**16
            truth[link, number] = sent_ns
            happenings.append((sent_ns, 0, link, module, number))
            delays = data.draw(st.lists(st.integers(1, 60 * MS), max_size=3))
            happenings += [(sent_ns + delay, 1, link, module, number) for delay in delays]
    answers, expected = TriggerAnswers((0, 1), patience), 0
    for module, link in enumerate(links):
        answers.note_link(module, link)
    by_instant = {}
    for at_ns, kind, link, module, number in sorted(happenings):
        if kind == 0:
            answers.sent(number, link, at_ns)
            continue
        answer = answers.answered(module, number, link, at_ns)
        is_in_time = at_ns - truth[link, number] <= patience
        assert (answer is not None) == is_in_time
        if answer is not None:
            expected += 1
            assert answer.sent_ns == truth[link, number]
            assert answer.full % 2**16 == number
            by_instant.setdefault(answer.full, set()).add(number)
    assert all(len(numbers) == 1 for numbers in by_instant.values())
    answers.expire(10**12)
    figures = answers.figures
    assert sum(figures.answered.values()) + figures.repeated == expected
    assert sum(figures.answered.values()) + sum(figures.missed.values()) == len(truth)
