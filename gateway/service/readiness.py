"""Whether a method can start at once, or its kernels have to be compiled first, and the compiling beforehand.

What is compiled lies on the disk (``geometry.compiled``); beside it a note for each method says which kernels
it calls, from the bytes of a suit to the pose. A method is ready when all of these are on the disk as they
are now.

``make_ready`` compiles in processes side by side: numba holds the interpreter while it does, and nothing else
would run well. They compile ``PARTS``; then one process a method lets bytes through the whole pipeline, which
compiles whatever no part has, and writes the note. So nothing here names a kernel.

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
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

from devices.link import SUIT, Chunk, Framing
from firmware_protocol import (
    InertialSample,
    InertialSampleFine,
    WireFrame,
    encode_frame,
    fragment,
    pack_can_records,
    relay_batch,
    wire_frame,
)
from gateway.body.rig import load_rig
from gateway.body.skeleton import WornSuit
from gateway.errors import GatewayError
from gateway.frames import FloatArray, ImuFrame, SkeletonFrame
from gateway.geometry import compiled
from gateway.pipeline import Pipeline
from gateway.reconstruction import DELAYABLE, FUSED, RECONSTRUCTORS, whole_body
from gateway.reconstruction.whole_body import RootMode, RootSettings, WholeBodyReconstructor
from gateway.sources.module_table import ClockMode, ModuleTable
from gateway.sources.registry import SOURCES
from gateway.sources.source import SourceContext
from gateway.stages import frame_assembler
from gateway.support.whole_files import write_whole

FALLBACK = "independent"
"""What it needs with a root that stays in its place compiles in seconds, and serves until then."""
FIRST = "first"
"""``FALLBACK`` so, as the name of what can be ready."""
USUAL = ("joint", FALLBACK)
"""What is compiled with an installation."""
LONG_COMPILED = frozenset(RECONSTRUCTORS) - FUSED
_RIG = "suit_17"
_DELAY_S = 0.05
"""Of methods that can have one: what goes back over past frames is compiled with the rest."""
_INTERVAL_US = 10_000
_INSTANTS = 12
"""That many samples of each module go through the pipeline."""
_PARAMS = frame_assembler.AssemblyParams(
    frame_interval_ns=10_000_000, max_wait_ns=20_000_000, max_gap_ns=50_000_000, hold_ns=100_000_000
)


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
            noted = [compiled.KernelState(*each) for each in json.loads(_note(name, folder).read_text())]
            if noted and all(state.is_current for state in noted):
                return Readiness(sum(state.is_kept for state in noted), len(noted))
    return Readiness(0, 0)


def in_words(found: Readiness) -> str:
    """Return one line on how far a method's kernels are."""
    if not found.kernels:
        return "not compiled yet, or changed since"
    return f"{found.ready} of {found.kernels} kernels ready"


def is_ready(name: str) -> bool:
    """Whether a method starts within seconds."""
    if name in FUSED or readiness(name).is_complete:
        return True
    return name == FIRST and readiness(FALLBACK).is_complete


def make_ready(
    *names: str, tell: Callable[[int, int], object] = lambda _done, _of: None, folder: Path | None = None
) -> None:
    """Compile what is still to be compiled of these methods, in as many processes as there are cores; takes
    half a minute to a minute.

    tell: is given how many of all steps are done. folder: where it is to lie, ready elsewhere or not; else
    ``CACHE_DIRECTORY``. Raises ``GatewayError`` if a step fails."""
    wanted = [name for name in names if folder is not None or not is_ready(name)]
    there = os.environ | ({} if folder is None else {"NUMBA_CACHE_DIR": str(folder)})
    needed = {part for name in wanted for part in _parts_of(name)}
    parts = [part for part in PARTS if part in needed]
    n_workers = len(os.sched_getaffinity(0))
    n_done, n_steps = itertools.count(1), len(parts) + len(wanted)
    waiting = queue.SimpleQueue[str]()
    for part in parts:
        waiting.put(part)
    with ThreadPoolExecutor(n_workers) as workers:

        def report() -> None:
            tell(next(n_done), n_steps)

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
    return [sys.executable, "-m", "gateway.service.readiness", step]


def command(name: str) -> list[str]:
    """Return what does ``make_ready`` in processes of their own, while others have the processor."""
    return _step(f"beside:{name}")


def _parts_of(name: str) -> tuple[str, ...]:
    return (FALLBACK, "standing", "stream") if name == FIRST else (name, "walking", "standing", "stream")


def _method(name: str) -> None:
    """Compile a method by itself."""
    RECONSTRUCTORS[name](load_rig(_RIG), 0.01, **_delay(name))


def _whole_body(mode: RootMode) -> None:
    """Compile what stands around every method."""
    suit = load_rig(_RIG)
    WholeBodyReconstructor(suit, _NothingFound(suit.skeleton.n_segments), RootSettings(mode))


def _stream() -> None:
    """Compile what makes frames of bytes."""
    suit = load_rig(_RIG)
    frame_assembler.FrameAssembler(suit.module_ids, _PARAMS)
    source = SOURCES[SUIT].make(SourceContext(suit, ModuleTable(ClockMode.ESTIMATED)))
    for framing in Framing:
        source.add_link(framing, framing)
        for chunk in _chunks(suit, framing):
            source.receive(chunk)


PARTS: dict[str, Callable[[], None]] = {
    **{name: partial(_method, name) for name in sorted(LONG_COMPILED - {FALLBACK})},
    "walking": partial(_whole_body, RootMode.WALKING),
    "standing": partial(_whole_body, RootMode.FIXED),
    FALLBACK: partial(_method, FALLBACK),
    "stream": _stream,
}
"""What is compiled side by side, in this order: what takes longest begins first."""


def _let_through(name: str) -> None:
    """Have bytes of all framings make poses by a method, and note which kernels that called."""
    suit = load_rig(_RIG)
    method = FALLBACK if name == FIRST else name
    root = RootSettings(RootMode.FIXED if name == FIRST else RootMode.AUTO)
    pipeline = Pipeline(suit, _PARAMS, method, root=root, delay_s=_delay(method).get("delay_s", 0.0))
    for framing in Framing:
        pipeline.add_link(framing, framing)
        for chunk in _chunks(suit, framing):
            pipeline.feed(chunk)
    with contextlib.suppress(OSError):  # then it is looked up again, which does no harm
        note = _note(name, compiled.CACHE_DIRECTORY)
        note.parent.mkdir(parents=True, exist_ok=True)
        write_whole(note, json.dumps(compiled.called(), indent=0).encode())


def _delay(name: str) -> dict[str, float]:
    return {"delay_s": _DELAY_S} if name in DELAYABLE else {}


def _chunks(suit: WornSuit, framing: Framing) -> Iterator[Chunk]:
    """Yield what modules at rest send: both samples, one by one and, in a byte stream, relayed too."""
    offset_us = list(Framing).index(framing) * _INSTANTS * _INTERVAL_US
    for k in range(_INSTANTS):
        time_us = offset_us + (k + 1) * _INTERVAL_US
        kind = (InertialSample, InertialSampleFine)[k % 2]
        sample = kind(
            specific_force=(0.0, 0.0, 9.81), angular_rate=(0.0, 0.1, 0.0), magnetic_field=(20.0, 0.0, -40.0)
        )
        sequence = time_us // _INTERVAL_US
        frames = [wire_frame(sample, module, sequence, time_us) for module in suit.module_ids]
        if framing is Framing.BYTE_STREAM and k % 4 >= 2:
            frames = [
                relay_batch(frames[first : first + 4], sequence, time_us)
                for first in range(0, len(frames), 4)
            ]
        yield Chunk(_framed(frames, framing), time_us * 1_000, framing)


def _framed(frames: Sequence[WireFrame], framing: Framing) -> bytes:
    if framing is Framing.BYTE_STREAM:
        return b"".join(map(encode_frame, frames))
    return pack_can_records(piece for frame in frames for piece in fragment(frame))


class _NothingFound:
    """In the place of a method: a body that nothing is known of."""

    def __init__(self, n_segments: int) -> None:
        self._n = n_segments

    def update(self, observation: ImuFrame, resting: FloatArray | None = None) -> SkeletonFrame:
        """Every segment is missing."""
        return whole_body.no_pose(self._n)

    def reset(self) -> None:
        """Nothing is remembered."""


def _note(name: str, folder: Path) -> Path:
    return compiled.kept(folder) / f"ready-{name}-numba-{version('numba')}.json"


def main(step: str) -> None:
    """Do in this process what another one asks for: see ``_step``."""
    kind, _, name = step.partition(":")
    if kind == "parts":
        for part in map(str.strip, sys.stdin):
            PARTS[part]()
            print(part, flush=True)  # noqa: T201 - to the other process
    elif name not in (*RECONSTRUCTORS, FIRST):
        sys.exit(f"no method is called '{name}'")
    elif kind == "through":
        _let_through(name)
    else:
        with contextlib.suppress(OSError):
            os.nice(19)  # whoever waits for it runs meanwhile
        make_ready(name)


if __name__ == "__main__":
    main(sys.argv[1])
