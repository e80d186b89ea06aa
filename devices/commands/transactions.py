"""Commands on their way to devices and the answers that come back. Sans-I/O: time is an argument.

An ``Exchange`` is one command under one transaction number. It is sent again until it is answered:
a device repeats its answer to a transaction that it knows without acting twice, so sending again is
always safe. ``Transactions`` gives the numbers and finds the exchange that an answer belongs to.

Times are seconds of any steady clock.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

from firmware_protocol import BROADCAST
from firmware_protocol.commands import Result, Verb
from firmware_protocol.messages import ANYONE, Acknowledgement, Command

SINGLE_WAITS_S = (0.15, 0.3, 0.6, 1.2)
"""How long an answer of one device is waited for before each repetition, and after the last."""

BROADCAST_WAITS_S = (0.25, 0.35, 0.6)
"""The same for answers of all: each comes (its id x 2 ms) late, a relay's more than half a second."""

_TRANSACTIONS = 2**16


@dataclass(frozen=True, slots=True)
class Answer:
    """What one device said to one command."""

    unique_id: bytes
    module: int
    """Id that the device had when it answered."""
    link: str
    """Link that the answer came over."""
    result: Result | None
    """None: a number that this version does not know."""
    payload: bytes


class Exchange:
    """One command, and the answers to it so far."""

    def __init__(
        self,
        command: Command,
        target: int,
        waits_s: Sequence[float],
        now_s: float,
        known: Collection[bytes] = (),
    ) -> None:
        """Begin an exchange; it is over (``is_over``) once the ``known`` devices have answered."""
        self.command = command
        self.target = target
        """Module id in the header: 0 to 63, the relay's, or all."""
        self.answers: dict[bytes, Answer] = {}
        """By unique id; the first of each device counts."""
        self.duplicates = 0
        self.attempts = 0
        self._waits_s = tuple(waits_s)
        self._known = frozenset(known)
        self._due_s = self._first_end_s = now_s

    @property
    def awaits_all(self) -> bool:
        """Whether any number of devices may answer, so that no single answer ends it."""
        return self.target == BROADCAST and self.command.unique_id == ANYONE

    @property
    def next_s(self) -> float:
        """When to send again, or to give up."""
        return self._due_s

    def takes_turn(self, now_s: float) -> bool:
        """Return whether the command is to be sent now; it is then taken as sent."""
        if now_s < self._due_s or self.is_over(now_s):
            return False
        self._due_s = now_s + self._waits_s[self.attempts]
        if not self.attempts:
            self._first_end_s = self._due_s
        self.attempts += 1
        return True

    def is_over(self, now_s: float) -> bool:
        """Answered, or out of attempts and time.

        What all are asked is answered when all that are known have answered. Even then the first wait is
        kept: a device that is not known yet, switched on just now, answers within it.
        """
        if self.awaits_all:
            has_all = bool(self._known) and self._known <= self.answers.keys()
            if has_all and self.attempts and now_s >= self._first_end_s:
                return True
        elif self.answers:
            return True
        # After the last attempt its wait is kept, too.
        return self.attempts == len(self._waits_s) and now_s >= self._due_s

    def take(self, answer: Answer) -> bool:
        """Take an answer; return whether it is a new one of a device that was asked."""
        wanted = self.command.unique_id
        if wanted not in (ANYONE, answer.unique_id):
            return False
        if wanted == ANYONE and self.target not in (BROADCAST, answer.module):
            return False
        # A repeated question is answered again by a device that has heard both.
        if answer.unique_id in self.answers:
            self.duplicates += 1
            return False
        self.answers[answer.unique_id] = answer
        return True


class Transactions:
    """The commands under way."""

    def __init__(self, first: int) -> None:
        """Begin with the number ``first``.

        A device remembers the last few numbers of the host that spoke to it before, and would repeat its old
        answer to one of them: begin anywhere but where that one began.
        """
        self.unexpected = 0
        """Answers that were not awaited: too late, or meant for another host."""
        self.duplicates = 0
        """Answers that had come before."""
        self._next = first % _TRANSACTIONS
        self._open: dict[int, Exchange] = {}

    def begin(
        self,
        verb: Verb,
        target: int,
        unique_id: bytes,
        arguments: bytes,
        now_s: float,
        known: Collection[bytes] = (),
    ) -> Exchange:
        """Return a new exchange, to be sent at once; a ``unique_id`` asks that device alone, ``ANYONE`` all.

        known: of a command to all, the devices that are known to be there.
        """
        # A number in use would let the device repeat its answer to the other command.
        while self._next in self._open:
            self._next = (self._next + 1) % _TRANSACTIONS
        command = Command(transaction=self._next, verb=int(verb), unique_id=unique_id, arguments=arguments)
        self._next = (self._next + 1) % _TRANSACTIONS
        is_for_all = target == BROADCAST and unique_id == ANYONE
        waits_s = BROADCAST_WAITS_S if is_for_all else SINGLE_WAITS_S
        exchange = Exchange(command, target, waits_s, now_s, known)
        self._open[command.transaction] = exchange
        return exchange

    def end(self, exchange: Exchange) -> None:
        """Forget an exchange; what is still answered to it counts as unexpected."""
        self._open.pop(exchange.command.transaction, None)
        self.duplicates += exchange.duplicates

    def take(self, acknowledgement: Acknowledgement, module: int, link: str) -> Exchange | None:
        """Return the exchange that an acknowledgement advances, if any."""
        exchange = self._open.get(acknowledgement.transaction)
        # An answer that is late may carry a number that is in use again.
        if exchange is None or exchange.command.verb != acknowledgement.verb:
            self.unexpected += 1
            return None
        answer = Answer(
            unique_id=acknowledgement.unique_id,
            module=module,
            link=link,
            result=_result(acknowledgement.result),
            payload=acknowledgement.payload,
        )
        before = exchange.duplicates
        if exchange.take(answer):
            return exchange
        self.unexpected += exchange.duplicates == before
        return None


def _result(number: int) -> Result | None:
    try:
        return Result(number)
    except ValueError:
        return None
