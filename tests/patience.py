"""How long tests wait, and how late the machine is: it may be slow, and no test is to fail for that."""

from __future__ import annotations

import asyncio
import contextlib
import statistics
import time
from collections.abc import AsyncIterator
from dataclasses import dataclass, field

PATIENCE_S = 60.0
"""For what should come at once. It ends a test whose condition never holds, and is no measure of speed."""

_PAUSE_S = 0.005


@dataclass
class Lateness:
    """How much later than asked an event loop went on, s: what a limit on times is to allow besides."""

    late_s: list[float] = field(default_factory=lambda: [0.0])

    @property
    def worst_s(self) -> float:
        return max(self.late_s)

    @property
    def share(self) -> float:
        """Of the time that it went on later than asked, 0 … 1: so much of it others had the machine."""
        late_s = sum(self.late_s)
        return late_s / (late_s + _PAUSE_S * len(self.late_s))

    @property
    def median_s(self) -> float:
        return statistics.median(self.late_s)


@contextlib.asynccontextmanager
async def loop_lateness() -> AsyncIterator[Lateness]:
    """Measures this loop, with nothing but short sleeps, for as long as the block lasts."""
    lateness = Lateness()

    async def measure() -> None:
        while True:
            begun = time.monotonic()
            await asyncio.sleep(_PAUSE_S)
            lateness.late_s.append(time.monotonic() - begun - _PAUSE_S)

    measuring = asyncio.create_task(measure())
    try:
        yield lateness
    finally:
        measuring.cancel()
