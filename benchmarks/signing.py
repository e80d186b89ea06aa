"""What signatures cost the gateway: the same traffic decoded without and with them, in turn."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

from benchmarks.figures import Figure, Report, table
from devices.link import Chunk, Framing
from firmware_protocol import FrameDecoder, PacketDecoder
from firmware_protocol.signing import KEY_SIZE, SignedFrames
from gateway.emulation.simulation import LINK, relay_chunks, suit_17
from gateway.sources.clock_mode import ClockMode
from gateway.sources.module_table import ModuleTable
from gateway.sources.suit import SuitSource

REPEATS = 120
SECONDS = 1.0
_KEY = bytes(range(KEY_SIZE))
Read = Callable[[bytes], bytes]


def run() -> Report:
    """Decode relay batches and single samples, to packets and to readings."""
    _, motion = suit_17()
    traffic = {
        "relay batches of 17 samples": relay_chunks(motion, seconds=SECONDS),
        "a sample in each wire frame": relay_chunks(motion, seconds=SECONDS, has_relay=False),
    }
    works: dict[str, Callable[[list[Chunk], Read], int]] = {"packets": _packets, "readings": _readings}
    rows, added = [], []
    for name, chunks in traffic.items():
        for to, work in works.items():
            plain_us, signed_us = _compared(work, chunks)
            added.append(100 * (signed_us / plain_us - 1))
            rates = [f"{1e6 / us:.0f}" for us in (plain_us, signed_us)]
            frame_us = (signed_us - plain_us) * work(chunks, bytes) / len(chunks)
            rows.append([name, to, *rates, f"{added[-1]:.1f}", f"{frame_us:.2f}"])
    heads = ["wire frames", "decoded to", "1/s", "1/s signed", "added, %", "a wire frame, µs"]
    whats = [f"time added to decoding {name} to {to}" for name in traffic for to in works]
    names = ("batches_to_packets", "batches_to_readings", "singles_to_packets", "singles_to_readings")
    report = Report("signing")
    report.figures = [
        Figure(f"signing_{figure}_percent", percent, "%", "<=5" if figure == names[1] else "", what)
        for figure, percent, what in zip(names, added, whats, strict=True)
    ]
    text = f"Samples decoded a second of one core's time, the best of {REPEATS} turns each:"
    report.tables.append(f"{text}\n\n{table(heads, rows)}")
    return report


def _packets(chunks: list[Chunk], read: Read) -> int:
    decoder = PacketDecoder(FrameDecoder())
    for chunk in chunks:
        decoder.feed(read(chunk.data))
    return decoder.accepted


def _readings(chunks: list[Chunk], read: Read) -> int:
    stream = SuitSource(ModuleTable(ClockMode.SHARED))
    stream.add_link(LINK, Framing.BYTE_STREAM)
    for chunk in chunks:
        stream.receive(replace(chunk, data=read(chunk.data)))
    return stream.readings


def _compared(work: Callable[[list[Chunk], Read], int], chunks: list[Chunk]) -> tuple[float, float]:
    """Least processor time of one sample, µs, without and with signatures: noise only ever adds."""
    module = SignedFrames(_KEY, signer=1)
    signed = [replace(chunk, data=module.sign(chunk.data)) for chunk in chunks]
    plain_us, signed_us = [], []
    for _ in range(REPEATS):
        plain_us.append(_timed_us(work, chunks, bytes))
        signed_us.append(_timed_us(work, signed, SignedFrames(_KEY).feed))
    return min(plain_us), min(signed_us)


def _timed_us(work: Callable[[list[Chunk], Read], int], chunks: list[Chunk], read: Read) -> float:
    begin = time.process_time()
    count = work(chunks, read)
    return (time.process_time() - begin) / count * 1e6
