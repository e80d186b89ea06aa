"""Who is connected to a server at one time: those who say nothing make room for those who come. Sans-I/O."""

from __future__ import annotations

import threading
from collections import Counter
from typing import Generic, TypeVar

_Visitor = TypeVar("_Visitor")


class CrowdedError(Exception):
    """There is no room, and nobody silent whose place could be taken."""


class Crowd(Generic[_Visitor]):
    """Connections, each silent until its request is whole. May be used from several threads.

    Whoever opens connections and says nothing could hold all places otherwise. The place that is taken is the
    oldest of the address that holds most silent ones, so that a flood from one address pushes out its own.
    """

    def __init__(self, most: int, most_of_one: int) -> None:
        """Admit ``most`` connections at a time, and ``most_of_one`` requests of one address."""
        self._most = most
        self._most_of_one = most_of_one
        self._silent: dict[_Visitor, str] = {}  # the oldest first
        self._active: dict[_Visitor, str] = {}
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self._silent) + len(self._active)

    def enter(self, visitor: _Visitor, address: str) -> _Visitor | None:
        """Take a connection in. Returns the one to hang up on for it, if it took the place of one.

        Raises ``CrowdedError`` when all places are taken by requests that are being answered.
        """
        with self._lock:
            displaced = None
            if len(self) >= self._most:
                if not self._silent:
                    raise CrowdedError
                # The address with most silent connections gives one up, so that one client cannot take all
                # places.
                held = Counter(self._silent.values())
                displaced = max(self._silent, key=lambda silent: held[self._silent[silent]])
                del self._silent[displaced]
            self._silent[visitor] = address
            return displaced

    def note_request(self, visitor: _Visitor) -> None:
        """Note that a connection's request is whole.

        Raises ``CrowdedError`` if its address has too many already.
        """
        with self._lock:
            address = self._silent.pop(visitor, None)
            if address is None:
                return  # it was hung up on
            if Counter(self._active.values())[address] >= self._most_of_one:
                raise CrowdedError
            self._active[visitor] = address

    def leave(self, visitor: _Visitor) -> None:
        """Note that a connection has ended."""
        with self._lock:
            self._silent.pop(visitor, None)
            self._active.pop(visitor, None)
