"""How long bytes of a link take to samples and to frames, on one core, beside a floor of the same bytes."""

from __future__ import annotations

import time
import zlib
from collections.abc import Callable, Sequence

from benchmarks.figures import Figure
from devices.link import Chunk, Framing
from firmware_protocol import (
    DELIMITER,
    FrameDecoder,
    InertialSample,
    PacketDecoder,
    ReceivedPacket,
    WireFrame,
    encode_frame,
    fragment,
    pack_can_records,
    relay_batch,
    wire_frame,
)
from gateway.body.skeleton import WornSuit
from gateway.pipeline import Pipeline
from gateway.sources.module_table import ModuleTable
from gateway.sources.suit import SuitSource
from gateway.stages.frame_assembler import AssemblyParams

REPEATS = 5
OPENING = 0.5
"""Share of the chunks that goes before: clocks at first take their packets in again and again."""
_LINK = "suit"


def figures(chunks: Sequence[Chunk], suit: WornSuit, params: AssemblyParams) -> list[Figure]:
    """Return the time of a packet of 17 inertial modules by each way to send it. chunks: of relay batches."""
    instants = [(chunk.arrived_ns, _samples(chunk)) for chunk in chunks]
    batches = [_chunk(at_ns, encode_frame(_batch(packets))) for at_ns, packets in instants]
    frames = [(at_ns, _frame(packet)) for at_ns, packets in instants for packet in packets]
    singles = [_chunk(at_ns, encode_frame(frame)) for at_ns, frame in frames]
    on_can = [_chunk(at_ns, pack_can_records(fragment(frame))) for at_ns, frame in frames]
    batch_us, readable_us, frame_us, floor_us = _best_us(
        lambda: _stream_s(batches),
        lambda: _stream_s(batches, is_compiled=False),
        lambda: _frames_s(batches, Pipeline(suit, params)),
        lambda: _floor_s(batches),
    )
    single_us, can_us = _best_us(lambda: _stream_s(singles), lambda: _stream_s(on_can, Framing.CAN))
    packet = "one packet of a batch of 17: decoding, counters, its module's clock"
    alone = "every packet in a chunk of its own, to samples in gateway time"
    return [
        Figure("bytes_to_samples_us", batch_us, "µs", "<=1", packet),
        Figure("bytes_to_frame_us", frame_us, "µs", "<=2", f"{packet}, its share of the frame of all 17"),
        Figure("bytes_to_samples_readable_us", readable_us, "µs", "", "the same the readable way"),
        Figure(
            "bytes_to_samples_floor_us",
            floor_us,
            "µs",
            "",
            "CRC-32 and delimiters alone, by C of the library",
        ),
        Figure("single_packets_to_samples_per_s", 1e6 / single_us, "1/s", "", f"byte stream, {alone}"),
        Figure("can_packets_to_samples_per_s", 1e6 / can_us, "1/s", "", f"CAN, {alone}"),
    ]


def _samples(chunk: Chunk) -> list[ReceivedPacket]:
    packets = PacketDecoder(FrameDecoder()).feed(chunk.data)
    return [packet for packet in packets if isinstance(packet.packet, InertialSample)]


def _frame(received: ReceivedPacket) -> WireFrame:
    return wire_frame(received.packet, received.module, received.sequence, received.module_time_us)


def _batch(packets: Sequence[ReceivedPacket]) -> WireFrame:
    relayed_us = packets[0].relayed_us if packets else 0
    assert relayed_us is not None
    return relay_batch([_frame(packet) for packet in packets], 0, relayed_us)


def _chunk(arrived_ns: int, data: bytes) -> Chunk:
    return Chunk(data, arrived_ns, _LINK)


def _stream_s(
    chunks: Sequence[Chunk], framing: Framing = Framing.BYTE_STREAM, *, is_compiled: bool = True
) -> tuple[float, int]:
    """Return processor time and samples, once clocks are known."""
    stream = SuitSource(ModuleTable(is_compiled=is_compiled))
    stream.add_link(_LINK, framing)
    first = int(OPENING * len(chunks))
    for chunk in chunks[:first]:
        stream.receive(chunk)
    before, begin = stream.readings, time.process_time()
    for chunk in chunks[first:]:
        stream.receive(chunk)
    return time.process_time() - begin, stream.readings - before


def _frames_s(chunks: Sequence[Chunk], pipeline: Pipeline) -> tuple[float, int]:
    """Return processor time of the way to frames of all modules, and samples, once clocks are known."""
    pipeline.add_link(_LINK, Framing.BYTE_STREAM)
    first = int(OPENING * len(chunks))
    for chunk in chunks[:first]:
        pipeline.imu_frames(chunk)
    before, begin = pipeline.stream.readings, time.process_time()
    for chunk in chunks[first:]:
        pipeline.imu_frames(chunk)
    return time.process_time() - begin, pipeline.stream.readings - before


def _floor_s(batches: Sequence[Chunk]) -> tuple[float, int]:
    """Return the same of splitting at delimiters and a CRC-32 over all bytes."""
    n_packets = sum(len(_samples(chunk)) for chunk in batches)
    begin = time.process_time()
    for chunk in batches:
        for encoded in chunk.data.split(DELIMITER):
            zlib.crc32(encoded)
    return time.process_time() - begin, n_packets


def _best_us(*works: Callable[[], tuple[float, int]]) -> list[float]:
    """Return the least time of a packet by each, µs, all of them in turns: noise only ever adds."""
    turns = [[1e6 * seconds / n for seconds, n in (work() for work in works)] for _ in range(REPEATS)]
    return [min(times) for times in zip(*turns, strict=True)]
