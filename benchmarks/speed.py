"""How long the gateway's own work takes, on one core, without input and output."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial

from vqf import VQF

from benchmarks import speed_makers, speed_optical, speed_wire
from benchmarks.figures import Figure, Report, table
from benchmarks.speed_growth import SIZES, enlarged_frame, enlarged_suit
from devices.link import Chunk, Framing
from firmware_protocol import FrameDecoder, PacketDecoder
from gateway.body.skeleton import WornSuit
from gateway.emulation.simulation import LINK, relay_chunks, suit_17
from gateway.frames import ImuFrame, InertialBatch, LocalReading
from gateway.pipeline import FRAMES_AT_A_TIME, Pipeline
from gateway.reconstruction import RECONSTRUCTORS, Reconstructor, update_many
from gateway.sources.clock_mode import ClockMode
from gateway.sources.module_table import ModuleTable
from gateway.sources.suit import SuitSource
from gateway.stages.frame_assembler import AssemblyParams, FrameAssembler

PARAMS = AssemblyParams(10e6, 30_000_000, 100_000_000, 500_000_000)
REPEATS = 5
INTERVAL_S = 0.01
GROWTH_FRAMES = 300


def run() -> Report:
    """Decode, reconstruct, and the whole pipeline."""
    suit, motion = suit_17()
    chunks = relay_chunks(motion, seconds=20.0)
    singles = relay_chunks(motion, seconds=10.0, has_relay=False)
    frames = _imu_frames(suit.module_ids, chunks)
    report = Report("speed")
    report.figures = [
        *_decode_figures(chunks, singles),
        *speed_wire.figures(chunks, suit, PARAMS),
        *speed_makers.figures(),
        *_frame_figures(suit, frames),
        *_offline_figures(suit, chunks, frames),
    ]
    figures, growth = _growth(suit, frames)
    report.figures += figures
    report.tables.append(growth)
    figures, beside_opensim = speed_optical.measured()
    report.figures += figures
    report.tables.append(beside_opensim)
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
        return partial(_update_each, RECONSTRUCTORS[name](suit, INTERVAL_S), frames)

    def vqf_alone() -> int:
        filters = [VQF(INTERVAL_S) for _ in suit.module_ids]
        for frame in frames:
            for one, gyr, acc, mag in zip(
                filters, frame.angular_rate, frame.specific_force, frame.magnetic_field, strict=True
            ):
                one.update(gyr, acc, mag)
        return len(frames)

    vqf_us, joint_us, outward_us, literal_us = _best_in_turn(
        vqf_alone, *(reconstruct(name) for name in ("joint", "outward", "articulated"))
    )
    return [
        Figure("frame_17_us", joint_us, "µs", "<=100", "`joint`, 17 segments, one frame"),
        Figure("frame_17_ratio_vqf", joint_us / vqf_us, "", "<=2", "the same over 17 single `vqf` updates"),
        Figure("frame_17_outward_us", outward_us, "µs", "<=25", "`outward`, 17 segments, one frame"),
        Figure("frame_17_outward_ratio_vqf", outward_us / vqf_us, "", "<=1.2", "the same over these updates"),
        Figure("frame_17_literal_us", literal_us, "µs", "", "`articulated`, 17 segments, one frame"),
        Figure("vqf_17_us", vqf_us, "µs", "", "17 single updates of the library vqf, from Python"),
    ]


def _offline_figures(suit: WornSuit, chunks: list[Chunk], frames: list[ImuFrame]) -> list[Figure]:
    def from_frames(name: str) -> Callable[[], int]:
        reconstructor = RECONSTRUCTORS[name](suit, INTERVAL_S)

        def work() -> int:
            reconstructor.reset()
            blocks = range(0, len(frames), FRAMES_AT_A_TIME)
            return sum(len(update_many(reconstructor, frames[k : k + FRAMES_AT_A_TIME])) for k in blocks)

        return work

    def from_bytes(name: str) -> Callable[[], int]:
        def work() -> int:
            whole = Pipeline(suit, PARAMS, name, ClockMode.ESTIMATED)
            whole.add_link(LINK, Framing.BYTE_STREAM)
            return sum(1 for _ in whole.replay(chunks))

        return work

    joint, outward, joint_bytes, independent = (
        1e6 * INTERVAL_S / us
        for us in _best_in_turn(
            from_frames("joint"), from_frames("outward"), from_bytes("joint"), from_bytes("independent")
        )
    )
    decoded = "frames of 17 modules at 100 Hz to skeleton, as a recording is processed"
    whole = "bytes to skeleton of 17 modules at 100 Hz, whole pipeline"
    return [
        Figure("offline_x_realtime", joint, "×", ">=100", f"{decoded}, `joint`"),
        Figure("offline_outward_x_realtime", outward, "×", ">=400", f"{decoded}, `outward`"),
        Figure("offline_bytes_x_realtime", joint_bytes, "×", "", f"{whole}, `joint`"),
        Figure("offline_bytes_ratio", joint_bytes / joint, "", ">=0.6", "that over `offline_x_realtime`"),
        Figure("offline_independent_x_realtime", independent, "×", "", f"{whole}, `independent`"),
    ]


def _growth(suit: WornSuit, frames: list[ImuFrame]) -> tuple[list[Figure], str]:
    """Figures, and a table: µs of a frame by the number of segments."""
    rows, us = [], {}
    for n in SIZES:
        worn = enlarged_suit(suit, n)
        many = [enlarged_frame(suit, frame, n) for frame in frames[:GROWTH_FRAMES]]
        times = []
        for name in ("joint", "outward"):
            reconstructor = RECONSTRUCTORS[name](worn, INTERVAL_S)
            update_many(reconstructor, many)  # headings have been shown
            times.append(_best_us(partial(_update_each, reconstructor, many)))
        us[n] = times[0]
        rows.append(
            [str(n), f"{times[0]:.1f}", f"{times[0] / n:.2f}", f"{times[1]:.1f}", f"{times[1] / n:.2f}"]
        )
    heads = ["segments", "`joint`, µs", "a segment", "`outward`, µs", "a segment"]
    figures = [
        Figure("frame_1024_us", us[1024], "µs", "", "`joint`, 1024 segments, one frame"),
        Figure(
            "frame_growth",
            us[1024] / us[64] / 16,
            "",
            "<=1.25",
            "time a segment at 1024 segments over that at 64: 1 is linear",
        ),
    ]
    return figures, "Time of one frame by the number of segments, live:\n\n" + table(heads, rows)


def _update_each(reconstructor: Reconstructor, frames: list[ImuFrame]) -> int:
    reconstructor.reset()
    for frame in frames:
        reconstructor.update(frame)
    return len(frames)


def _best_us(work: Callable[[], int]) -> float:
    """Least processor time of one unit of work, µs: the machine is shared, and noise only ever adds."""
    return _best_in_turn(work)[0]


def _best_in_turn(*works: Callable[[], int]) -> list[float]:
    """The same of each, in turn: what slows the machine for a while slows all of them."""
    times: list[list[float]] = [[] for _ in works]
    for _ in range(REPEATS):
        for work, spent in zip(works, times, strict=True):
            begin = time.process_time()
            count = work()
            spent.append((time.process_time() - begin) / count * 1e6)
    return [min(spent) for spent in times]


def _imu_frames(module_ids: tuple[int, ...], chunks: list[Chunk]) -> list[ImuFrame]:
    stream, assembler = SuitSource(ModuleTable(ClockMode.SHARED)), FrameAssembler(module_ids, PARAMS)
    stream.add_link(LINK, Framing.BYTE_STREAM)
    frames: list[ImuFrame] = []
    for chunk in chunks:
        for reading in stream.receive(chunk):
            if isinstance(reading, LocalReading):
                assembler.add_local(reading)
            elif isinstance(reading, InertialBatch):
                frames += assembler.add(reading.samples, chunk.arrived_ns)
    return frames
