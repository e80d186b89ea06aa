"""What clock compensation is worth in degrees: a fast arm, from wire bytes to orientations.

The same modules, with the same samples, over a perfect link by perfect clocks are what each mode is
compared with, so that what the orientation filter is off by by itself is left out; it is shown beside it.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation, RotationSpline

from benchmarks.figures import Figure, table
from devices.emulators import Imperfections, SuitSettings, SuitTraffic, generic_motion
from devices.emulators.motion.motions import BodyMotion
from devices.link import Chunk, Framing
from firmware_protocol import FrameDecoder, PacketDecoder
from gateway.body.rig import load_rig
from gateway.body.skeleton import WornSuit
from gateway.clocks import ClockCalibration, ClockTable, LinkBatching
from gateway.emulation.rig import dress
from gateway.frames import FloatArray, SkeletonFrame
from gateway.pipeline import Pipeline
from gateway.service.host_sender import HostSender
from gateway.service.synchronisation import Synchroniser
from gateway.sources.clock_mode import ClockMode
from gateway.stages.frame_assembler import AssemblyParams

RIG = "robot_arm_4"
LINK = "suit"
SEED = 4
SECONDS = 180.0
SHOWN_FROM_S = 120.0
STEP_S = 0.05
EXCHANGE_INTERVAL_S = 0.25
PEAK_RATE, PEAK_ACCELERATION = 10.0, 100.0
"""Of the fastest segment, rad/s and rad/s²."""
EVERY = 4
"""Frames compared: each so many-th."""
_LARGEST_SHIFT_S = 0.05

PERFECT = Imperfections(has_random_clock_start=True, has_random_phase=True)
REAL = replace(PERFECT, clock_skew_ppm=100.0, latency=0.0005, jitter=0.001, batching=0.001)
COARSE = replace(REAL, batching=0.016)


class _EmulatedLink:
    """The host's end of the suit, in simulated time."""

    name = LINK
    framing = Framing.BYTE_STREAM

    def __init__(self, traffic: SuitTraffic) -> None:
        self.now_s = 0.0
        self._traffic = traffic

    def clock_ns(self) -> int:
        return round(self.now_s * 1e9)

    def step(self) -> list[Chunk]:
        """What comes in the next moment."""
        self.now_s += STEP_S
        sent = self._traffic.advance(self.now_s)
        return [Chunk(each.data, round(each.time_s * 1e9), LINK) for each in sent]

    async def write(self, data: bytes, to: Sequence[str] = ()) -> None:
        self._traffic.receive(data, self.now_s)


def suit() -> tuple[WornSuit, BodyMotion]:
    """The arm and its motion."""
    worn = load_rig(RIG)
    motion = generic_motion(
        dress(worn), SEED, peak_angular_rate=PEAK_RATE, peak_angular_acceleration=PEAK_ACCELERATION
    )
    return worn, motion


async def capture(
    worn: WornSuit,
    motion: BodyMotion,
    imperfections: Imperfections,
    mode: ClockMode,
    clock_table: ClockTable | None = None,
    asks: bool = False,
) -> list[SkeletonFrame]:
    """Poses of the whole run, from wire bytes. asks: time is asked for, as a running gateway does."""
    params = AssemblyParams(1e7, max_wait_ns=60_000_000, max_gap_ns=100_000_000, hold_ns=500_000_000)
    pipeline = Pipeline(worn, params, "independent", mode, clock_table=clock_table)
    pipeline.add_link(LINK, Framing.BYTE_STREAM)
    link = _EmulatedLink(SuitTraffic(motion, SuitSettings(), imperfections, SEED))
    sender = HostSender(pipeline.stream.sent, link.clock_ns)
    synchroniser = Synchroniser([link], sender, EXCHANGE_INTERVAL_S, link.clock_ns)  # type: ignore[list-item]
    frames: list[SkeletonFrame] = []
    steps_between = round(EXCHANGE_INTERVAL_S / STEP_S)
    for n in range(round(SECONDS / STEP_S)):
        if asks and n % steps_between == 0:
            await synchroniser.request_all()
        for chunk in link.step():
            frames += pipeline.feed(chunk)
    return frames


def measured_table(worn: WornSuit, motion: BodyMotion) -> ClockTable:
    """The table of another capture by the same modules."""
    calibration = ClockCalibration(worn.module_ids, minutes=2)
    decoder, batching = PacketDecoder(FrameDecoder()), LinkBatching()
    link = _EmulatedLink(SuitTraffic(motion, SuitSettings(), REAL, SEED))
    while not calibration.is_complete:
        for chunk in link.step():
            batching.observe(chunk.arrived_ns)
            for packet in decoder.feed(chunk.data):
                calibration.observe(packet.module, packet.module_time_us, chunk.arrived_ns, batching)
    return calibration.table()


def joint_angles(frames: list[SkeletonFrame], parents: list[int]) -> tuple[FloatArray, list[Rotation]]:
    """Times (T,) in s, and every joint's rotation at them, of the frames at the end of a run."""
    shown = [f for f in frames if f.time_ns >= SHOWN_FROM_S * 1e9]
    times = np.array([f.time_ns for f in shown]) * 1e-9
    return times, _joints(np.stack([f.q_wb for f in shown]), parents)


def _joints(q_wb: FloatArray, parents: list[int]) -> list[Rotation]:
    segments = [Rotation.from_quat(q_wb[:, s], scalar_first=True) for s in range(q_wb.shape[1])]
    return [segments[p].inv() * segments[s] for s, p in enumerate(parents) if p >= 0]


def rmse_deg(times: FloatArray, joints: list[Rotation], at: Callable[[FloatArray], list[Rotation]]) -> float:
    """Error of joint rotations against a reference at the same instants, degrees.

    The one delay that all modules have in common, which no receiver can know, is fitted and left out.
    """
    picked = np.arange(len(times)) % EVERY == 0

    def mean_square(shift_s: float) -> float:
        expected = at(times[picked] - shift_s)
        errors = [(j[picked].inv() * e).magnitude() for j, e in zip(joints, expected, strict=True)]
        return float(np.mean(np.square(errors)))

    best = minimize_scalar(mean_square, bounds=(-_LARGEST_SHIFT_S, _LARGEST_SHIFT_S), method="bounded")
    return float(np.degrees(np.sqrt(best.fun)))


def clocks_in_degrees() -> tuple[list[Figure], str]:
    """Figures of all modes, and their table."""
    worn, motion = suit()
    parents = worn.skeleton.parents.tolist()
    perfect = joint_angles(asyncio.run(capture(worn, motion, PERFECT, ClockMode.SHARED)), parents)
    splines = [RotationSpline(perfect[0], joint) for joint in perfect[1]]
    clock_table = measured_table(worn, motion)
    modes = {
        "none": ("none: rate as stamped", capture(worn, motion, REAL, ClockMode.SHARED)),
        "table": ("1, table", capture(worn, motion, REAL, ClockMode.TABLE, clock_table)),
        "arrival_16ms": (
            "arrival times, 16 ms batching", capture(worn, motion, COARSE, ClockMode.ESTIMATED)
        ),
        "arrival": ("arrival times, 1 ms batching", capture(worn, motion, REAL, ClockMode.ESTIMATED)),
        "exchanges": (
            "two-way exchanges, 1 ms batching", capture(worn, motion, REAL, ClockMode.ESTIMATED, asks=True)
        ),
    }  # fmt: skip
    first, last = perfect[0][0] + _LARGEST_SHIFT_S, perfect[0][-1] - _LARGEST_SHIFT_S

    def true_joints(times: FloatArray) -> list[Rotation]:
        return _joints(motion.state(times).q_wb, parents)

    def perfect_joints(times: FloatArray) -> list[Rotation]:
        return [spline(np.clip(times, perfect[0][0], perfect[0][-1])) for spline in splines]

    rows = [["perfect clocks and link", "0.00", f"{rmse_deg(*perfect, true_joints):.2f}"]]
    figures = []
    for name, (title, running) in modes.items():
        times, joints = joint_angles(asyncio.run(running), parents)
        inside = (times > first) & (times < last)
        times, joints = times[inside], [joint[inside] for joint in joints]
        due, total = rmse_deg(times, joints, perfect_joints), rmse_deg(times, joints, true_joints)
        rows.append([title, f"{due:.2f}", f"{total:.2f}"])
        note = f"joint rotations of a fast arm, RMSE due to clocks: {title}"
        figures.append(Figure(f"orientation_{name}_deg", due, "°", "", note))
    text = (
        "## Orientation, through the whole pipeline\n\n"
        f"An emulated arm of {len(parents)} modules, peaks of {PEAK_RATE:g} rad/s and "
        f"{PEAK_ACCELERATION:g} rad/s², ideal sensors at 100 Hz, crystals to ±100 ppm, "
        "0.5 ms + exponential of mean 1 ms; wire bytes → clocks → frames → `independent`. Rotations of the "
        f"joints from {SHOWN_FROM_S:g} s to {SECONDS:g} s. *due to clocks*: against the same modules by "
        "perfect clocks over a perfect link. *total*: against the truth, with what the orientation filter "
        "is off by. Without compensation the error grows with time.\n\n"
    )
    return figures, text + table(["mode", "due to clocks °", "total °"], rows)
