"""Time that passes only where all tasks sleep: timing is judged exactly, however busy the machine is."""

from __future__ import annotations

import asyncio
import selectors
import time
from collections.abc import Callable, Coroutine
from concurrent.futures import Executor
from typing import Any, TypeVar

import pytest

_Result = TypeVar("_Result")


def in_simulated_time(work: Coroutine[Any, Any, _Result]) -> _Result:
    """Run it in a ``SimulatedLoop`` of its own."""
    with asyncio.Runner(loop_factory=SimulatedLoop) as runner:
        return runner.run(work)


class SimulatedPolicy(asyncio.DefaultEventLoopPolicy):
    """For a fixture ``event_loop_policy``: all tests of a module run in simulated time."""

    def new_event_loop(self) -> SimulatedLoop:
        return SimulatedLoop()


class SimulatedLoop(asyncio.SelectorEventLoop):
    """While it runs, gateway time and ``time.monotonic`` are as simulated, too.

    For what sleeps, computes in threads of the loop and speaks in memory. Who else runs does so in no time.
    """

    def __init__(self) -> None:
        self._now_s = time.monotonic()
        self._working = 0
        super().__init__(_Selector(self._pass))

    def run_forever(self) -> None:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(time, "monotonic", self.time)
            patch.setattr(time, "monotonic_ns", lambda: round(self.time() * 1e9))
            super().run_forever()

    def time(self) -> float:
        """Simulated, s."""
        return self._now_s

    def run_in_executor(  # type: ignore[override]
        self, executor: Executor | None, func: Callable[..., _Result], *args: Any
    ) -> asyncio.Future[_Result]:
        """Time stands still while a thread works."""
        self._working += 1
        future = super().run_in_executor(executor, func, *args)
        future.add_done_callback(self._has_worked)
        return future

    def _has_worked(self, _future: asyncio.Future[Any]) -> None:
        self._working -= 1

    def _pass(self, seconds: float) -> bool:
        """Let time pass, unless a thread works."""
        if self._working:
            return False
        self._now_s += seconds
        return True


class _Selector(selectors.DefaultSelector):
    """Instead of waiting for a time it lets that pass at once."""

    def __init__(self, let_pass: Callable[[float], bool]) -> None:
        super().__init__()
        self._let_pass = let_pass

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        if timeout is None or timeout <= 0:
            return super().select(timeout)
        return super().select(0) or ([] if self._let_pass(timeout) else super().select(None))
