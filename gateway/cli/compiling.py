"""Tells whoever waits that the kernels are being compiled, and that it is the only time."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from typing import Any


@contextlib.contextmanager
def told_when_compiling(tell: Callable[[str], object]) -> Iterator[None]:
    """Around work that calls kernels: one line when the first of them is not in the cache, one at the end.

    Nothing is said when all of them come from the cache. Numba is imported: for where it is needed anyway.
    """
    from numba.core import event  # noqa: PLC0415 - takes a second

    class Watch(event.Listener):  # type: ignore[misc, no-any-unimported, unused-ignore]  # numba is untyped
        begun_s: float | None = None

        def on_start(self, event: Any) -> None:
            if self.begun_s is None:
                self.begun_s = time.monotonic()
                tell("compiling the reconstruction once, for up to a minute; later starts find it made")

        def on_end(self, event: Any) -> None:
            """The end of one kernel, of many."""

    watch = Watch()
    with event.install_listener("numba:compile", watch):
        yield
    if watch.begun_s is not None:
        tell(f"compiled ({time.monotonic() - watch.begun_s:.0f} s)")
