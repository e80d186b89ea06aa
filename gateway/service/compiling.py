"""What ``readiness.make_ready`` runs in processes of their own: call kernels, so that they are compiled."""

from __future__ import annotations

import contextlib
import json
import os
import random
import sys
from collections.abc import Callable, Iterator, Sequence
from functools import partial

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
from gateway.frames import FloatArray, ImuFrame, SkeletonFrame, unknown_pose
from gateway.geometry import compiled
from gateway.pipeline import Pipeline
from gateway.reconstruction import DELAYABLE, RECONSTRUCTORS, RootMode, RootSettings
from gateway.reconstruction.whole_body import WholeBodyReconstructor
from gateway.service.readiness import FALLBACK, FIRST, make_ready, note_of
from gateway.sources.clock_mode import ClockMode
from gateway.sources.module_table import ModuleTable
from gateway.sources.registry import SOURCES
from gateway.sources.source import SourceContext
from gateway.stages import frame_assembler
from gateway.support.whole_files import write_whole

_RIG = "suit_17"
_DELAY_S = 0.05
"""Of methods that can have one: what goes back over past frames is compiled with the rest."""
_INTERVAL_US = 10_000
_INSTANTS = 12
"""That many samples of each module go through the pipeline."""
_SHAKEN_INSTANTS = 300
"""And so many more in motion: how modules are worn is judged once a second, from some seconds."""
_PARAMS = frame_assembler.AssemblyParams(
    frame_interval_ns=10_000_000, max_wait_ns=20_000_000, max_gap_ns=50_000_000, hold_ns=100_000_000
)


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


_OTHERS: dict[str, Callable[[], None]] = {
    "walking": partial(_whole_body, RootMode.WALKING),
    "standing": partial(_whole_body, RootMode.FIXED),
    "stream": _stream,
}
"""Of ``PARTS``, what is no method."""


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
    # A body at rest does not ask how its modules are worn. Compiled at the first motion, it would stop a
    # gateway for seconds.
    for chunk in _shaken(suit):
        pipeline.feed(chunk)
    pipeline.statistics()
    with contextlib.suppress(OSError):  # then it is looked up again, which does no harm
        note = note_of(name, compiled.CACHE_DIRECTORY)
        note.parent.mkdir(parents=True, exist_ok=True)
        write_whole(note, json.dumps(compiled.called(), indent=0).encode())


def _delay(name: str) -> dict[str, float]:
    return {"delay_s": _DELAY_S} if name in DELAYABLE else {}


def _chunks(suit: WornSuit, framing: Framing) -> Iterator[Chunk]:
    """Yield what modules at rest send: both samples, one by one and, in a byte stream, relayed too."""
    # One framing after the other, in module time that never runs backwards.
    offset_us = list(Framing).index(framing) * _INSTANTS * _INTERVAL_US
    for k in range(_INSTANTS):
        time_us = offset_us + (k + 1) * _INTERVAL_US
        kind = (InertialSample, InertialSampleFine)[k % 2]
        sample = kind(
            specific_force=(0.0, 0.0, 9.81), angular_rate=(0.0, 0.1, 0.0), magnetic_field=(20.0, 0.0, -40.0)
        )
        sequence = time_us // _INTERVAL_US
        frames = [wire_frame(sample, module, sequence, time_us) for module in suit.module_ids]
        # Every other pair comes in a relay's batches, which take another path through the decoder.
        if framing is Framing.BYTE_STREAM and k % 4 >= 2:
            frames = [
                relay_batch(frames[first : first + 4], sequence, time_us)
                for first in range(0, len(frames), 4)
            ]
        yield Chunk(_framed(frames, framing), time_us * 1_000, framing)


def _shaken(suit: WornSuit) -> Iterator[Chunk]:
    """Yield what modules send, after ``_chunks``, that are shaken each for itself: no joint fits."""
    chance = random.Random(1)
    for k in range(_SHAKEN_INSTANTS):
        time_us = (len(Framing) * _INSTANTS + k + 1) * _INTERVAL_US
        frames = []
        for module in suit.module_ids:
            across, along = chance.gauss(0.0, 20.0), chance.gauss(0.0, 20.0)
            sample = InertialSample(
                specific_force=(across, along, 9.81),
                angular_rate=(0.0, 0.1, 0.0),
                magnetic_field=(20.0, 0.0, -40.0),
            )
            frames.append(wire_frame(sample, module, time_us // _INTERVAL_US, time_us))
        yield Chunk(_framed(frames, Framing.BYTE_STREAM), time_us * 1_000, Framing.BYTE_STREAM)


def _framed(frames: Sequence[WireFrame], framing: Framing) -> bytes:
    if framing is Framing.BYTE_STREAM:
        return b"".join(map(encode_frame, frames))
    return pack_can_records(piece for frame in frames for piece in fragment(frame))


class _NothingFound:
    """In the place of a method: a body that nothing is known of."""

    def __init__(self, n_segments: int) -> None:
        self._n = n_segments

    def update(self, observation: ImuFrame, resting: FloatArray | None = None) -> SkeletonFrame:
        """Return a frame in which every segment is missing."""
        return unknown_pose(self._n)

    def reset(self) -> None:
        """Do nothing: the reconstructor is stateless."""


def main(step: str) -> None:
    """Do in this process what another one asks for: see ``_step``."""
    kind, _, name = step.partition(":")
    if kind == "parts":
        try:
            for part in map(str.strip, sys.stdin):
                _OTHERS.get(part, partial(_method, part))()
                print(part, flush=True)  # noqa: T201 - to the other process
        except BrokenPipeError:  # that one has ended; Python would complain of it once more at its own end
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    elif name not in (*RECONSTRUCTORS, FIRST):
        sys.exit(f"no method is called '{name}'")
    elif kind == "through":
        _let_through(name)
    else:
        with contextlib.suppress(OSError):
            os.nice(19)  # what waits for it runs meanwhile
        make_ready(name)
