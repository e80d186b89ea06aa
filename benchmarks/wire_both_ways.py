"""The wire campaign's traffic through kernels and the readable way: all that comes of it must be equal.

::

    python -m benchmarks.wire_both_ways --frames 10000000 --seed 1

Half of the wire frames go over a byte stream, half over a CAN bus, damaged as in
``devices.emulators.faults.wire_campaign``, which judges the readable decoders by what was sent. The exit code
is 1 when anything differs.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from random import Random

from devices.emulators.faults.wire_damage import BLOCK_SIZE, ByteStream, CanBus
from devices.link import Chunk, Framing
from gateway.emulation.both_ways import BothWays, BothWaysDiffer
from gateway.sources.clock_mode import ClockMode
from gateway.sources.module_table import ModuleTable
from gateway.sources.suit import SuitSource

START_NS = 1_800_000_000_000_000_000
_LINK = "suit"
_BLOCKS = 64
"""So often accounts are compared; readings are with every chunk."""


@dataclass
class Account:
    """What went both ways."""

    frames: int = 0
    damaged: int = 0
    packets: int = 0
    """Accepted by the decoders."""
    readings: int = 0
    dropped: Counter[str] = field(default_factory=Counter)

    def line(self) -> str:
        """All of it in one line."""
        drops = ", ".join(f"{reason} {count}" for reason, count in sorted(self.dropped.items()))
        return (
            f"{self.frames} wire frames ({self.damaged} damaged), {self.packets} packets, "
            f"{self.readings} readings; dropped: {drops}"
        )


class _Lane:
    """One link: its traffic, and the two streams that take it."""

    def __init__(self, framing: Framing, source: ByteStream | CanBus, mode: ClockMode) -> None:
        self.both = BothWays(lambda is_compiled: SuitSource(ModuleTable(mode, is_compiled=is_compiled)))
        self.both.add_link(_LINK, framing)
        self._source = source
        self._n_blocks = 0

    def run_block(self, account: Account) -> None:
        """Send one block both ways. Raises ``BothWaysDiffer``."""
        traffic = self._source.block()
        now_ns = START_NS + max(traffic.sent) * 1000  # clocks show the microsecond of their wire frames
        for chunk in traffic.chunks:
            self.both.receive(Chunk(chunk, now_ns, _LINK))
        self._n_blocks += 1
        if self._n_blocks % _BLOCKS == 0:
            self.both.compare_accounts()
        account.frames += len(traffic.sent)
        account.damaged += traffic.n_damaged

    def close(self, account: Account) -> None:
        """Add what was counted on the whole. Raises ``BothWaysDiffer``."""
        self.both.compare_accounts()
        stream = self.both.compiled
        account.packets += sum(decoder.accepted for decoder in stream.decoders())
        account.readings += stream.readings
        account.dropped.update(stream.dropped()[_LINK])


def run(
    n_frames: int,
    seed: int,
    mode: ClockMode = ClockMode.SHARED,
    progress: Callable[[Account], None] = lambda _: None,
) -> Account:
    """Send ``n_frames`` or a few more both ways. Raises ``BothWaysDiffer`` at the first that there is."""
    lanes = (
        _Lane(Framing.BYTE_STREAM, ByteStream(Random(f"bytes {seed}")), mode),
        _Lane(Framing.CAN, CanBus(Random(f"CAN {seed}")), mode),
    )
    account = Account()
    while account.frames < n_frames:
        for lane in lanes:
            lane.run_block(account)
        progress(account)
    for lane in lanes:
        lane.close(account)
    return account


def main() -> None:
    """Run a campaign from the command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.wire_both_ways", description=__doc__)
    parser.add_argument("--frames", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--clock", type=ClockMode, choices=list(ClockMode), default=ClockMode.SHARED)
    arguments = parser.parse_args()
    begin, step, shown = time.monotonic(), max(arguments.frames // 20, 2 * BLOCK_SIZE), 0

    def show(account: Account) -> None:
        nonlocal shown
        if account.frames >= shown + step:
            shown = account.frames
            seconds = time.monotonic() - begin
            print(f"{shown:>10} of {arguments.frames}, {seconds:.0f} s", file=sys.stderr, flush=True)

    try:
        account = run(arguments.frames, arguments.seed, arguments.clock, show)
    except BothWaysDiffer as difference:
        sys.exit(f"FAIL: {difference}")
    print(f"PASS: {account.line()}; seed {arguments.seed}, {time.monotonic() - begin:.0f} s")


if __name__ == "__main__":
    main()
