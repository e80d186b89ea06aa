"""Whether a method can start at once, or its kernels have to be compiled first, and the compiling beforehand.

What is compiled lies on the disk (``geometry.compiled``); beside it a note for each method says which kernels
it calls, from the bytes of a suit to the pose. A method is ready when all of these are on the disk as they
are now.

``make_ready`` compiles in processes side by side (``compiling``): numba holds the interpreter while it does,
and nothing else would run well. They compile ``PARTS``; then one process a method lets bytes through the
whole pipeline, which compiles whatever no part has, and writes the note. So nothing names a kernel, and
nothing here imports what calls one.

Until a method is ready ``FALLBACK`` serves, with a root that stays where it is: it wants the fewest kernels.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import queue
import subprocess
import sys
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

from gateway.errors import GatewayError
from gateway.geometry import compiled
from gateway.reconstruction import FUSED, RECONSTRUCTORS

FALLBACK = "independent"
"""What it needs with a root that stays in its place compiles in seconds, and serves until then."""
FIRST = "first"
"""``FALLBACK`` so, as the name of what can be ready."""
USUAL = ("joint", FALLBACK)
"""What is compiled with an installation."""
LONG_COMPILED = frozenset(RECONSTRUCTORS) - FUSED
PARTS = (*sorted(LONG_COMPILED - {FALLBACK}), "walking", "standing", FALLBACK, "stream")
"""What is compiled side by side, in this order: what takes longest begins first."""


class Readiness(NamedTuple):
    """How far a method's kernels are compiled."""

    ready: int
    kernels: int
    """That it calls; 0: not known before they have been compiled once."""

    @property
    def is_complete(self) -> bool:
        """Whether it starts within seconds."""
        return 0 < self.kernels == self.ready


def readiness(name: str) -> Readiness:
    """Return how many of a method's kernels are on the disk, as they are now."""
    for folder in (compiled.CACHE_DIRECTORY, compiled.SHIPPED):
        with contextlib.suppress(OSError, ValueError, TypeError):
            noted = [compiled.KernelState(*each) for each in json.loads(note_of(name, folder).read_text())]
            if noted and all(state.is_current for state in noted):
                return Readiness(sum(state.is_kept for state in noted), len(noted))
    return Readiness(0, 0)


def in_words(found: Readiness) -> str:
    """Return one line on how far a method's kernels are."""
    if not found.kernels:
        return "not compiled yet, or changed since"
    return f"{found.ready} of {found.kernels} kernels ready"


def is_ready(name: str) -> bool:
    """Return whether a method starts within seconds, or at least needs no other one to stand in for it.

    What solves markers and cameras compiles its own few kernels as it starts: no method for modules could
    serve until then.
    """
    if name == FIRST and readiness(FALLBACK).is_complete:
        return True
    needs_kernels = name == FIRST or name in LONG_COMPILED
    return not needs_kernels or readiness(name).is_complete


def make_ready(
    *names: str, progress: Callable[[int, int], object] = lambda _done, _of: None, folder: Path | None = None
) -> None:
    """Compile what is still to be compiled of these methods, in as many processes as there are cores; takes
    half a minute to a minute.

    progress: is given how many of all steps are done. folder: where it is to lie, ready elsewhere or not;
    else ``CACHE_DIRECTORY``. Raises ``GatewayError`` if a step fails."""
    wanted = [name for name in names if folder is not None or not is_ready(name)]
    there = os.environ | ({} if folder is None else {"NUMBA_CACHE_DIR": str(folder)})
    needed = {part for name in wanted for part in _parts_of(name)}
    parts = [part for part in PARTS if part in needed]
    n_workers = len(os.sched_getaffinity(0))
    n_done, n_steps = itertools.count(1), len(parts) + len(wanted)
    progress(0, n_steps)
    waiting = queue.SimpleQueue[str]()
    for part in parts:
        waiting.put(part)
    with ThreadPoolExecutor(n_workers) as workers:

        def report() -> None:
            progress(next(n_done), n_steps)

        for worker in [workers.submit(_compile, waiting, report, there) for _ in parts[:n_workers]]:
            worker.result()
        for _ in workers.map(partial(_run_through, there=there), wanted):  # their parts lie on the disk now
            report()


def _compile(waiting: queue.SimpleQueue[str], report: Callable[[], object], there: Mapping[str, str]) -> None:
    """Hand one part after another to a process, until none waits."""
    part = ""
    try:
        with (
            subprocess.Popen(
                _step("parts"), env=there, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
            ) as process,
            contextlib.suppress(queue.Empty),
        ):
            assert process.stdin is not None
            assert process.stdout is not None
            while True:
                part = waiting.get_nowait()
                print(part, file=process.stdin, flush=True)
                if process.stdout.readline() != f"{part}\n":
                    raise BrokenPipeError
                report()
    except BrokenPipeError:  # also where it ended before it read
        raise GatewayError(f"compiling failed in the part '{part}': see above") from None


def _run_through(name: str, there: Mapping[str, str]) -> None:
    if subprocess.run(_step(f"through:{name}"), env=there, check=False).returncode:
        raise GatewayError(f"compiling failed in the method '{name}': see above")


def _step(step: str) -> list[str]:
    return [sys.executable, "-c", _STEP, step]


_STEP = """
import signal, sys
signal.signal(signal.SIGINT, signal.SIG_DFL)
from gateway.service.compiling import main
main(sys.argv[1])
"""
"""Ctrl-C reaches all processes of a terminal; a trace of each, which it hit among its imports, helps
nobody."""


def command(name: str) -> list[str]:
    """Return what does ``make_ready`` in processes of their own, while others have the processor."""
    return _step(f"beside:{name}")


def _parts_of(name: str) -> tuple[str, ...]:
    return (FALLBACK, "standing", "stream") if name == FIRST else (name, "walking", "standing", "stream")


def note_of(name: str, folder: Path) -> Path:
    """Return where the note on a method's kernels lies. folder: of what is compiled."""
    return compiled.kept(folder) / f"ready-{name}-numba-{version('numba')}.json"
