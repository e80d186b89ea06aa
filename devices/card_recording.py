"""A file of a relay's memory card as a recording, so that it can be replayed like any other.

The card holds the wire frames that the relay gathered, stuffed, one after another, in the order in
which they came. When each came is read from the clock of its sender: the first of every sender came when
those before it in the file did.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from devices.link import Chunk, Framing
from devices.recording_writer import DerivedRecordingWriter, session_record
from firmware_protocol import FrameDecoder, WireFrame, encode_frame

LINK = "card"
"""Name of the link in the recording."""


_COUNTER = 2**32
_JUMP_US = 10_000_000
_BLOCK = 1 << 16


class ConvertedCard(NamedTuple):
    """What came out of a card file."""

    chunks: int
    dropped: int
    """Wire frames that were damaged."""
    duration_s: float


class _Elapsed:
    """32-bit stamps of one sender to µs since the file was begun."""

    def __init__(self, stamp_us: int, elapsed_us: int) -> None:
        """Begin with a stamp that came ``elapsed_us`` after the file was begun."""
        self._last_us = stamp_us
        self._elapsed_us = elapsed_us

    def at(self, stamp_us: int, latest_us: int) -> int:
        """Return when a further stamp came, µs; a clock that has jumped is taken to have begun anew."""
        # Stamps wrap, and may come a little out of order: the step is the one nearest to zero.
        step_us = (stamp_us - self._last_us + _COUNTER // 2) % _COUNTER - _COUNTER // 2
        self._last_us = stamp_us
        expected_us = self._elapsed_us + step_us
        has_jumped = abs(expected_us - latest_us) > _JUMP_US
        self._elapsed_us = latest_us if has_jumped else expected_us
        return self._elapsed_us


def convert_card_file(
    source: Path, target: Path, *, start_ns: int | None = None, end_ns: int = 0
) -> ConvertedCard:
    """Write the recording ``target`` from a downloaded card file, in the place of one that is there.

    start_ns: gateway time at which the file was begun; None: such that the recording ends at ``end_ns``.
    Raises OSError as ``open`` does.
    """
    # Read twice: where the recording begins follows from its length, if only its end is known.
    duration_us = max((elapsed_us for elapsed_us, _ in _arrivals(source, FrameDecoder())), default=0)
    base_ns = end_ns - duration_us * 1000 if start_ns is None else start_ns
    chunks = 0
    decoder = FrameDecoder()
    session = session_record({LINK: Framing.BYTE_STREAM}, begun_ns=str(base_ns), name=target.stem)
    with DerivedRecordingWriter(target, session, {}, base_ns, replaces=True) as recording:
        for elapsed_us, frame in _arrivals(source, decoder):
            # Without the clock of the host no arrival is known: each frame stands as a chunk of its own.
            chunk = Chunk(encode_frame(frame), base_ns + elapsed_us * 1000, LINK)
            recording.add_chunk(chunk, Framing.BYTE_STREAM)
            chunks += 1
    return ConvertedCard(chunks, sum(decoder.dropped.values()), duration_us * 1e-6)


def _arrivals(source: Path, decoder: FrameDecoder) -> Iterator[tuple[int, WireFrame]]:
    """Yield wire frames with the time since the file was begun, µs; times never decrease."""
    clocks: dict[int, _Elapsed] = {}
    latest_us = 0
    for frame in _frames(source, decoder):
        clock = clocks.get(frame.module)
        if clock is None:
            clocks[frame.module] = _Elapsed(frame.module_time_us, latest_us)
        else:
            latest_us = max(latest_us, clock.at(frame.module_time_us, latest_us))
        yield latest_us, frame


def _frames(source: Path, decoder: FrameDecoder) -> Iterator[WireFrame]:
    with source.open("rb") as file:
        while block := file.read(_BLOCK):
            yield from decoder.feed(block)
