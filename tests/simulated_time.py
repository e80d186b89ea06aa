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
    """Run it in an event loop of its own, with gateway time and ``time.monotonic`` as simulated, too.

    For what sleeps, computes in threads of the loop and speaks in memory. Who else runs does so in no time.
    """
    with pytest.MonkeyPatch.context() as patch, asyncio.Runner(loop_factory=_SimulatedLoop) as runner:
        loop = runner.get_loop()
        patch.setattr(time, "monotonic", loop.time)
        patch.setattr(time, "monotonic_ns", lambda: round(loop.time() * 1e9))
        return runner.run(work)


class _SimulatedLoop(asyncio.SelectorEventLoop):
    def __init__(self) -> None:
        self._now_s = time.monotonic()
        self._working = 0
        super().__init__(_Selector(self._pass))

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
