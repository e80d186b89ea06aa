"""Two-way exchanges with one module: what was asked, and what an answer says. Sans-I/O.

The gateway sends a request at ``t1`` (gateway time); the module notes its own time ``t2`` when it comes and
``t3`` when it answers; the answer arrives at ``t4``. Gateway time minus module time then lies between
``t1 − t2`` and ``t4 − t3``, whatever the delays; if the two ways take equally long it is their middle.
"""

from __future__ import annotations

from typing import NamedTuple

TOKENS = 1 << 16
_OUTSTANDING = 64
PATIENCE_NS = 2_000_000_000


class Exchange(NamedTuple):
    """One exchange that was completed."""

    sent_ns: int
    received_us: int
    """32-bit module time of the request's coming."""
    replied_us: int
    """32-bit module time of the answer's leaving."""
    arrived_ns: int

    @property
    def round_trip_us(self) -> float:
        """Time on the two ways, without what the module took to answer."""
        held_us = (self.replied_us - self.received_us) % 2**32
        return (self.arrived_ns - self.sent_ns) * 1e-3 - held_us

    @property
    def offset_us(self) -> float:
        """Gateway time minus (32-bit) module time if the two ways take equally long."""
        held_us = (self.replied_us - self.received_us) % 2**32
        return 0.5 * (self.sent_ns + self.arrived_ns) * 1e-3 - self.received_us - 0.5 * held_us

    @property
    def bound_us(self) -> float:
        """How far ``offset_us`` can be off at most."""
        return 0.5 * self.round_trip_us


class SyncExchanges:
    """Tokens of the requests to one module (or to all: then one of these for each)."""

    def __init__(self) -> None:
        self.completed = 0
        self.unanswered = 0
        """Requests that had no answer within ``PATIENCE_NS``."""
        self.unexpected = 0
        """Answers to nothing that is outstanding, or that cannot be true."""
        self._sent: dict[int, int] = {}

    def sent(self, token: int, sent_ns: int) -> None:
        """Note that a request has left the gateway, and give up on requests too old to be answered."""
        self._sent[token % TOKENS] = sent_ns
        old = [t for t, at in self._sent.items() if sent_ns - at > PATIENCE_NS]
        old += list(self._sent)[: max(0, len(self._sent) - _OUTSTANDING - len(old))]
        for key in old:
            self.unanswered += self._sent.pop(key, None) is not None

    def answered(self, token: int, received_us: int, replied_us: int, arrived_ns: int) -> Exchange | None:
        """Return the exchange that an answer completes; None if it answers nothing, or a time in it is
        impossible.
        """
        sent_ns = self._sent.pop(token, None)
        if sent_ns is None:
            self.unexpected += 1
            return None
        exchange = Exchange(sent_ns, received_us, replied_us, arrived_ns)
        # The module says that it held the question for longer than the whole exchange took.
        if exchange.round_trip_us < 0:
            self.unexpected += 1
            return None
        self.completed += 1
        return exchange
