"""Compile beforehand what a command calls, and say why that takes its time."""

from __future__ import annotations

import contextlib
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from types import FrameType
from typing import Any

import typer

from gateway.cli.terminal import progress_bar
from gateway.reconstruction import OPTICAL, RootMode
from gateway.reconstruction.optical.reconstructor import warm_up
from gateway.settings import GatewaySettings, RootMotionSettings

_USUAL = "compiling the reconstruction once; later starts find it made"


@contextlib.contextmanager
def report_compiling(show: Callable[[str], object]) -> Iterator[None]:
    """Print a line when the first kernel is compiled during the work, and one at the end.

    Nothing is said when all of them come from the cache. Numba is imported: for where it is needed anyway.
    """
    from numba.core import event

    class Watch(event.Listener):  # type: ignore[misc, no-any-unimported, unused-ignore]  # numba is untyped
        begun_s: float | None = None

        def on_start(self, event: Any) -> None:
            if self.begun_s is None:
                self.begun_s = time.monotonic()
                show(_USUAL)

        def on_end(self, event: Any) -> None:
            """The end of one kernel, of many."""

    watch = Watch()
    with event.install_listener("numba:compile", watch), _interruptible():
        yield
    if watch.begun_s is not None:
        show(f"compiled ({time.monotonic() - watch.begun_s:.0f} s)")


@contextlib.contextmanager
def _interruptible() -> Iterator[None]:
    """Let Ctrl-C end the work in the main thread.

    An exception raised within a callback of the compiler is lost, and what the callback was for is then found
    missing: that ``RuntimeError`` is the interruption.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        # Signals can only be handled in the main thread.
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


_FIRST = "first start: compiling what the first poses need, once"


def make_ready(reconstructor: str) -> None:
    """Compile a method that is not yet, and say why that takes its time."""
    from gateway.service import readiness

    if reconstructor == OPTICAL:
        with report_compiling(partial(typer.echo, err=True)):
            warm_up()
    elif not readiness.is_ready(reconstructor):
        show = partial(typer.echo, err=True)
        _compile(reconstructor, f"compiling the method '{reconstructor}': once after an installation", show)


def stand_in(settings: GatewaySettings, show: Callable[[str], object]) -> GatewaySettings:
    """Return the settings that run while the method of these is compiled; what they need is compiled here."""
    from gateway.service import readiness

    if not readiness.is_ready(readiness.FIRST):
        _compile(readiness.FIRST, _FIRST, show)
    in_its_place = RootMotionSettings(mode=RootMode.FIXED)
    return settings.solved_by(readiness.FALLBACK).model_copy(update={"root_motion": in_its_place})


def _compile(name: str, why: str, show: Callable[[str], object]) -> None:
    """Compile a method. How far it is stands in a bar on a terminal, else in a line for each step."""
    from gateway.service import readiness

    begun_s = time.monotonic()
    show(why)
    is_terminal = sys.stderr.isatty()
    with progress_bar("compiling", is_shown=is_terminal) as bar:

        def report(done: int, of: int) -> None:
            if is_terminal:
                bar(done, of)
            elif done:
                show(f"compiling: step {done} of {of} ({time.monotonic() - begun_s:.0f} s)")

        readiness.make_ready(name, progress=report)
    show(f"compiled ({time.monotonic() - begun_s:.0f} s)")
