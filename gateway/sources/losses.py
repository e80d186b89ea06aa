"""Why samples were lost on their way: by what happened on the link between the packets around the gap."""

from __future__ import annotations

from enum import Enum


class Cause(Enum):
    """The likeliest first: what was found out later wins only where nothing before it fits."""

    LINK_DOWN = "the link was lost in between"
    OVERRUN = "bytes, frames or datagrams were lost for want of room (see the link's counts)"
    DAMAGED = "damaged wire frames were dropped in between"
    UNSEEN = "nothing was seen of them: lost in the suit, on the air or on the network"


class LinkLosses:
    """What has happened on one link, by the chunk in which it was noticed."""

    def __init__(self) -> None:
        self.chunk = 0
        """Number of the chunk in hand."""
        self._noticed: dict[Cause, int] = {}

    def notice(self, cause: Cause) -> None:
        """It happened before, or in, the chunk in hand."""
        self._noticed[cause] = self.chunk

    def cause_since(self, chunk: int) -> Cause:
        """Return why packets are missing after one that came in ``chunk``."""
        # The order of ``Cause`` is the order of precedence where several happened.
        for cause in Cause:
            if self._noticed.get(cause, -1) >= chunk:
                return cause
        return Cause.UNSEEN
