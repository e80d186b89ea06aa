"""Tells whoever waits that the kernels are being compiled, and that it is the only time."""

from __future__ import annotations

import contextlib
import signal
import threading
import time
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any

_USUAL = "compiling the reconstruction once, for up to a minute; later starts find it made"


@contextlib.contextmanager
def told_when_compiling(tell: Callable[[str], object], line: str = _USUAL) -> Iterator[None]:
    """Around work that calls kernels: one line when the first of them is not in the cache, one at the end.

    Nothing is said when all of them come from the cache. Numba is imported: for where it is needed anyway.
    """
    from numba.core import event  # noqa: PLC0415 - takes a second

    class Watch(event.Listener):  # type: ignore[misc, no-any-unimported, unused-ignore]  # numba is untyped
        begun_s: float | None = None

        def on_start(self, event: Any) -> None:
            if self.begun_s is None:
                self.begun_s = time.monotonic()
                tell(line)

        def on_end(self, event: Any) -> None:
            """The end of one kernel, of many."""

    watch = Watch()
    with event.install_listener("numba:compile", watch), _interruptible():
        yield
    if watch.begun_s is not None:
        tell(f"compiled ({time.monotonic() - watch.begun_s:.0f} s)")


@contextlib.contextmanager
def _interruptible() -> Iterator[None]:
    """Ctrl-C ends the work, in the main thread. Within a callback of the compiler the exception is lost, and
    what the callback was for is then found missing: that ``RuntimeError`` is the interruption.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []
    before = signal.getsignal(signal.SIGINT)

    def interrupt(number: int, frame: FrameType | None) -> None:
        came.append(number)
        if callable(before):
            before(number, frame)

    signal.signal(signal.SIGINT, interrupt)
    try:
        yield
    except RuntimeError:
        if came:
            raise KeyboardInterrupt from None
        raise
    finally:
        signal.signal(signal.SIGINT, before)
