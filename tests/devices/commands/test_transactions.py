"""Commands are repeated until answered, and every answer finds its command, or is counted."""

from __future__ import annotations

import itertools

import pytest

from devices.commands.transactions import BROADCAST_WAITS_S, SINGLE_WAITS_S, Transactions
from firmware_protocol import BROADCAST
from firmware_protocol.commands import Result, Verb
from firmware_protocol.messages import ANYONE, Acknowledgement

ONE, OTHER = b"one.........", b"other......."


def answer_to(exchange, unique_id=ONE, result=Result.DONE, **changed):
    fields = {
        "transaction": exchange.command.transaction,
        "verb": exchange.command.verb,
        "result": int(result),
        "unique_id": unique_id,
        "payload": b"",
    }
    return Acknowledgement(**(fields | changed))


def begin(transactions, unique_id=ONE, now_s=0.0, known=()):
    return transactions.begin(Verb.IDENTIFY, BROADCAST, unique_id, b"\x05", now_s, known)


def sending_times(exchange):
    """When an unanswered command is sent, and when it is given up."""
    times, now_s = [], 0.0
    while not exchange.is_over(now_s):
        if exchange.takes_turn(now_s):
            times.append(now_s)
        now_s = exchange.next_s
    return times, now_s


@pytest.mark.parametrize(("unique_id", "waits"), [(ONE, SINGLE_WAITS_S), (ANYONE, BROADCAST_WAITS_S)])
def test_an_unanswered_command_is_repeated_ever_more_slowly_and_given_up(unique_id, waits):
    exchange = begin(Transactions(0), unique_id)
    times, given_up_s = sending_times(exchange)
    assert times == pytest.approx([0, *itertools.accumulate(waits)][:-1])
    assert given_up_s == pytest.approx(sum(waits))
    assert not exchange.answers


def test_an_answer_ends_it():
    transactions = Transactions(7)
    exchange = begin(transactions)
    assert exchange.takes_turn(0.0)
    assert transactions.take(answer_to(exchange), 3, "suit") is exchange
    assert exchange.is_over(0.01)
    assert not exchange.takes_turn(10.0)
    (answer,) = exchange.answers.values()
    assert (answer.unique_id, answer.module, answer.link, answer.result) == (ONE, 3, "suit", Result.DONE)


def test_a_broadcast_collects_every_device_once_until_its_time_is_over():
    transactions = Transactions(0)
    exchange = begin(transactions, ANYONE)
    exchange.takes_turn(0.0)
    for unique_id in (ONE, OTHER, ONE):
        transactions.take(answer_to(exchange, unique_id), 3, "suit")
    assert set(exchange.answers) == {ONE, OTHER}
    assert exchange.duplicates == 1
    assert not exchange.is_over(0.5)
    transactions.end(exchange)
    assert (transactions.duplicates, transactions.unexpected) == (1, 0)


def test_a_broadcast_is_over_after_the_first_wait_when_all_that_are_known_have_answered():
    transactions = Transactions(0)
    exchange = begin(transactions, ANYONE, known={ONE, OTHER})
    assert not exchange.is_over(0.0)
    exchange.takes_turn(0.0)
    for unique_id in (ONE, OTHER):
        transactions.take(answer_to(exchange, unique_id), 3, "suit")
    assert not exchange.is_over(BROADCAST_WAITS_S[0] - 0.001)  # who is not known answers as late as that
    assert exchange.is_over(BROADCAST_WAITS_S[0])
    assert not exchange.takes_turn(BROADCAST_WAITS_S[0])


def test_a_broadcast_is_repeated_for_one_that_is_known_and_over_when_it_answers():
    transactions = Transactions(0)
    exchange = begin(transactions, ANYONE, known={ONE, OTHER})
    exchange.takes_turn(0.0)
    transactions.take(answer_to(exchange, ONE), 3, "suit")
    assert exchange.takes_turn(BROADCAST_WAITS_S[0])
    assert not exchange.is_over(BROADCAST_WAITS_S[0] + 0.01)
    transactions.take(answer_to(exchange, OTHER), 3, "suit")
    assert exchange.is_over(BROADCAST_WAITS_S[0] + 0.01)


@pytest.mark.parametrize(
    "wrong",
    [
        {"transaction": 99},
        {"verb": int(Verb.COMMIT)},
        {"unique_id": OTHER},
    ],
)
def test_an_answer_to_something_else_is_counted_and_ends_nothing(wrong):
    transactions = Transactions(0)
    exchange = begin(transactions)
    assert transactions.take(answer_to(exchange, **wrong), 3, "suit") is None
    assert not exchange.answers
    assert transactions.unexpected == 1


def test_a_late_answer_is_counted():
    transactions = Transactions(0)
    exchange = begin(transactions)
    transactions.end(exchange)
    assert transactions.take(answer_to(exchange), 3, "suit") is None
    assert transactions.unexpected == 1


def test_a_result_of_newer_firmware_is_no_success():
    transactions = Transactions(0)
    exchange = begin(transactions)
    transactions.take(answer_to(exchange, result=200), 3, "suit")
    assert exchange.answers[ONE].result is None


def test_numbers_wrap_and_skip_those_under_way():
    transactions = Transactions(65535)
    first, second = begin(transactions), begin(transactions)
    assert (first.command.transaction, second.command.transaction) == (65535, 0)
    transactions._next = 65535
    assert begin(transactions).command.transaction == 1
