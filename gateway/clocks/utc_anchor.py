"""How gateway time stands to the host's UTC, and when that changed. Sans-I/O.

Gateway time is the host's monotonic clock, shifted once. What slews the host's UTC (NTP) slews the monotonic
clock alike, so that UTC minus gateway time is constant, but for the moments at which UTC is set.
"""

from __future__ import annotations

from typing import NamedTuple

SHORTEST_STEP_NS = 1_000_000
"""Two clocks cannot be read at the same moment: smaller differences are ours, not steps."""


class AnchorReading(NamedTuple):
    """Both clocks at one moment, ns, and what was seen of steps."""

    gateway_ns: int
    utc_ns: int
    steps: int = 0
    last_step_ns: int | None = None
    """Size of the last step of UTC, positive: forward."""
    last_step_gateway_ns: int | None = None
    """Gateway time at which it was noticed."""

    @property
    def offset_ns(self) -> int:
        """UTC minus gateway time."""
        return self.utc_ns - self.gateway_ns


class AnchorWatch:
    """Takes readings of both clocks; knows the newest and the steps between them."""

    def __init__(self) -> None:
        self.newest: AnchorReading | None = None

    def observe(self, gateway_ns: int, utc_ns: int) -> bool:
        """Take a reading; whether UTC was set since the one before."""
        before = self.newest
        if before is None:
            self.newest = AnchorReading(gateway_ns, utc_ns)
            return False
        step_ns = utc_ns - gateway_ns - before.offset_ns
        if abs(step_ns) < SHORTEST_STEP_NS:
            # The offset of the first reading stands: jitter between two reads must not add up.
            self.newest = before._replace(gateway_ns=gateway_ns, utc_ns=gateway_ns + before.offset_ns)
            return False
        self.newest = AnchorReading(gateway_ns, utc_ns, before.steps + 1, step_ns, gateway_ns)
        return True
