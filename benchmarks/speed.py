"""How long the gateway's own work takes, on one core, without input and output."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from vqf import VQF

from benchmarks.emulated_stream import LINK, relay_chunks, suit_17
from benchmarks.figures import Figure, Report
from devices.link import Chunk, Framing
from firmware_protocol import FrameDecoder, PacketDecoder
from gateway.assembly import AssemblyParams, FrameAssembler
from gateway.body.skeleton import WornSuit
from gateway.frames import ImuFrame, LocalReading
from gateway.pipeline import Pipeline
from gateway.reconstruction import RECONSTRUCTORS
from gateway.stream import ClockMode, Stream

PARAMS = AssemblyParams(10e6, 30_000_000, 100_000_000, 500_000_000)
REPEATS = 5


def run() -> Report:
    """Decode, reconstruct, and the whole pipeline."""
    suit, motion = suit_17()
    chunks = relay_chunks(motion, seconds=20.0)
    singles = relay_chunks(motion, seconds=10.0, has_relay=False)
    report = Report("speed")
    report.figures = [
        *_decode_figures(chunks, singles),
        *_frame_figures(suit, _imu_frames(suit.module_ids, chunks)),
        *_pipeline_figures(suit, chunks),
    ]
    return report


def _decode_figures(chunks: list[Chunk], singles: list[Chunk]) -> list[Figure]:
    def decode(data: list[Chunk]) -> Callable[[], int]:
        def work() -> int:
            decoder = PacketDecoder(FrameDecoder())
            for chunk in data:
                decoder.feed(chunk.data)
            return decoder.accepted

        return work

    batches = "packets of 17 modules in relay batches; 64 modules at 1000 Hz in half a core is the target"
    alone = "the same, every packet in a wire frame and chunk of its own"
    return [
        Figure("decode_packets_per_s", 1e6 / _best_us(decode(chunks)), "1/s", ">=128000", batches),
        Figure("decode_single_packets_per_s", 1e6 / _best_us(decode(singles)), "1/s", "", alone),
    ]


def _frame_figures(suit: WornSuit, frames: list[ImuFrame]) -> list[Figure]:
    def reconstruct(name: str) -> Callable[[], int]:
        reconstructor = RECONSTRUCTORS[name](suit, 0.01)

        def work() -> int:
            reconstructor.reset()
            for frame in frames:
                reconstructor.update(frame)
            return len(frames)

        return work

    def vqf_alone() -> int:
        filters = [VQF(0.01) for _ in suit.module_ids]
        for frame in frames:
            for one, gyr, acc, mag in zip(
                filters, frame.angular_rate, frame.specific_force, frame.magnetic_field, strict=True
            ):
                one.update(gyr, acc, mag)
        return len(frames)

    vqf_us = _best_us(vqf_alone)
    joint_us, outward_us, literal_us = (
        _best_us(reconstruct(name)) for name in ("joint", "outward", "articulated")
    )
    return [
        Figure("frame_17_us", joint_us, "µs", "<=100", "`joint`, 17 segments, one frame"),
        Figure("frame_17_ratio_vqf", joint_us / vqf_us, "", "", "the same over 17 single `vqf` updates"),
        Figure("frame_17_outward_us", outward_us, "µs", "<=25", "`outward`, 17 segments, one frame"),
        Figure("frame_17_literal_us", literal_us, "µs", "", "`articulated`, 17 segments, one frame"),
        Figure("vqf_17_us", vqf_us, "µs", "", "17 single updates of the library vqf, from Python"),
    ]


def _pipeline_figures(suit: WornSuit, chunks: list[Chunk]) -> list[Figure]:
    def speed(name: str) -> float:
        def work() -> int:
            whole = Pipeline(suit, PARAMS, name, ClockMode.ESTIMATED)
            whole.add_link(LINK, Framing.BYTE_STREAM)
            return sum(len(whole.feed(chunk)) for chunk in chunks)

        return 1e6 / _best_us(work) / 100

    bytes_to_skeleton = "bytes to skeleton of 17 modules at 100 Hz, `joint`, whole pipeline"
    return [
        Figure("offline_x_realtime", speed("joint"), "×", ">=100", bytes_to_skeleton),
        Figure(
            "offline_independent_x_realtime", speed("independent"), "×", "", "the same with `independent`"
        ),
    ]


def _best_us(work: Callable[[], int]) -> float:
    """Least time of one unit of work, µs: the machine is shared, and noise only ever adds."""
    times = []
    for _ in range(REPEATS):
        begin = time.perf_counter()
        count = work()
        times.append((time.perf_counter() - begin) / count * 1e6)
    return float(np.min(times))


def _imu_frames(module_ids: tuple[int, ...], chunks: list[Chunk]) -> list[ImuFrame]:
    stream, assembler = Stream(ClockMode.SHARED), FrameAssembler(module_ids, PARAMS)
    stream.add_link(LINK, Framing.BYTE_STREAM)
    frames: list[ImuFrame] = []
    for chunk in chunks:
        for reading in stream.receive(chunk):
            if isinstance(reading, LocalReading):
                assembler.add_local(reading)
            else:
                frames += assembler.add(reading, chunk.arrived_ns)
    return frames
