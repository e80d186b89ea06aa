"""Ids change hands without two devices ever sharing one, whatever is to become what."""

from __future__ import annotations

from collections import Counter

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from devices.commands.roster import plan_moves, spare_id


def uid(n):
    return bytes([n]) * 12


def carried_out(present, moves):
    """Ids after the moves, and the largest number of devices that shared one on the way."""
    held, most = dict(present), 1
    for move in moves:
        assert held[move.unique_id] == move.before
        held[move.unique_id] = move.after
        most = max(most, *Counter(held.values()).values())
    return held, most


@given(st.permutations(range(12)), st.integers(1, 12))
def test_any_exchange_is_reached_without_a_conflict(order, n):
    present = {uid(i): i for i in range(n)}
    wanted = dict(zip(present, [i for i in order if i < n], strict=True))
    held, most = carried_out(present, moves := plan_moves(present, wanted))
    assert held == wanted
    assert most == 1
    assert len(moves) <= 1.5 * n


@given(st.lists(st.integers(0, 8), min_size=1, max_size=8), st.randoms(use_true_random=False))
def test_conflicts_are_solved_and_none_is_added(ids, random):
    present = {uid(i): module for i, module in enumerate(ids)}
    wanted = dict(zip(present, random.sample(range(9), len(ids)), strict=True))
    held, most = carried_out(present, plan_moves(present, wanted))
    assert held == wanted
    assert most <= max(Counter(ids).values())


def test_with_every_id_taken_a_swap_still_ends_right():
    present = {uid(i): i for i in range(64)}
    wanted = {uid(3): 7, uid(7): 3}
    held, most = carried_out(present, plan_moves(present, wanted))
    assert held == present | wanted
    assert most == 2


def test_reserved_ids_are_not_used_in_passing():
    present = {uid(0): 0, uid(1): 1}
    moves = plan_moves(present, {uid(0): 1, uid(1): 0}, reserved=range(40, 64))
    assert [move.after for move in moves] == [39, 0, 1]


def test_an_id_that_another_device_keeps_is_refused_by_name():
    with pytest.raises(ValueError, match=f"module id 1 is held by device {uid(1).hex()}"):
        plan_moves({uid(0): 0, uid(1): 1}, {uid(0): 1})


def test_one_id_for_two_is_refused():
    with pytest.raises(ValueError, match="module id 5 is wanted for more than one"):
        plan_moves({uid(0): 0, uid(1): 1}, {uid(0): 5, uid(1): 5})


def test_a_spare_is_the_highest_free_one():
    assert spare_id({63, 61}) == 62
    assert spare_id(range(64)) is None


@example([2, 7, 7, 0, 0, 3], [3, 3, 1, 1, 1, 7])
@example([7, 7, 3], [3, 3, 7])  # both that have 7 must go before a third can have it
@given(
    st.lists(st.integers(0, 8), min_size=1, max_size=8), st.lists(st.integers(0, 8), min_size=1, max_size=8)
)
def test_ids_that_several_had_are_given_back_where_that_is_wanted(ids, earlier):
    present = {uid(i): module for i, module in enumerate(ids)}
    wanted = {uid(i): module for i, module in enumerate(earlier[: len(ids)])}
    held, _ = carried_out(present, moves := plan_moves(present, wanted, may_share=True))
    assert held == present | wanted
    assert len(moves) <= 2 * len(ids), "somebody went from spare id to spare id"
