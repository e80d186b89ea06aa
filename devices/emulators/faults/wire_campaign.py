"""Damaged traffic of every kind through both decoders: nothing may raise, nothing false may pass, and
what is intact must come through at once.

::

    python -m devices.emulators.faults.wire_campaign --frames 1000000 --seed 1

A wire frame that is accepted must be equal, byte for byte, to one that was sent. A damaged one passes the
CRC-32 with a probability of 2^-32; if that happens it is reported as a failure, with its bytes, not
hidden. The exit code is 1 when anything failed.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from random import Random

from devices.emulators.faults.wire_damage import BLOCK_SIZE, ByteStream, CanBus, Traffic
from firmware_protocol import (
    CanFrameDecoder,
    Defect,
    FrameDecoder,
    PacketDecoder,
    ReceivedPacket,
    WireFrame,
    WireFrameDecoder,
)
from firmware_protocol.framing import Entry

_SHOWN_FAILURES = 5


@dataclass
class WireFindings:
    """What a campaign found."""

    n_frames: int = 0
    n_damaged: int = 0
    n_accepted: int = 0
    n_packets: int = 0
    raised: list[str] = field(default_factory=list)
    corrupt: list[str] = field(default_factory=list)
    """Accepted, but never sent."""
    lost: list[str] = field(default_factory=list)
    """Intact after a delimiter or an index 0, but not accepted."""
    dropped: Counter[Defect] = field(default_factory=Counter)

    @property
    def is_good(self) -> bool:
        """Whether nothing failed."""
        return not (self.raised or self.corrupt or self.lost)

    def line(self) -> str:
        """Return the verdict in one line."""
        word = "PASS" if self.is_good else "FAIL"
        return (
            f"{word}: {self.n_frames} wire frames ({self.n_damaged} damaged), {self.n_accepted} accepted, "
            f"{self.n_packets} packets; {len(self.raised)} exceptions, {len(self.corrupt)} corrupt accepted "
            f"({self.n_damaged / 2**32:.1g} expected of CRC-32), {len(self.lost)} intact lost"
        )


class _Tap:
    """Notes the wire frames that pass from a decoder to the packets."""

    def __init__(self, frames: WireFrameDecoder) -> None:
        self.frames: list[Entry] = []
        self.dropped = frames.dropped
        self.accepted = 0
        self._inner = frames

    def entries(self, chunk: bytes) -> list[Entry]:
        """Pass on what the decoder completes, and keep it for the judgement."""
        passed = self._inner.entries(chunk)
        self.frames += passed
        return passed


class _Lane:
    """One kind of link: its traffic, its decoder, and what has been sent lately."""

    def __init__(self, name: str, source: ByteStream | CanBus, frames: WireFrameDecoder) -> None:
        self.name = name
        self.decoder = PacketDecoder(tap := _Tap(frames))
        self._tap = tap
        self._source = source
        self._sent_before: dict[int, WireFrame] = {}
        self._n_blocks = 0

    def run_block(self, verdict: WireFindings) -> None:
        """Send one block through the decoder and judge what comes out."""
        traffic = self._source.block()
        self._tap.frames = []
        packets: list[ReceivedPacket] = []
        for chunk in traffic.chunks:
            try:
                packets += self.decoder.feed(chunk)
            except Exception as error:  # whatever it is, it is a finding
                verdict.raised.append(f"{self._where()}: {error!r} for {chunk.hex()}")
        self._judge(traffic, packets, verdict)
        self._sent_before = traffic.sent
        self._n_blocks += 1

    def _judge(self, traffic: Traffic, packets: list[ReceivedPacket], verdict: WireFindings) -> None:
        accepted: Counter[int] = Counter()
        for entry in self._tap.frames:
            time_us = entry[3]
            if WireFrame(*entry) == (traffic.sent.get(time_us) or self._sent_before.get(time_us)):
                accepted[time_us] += 1
            else:
                verdict.corrupt.append(f"{self._where()}: {entry}")
        # Frames that no damage has touched must all have come.
        for time_us in traffic.required - accepted:
            verdict.lost.append(f"{self._where()}: {traffic.sent[time_us]}")
        verdict.n_frames += len(traffic.sent)
        verdict.n_damaged += traffic.n_damaged
        verdict.n_accepted += len(self._tap.frames)
        verdict.n_packets += len(packets)

    def _where(self) -> str:
        return f"{self.name}, block {self._n_blocks}"


def run(
    n_frames: int,
    seed: int,
    progress: Callable[[WireFindings], None] = lambda _: None,
    byte_stream: Callable[[], WireFrameDecoder] = FrameDecoder,
    can: Callable[[], WireFrameDecoder] = CanFrameDecoder,
) -> WireFindings:
    """Send ``n_frames`` or a few more, half on a byte stream and half on a CAN bus."""
    lanes = (
        _Lane("byte stream", ByteStream(Random(f"bytes {seed}")), byte_stream()),
        _Lane("CAN", CanBus(Random(f"CAN {seed}")), can()),
    )
    verdict = WireFindings()
    while verdict.n_frames < n_frames:
        for lane in lanes:
            lane.run_block(verdict)
        progress(verdict)
    for lane in lanes:
        verdict.dropped += lane.decoder.dropped
    return verdict


def main() -> None:
    """Run a campaign from the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m devices.emulators.faults.wire_campaign", description=__doc__
    )
    parser.add_argument("--frames", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    begin = time.monotonic()

    step = max(arguments.frames // 20, 2 * BLOCK_SIZE)
    shown = 0

    def show(verdict: WireFindings) -> None:
        nonlocal shown
        if verdict.n_frames >= shown + step:
            shown = verdict.n_frames
            seconds = time.monotonic() - begin
            print(f"{shown:>10} of {arguments.frames}, {seconds:.0f} s", file=sys.stderr, flush=True)

    verdict = run(arguments.frames, arguments.seed, show)
    for findings in (verdict.raised, verdict.corrupt, verdict.lost):
        for finding in findings[:_SHOWN_FAILURES]:
            print(finding)
    print(", ".join(f"{defect.name} {count}" for defect, count in sorted(verdict.dropped.items(), key=str)))
    print(f"{verdict.line()}, seed {arguments.seed}, {time.monotonic() - begin:.0f} s")
    sys.exit(0 if verdict.is_good else 1)


if __name__ == "__main__":
    main()
