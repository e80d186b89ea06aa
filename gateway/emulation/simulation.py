"""Simulated motion with known truth, as frames, as wire bytes or through the whole pipeline; and errors."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from devices.deferred import Rotation
from devices.emulators.bodies import EmulatedBody
from devices.emulators.imperfections import IDEAL, Imperfections
from devices.emulators.motion.motions import BodyMotion
from devices.emulators.motion.waves import Fade
from devices.emulators.sensing.ideal_sensors import sense
from devices.emulators.suit_traffic import SuitSettings, SuitTraffic
from devices.link import Chunk, Framing
from gateway.body.rig import load_rig
from gateway.body.skeleton import WornSuit, field_vector
from gateway.emulation.rig import dress, move
from gateway.frames import FloatArray, ImuFrame, IntArray, SkeletonFrame
from gateway.geometry.comparison import coverage_percent, orientation_error, rmse_deg
from gateway.pipeline import Pipeline
from gateway.sources.clock_mode import ClockMode
from gateway.stages.frame_assembler import AssemblyParams

LINK = "suit"
SENSORS = Imperfections(
    accelerometer_noise=0.03,
    gyroscope_noise=np.radians(0.1),
    magnetometer_noise=0.5,
    accelerometer_bias=0.05,
    gyroscope_bias=np.radians(0.3),
    gyroscope_bias_walk=np.radians(0.005),
    scale=0.002,
    placement=0.01,
)
"""Consumer sensors with lever arms that are 1 cm off."""
DIP_DEG = 25.0
"""Of the simulated field where the method itself is tried, not its weakness in steep fields."""
ALREADY_MOVING = Fade(rest_s=-10.0, ramp_s=1.0)
"""For motions without a rest before them."""

WALK_FROM_S = 5.0
"""Filters start anywhere; the walk sets off at 2.75 s."""

PLACEMENTS = {
    "on the joints": (0.0, 0.0, 0.0),
    "0.12 m beside the joints": (0.12, 0.05, 0.0),
    "0.12 m up the links": (0.03, 0.0, 0.12),
}
"""Where each module sits on its link, from the proximal joint, m; neutral links stand upright."""


class WalkResult(NamedTuple):
    """Errors of one walk."""

    total_deg: float
    """RMSE of the orientations, mean of the segments."""
    tilt_deg: float
    covered_percent: float
    """Of the orientation errors within two sigma; NaN without."""
    distance_m: float
    length_error: float
    """Relative, of the path."""
    end_error: float
    """Of the place at the end, over the path's length."""
    height_error_m: float
    switches: int
    largest_step_deg: float
    """Largest change of any segment's orientation error from the frame before a switch to the one after."""


def arm(position: tuple[float, float, float]) -> WornSuit:
    """Return the shipped robot arm with all modules at the same place of their links."""
    suit = load_rig("robot_arm_4")
    lever_arms = np.tile(position, (suit.skeleton.n_segments, 1))
    return replace(suit, lever_arms=lever_arms, magnetic_field=field_vector(50.0, DIP_DEG))


def ideal_frames(
    suit: WornSuit, body: EmulatedBody, motion: BodyMotion, times_ns: IntArray, has_gyroscopes: bool
) -> Iterator[ImuFrame]:
    """Yield noise-free frames at given times, in sensor axes, in the order of the rig's modules.

    Computed in extended precision where the machine has it, and rounded once: the sensors' values are
    then exact to the last bit, which the method without gyroscopes would notice.
    """
    n = len(suit.module_ids)
    R_bs = Rotation.from_quat(body.sensor_to_segment, scalar_first=True).as_matrix()
    state = motion.state(times_ns / np.longdouble(1e9))
    values = sense(state, body.module_positions, R_bs, suit.gravity, suit.magnetic_field)
    for k, time_ns in enumerate(times_ns):
        yield ImuFrame(
            sequence=k,
            time_ns=int(time_ns),
            specific_force=values.specific_force[k].astype(np.float64),
            angular_rate=values.angular_rate[k].astype(np.float64)
            if has_gyroscopes
            else np.full((n, 3), np.nan),
            magnetic_field=values.magnetic_field[k].astype(np.float64),
            status=np.zeros(n, dtype=np.uint8),
            gap_ns=np.zeros(n, dtype=np.int64),
        )


def assembled(
    suit: WornSuit, motion: BodyMotion, imperfections: Imperfections, seconds: float, seed: int
) -> list[ImuFrame]:
    """Return frames of an emulated suit at 100 Hz with all its errors, bytes and all: for several methods."""
    pipeline = _pipeline(suit, "independent")
    sent = _sent(suit, motion, imperfections, seconds, seed)
    return [frame for chunk in sent for frame in pipeline.imu_frames(chunk)]


def through_the_wire(
    suit: WornSuit,
    motion: BodyMotion,
    imperfections: Imperfections,
    reconstructor: str,
    seconds: float,
    seed: int,
) -> list[SkeletonFrame]:
    """Return the same, solved as they come."""
    pipeline = _pipeline(suit, reconstructor)
    sent = _sent(suit, motion, imperfections, seconds, seed)
    return [frame for chunk in sent for frame in pipeline.feed(chunk)]


def _pipeline(suit: WornSuit, reconstructor: str) -> Pipeline:
    params = AssemblyParams(10e6, 30_000_000, 100_000_000, 500_000_000)
    pipeline = Pipeline(suit, params, reconstructor, ClockMode.ESTIMATED)
    pipeline.add_link(LINK, Framing.BYTE_STREAM)
    return pipeline


def _sent(
    suit: WornSuit, motion: BodyMotion, imperfections: Imperfections, seconds: float, seed: int
) -> Iterator[Chunk]:
    settings = SuitSettings(gravity=suit.gravity, magnetic_field=suit.magnetic_field, is_fine=True)
    traffic = SuitTraffic(motion, settings, imperfections, seed)
    for sent in traffic.transmissions(seconds):
        yield Chunk(sent.data, round(sent.time_s * 1e9), LINK)


def suit_17() -> tuple[WornSuit, BodyMotion]:
    """Return the shipped 17-module suit and a walking person in it."""
    suit = load_rig("suit_17")
    return suit, move(dress(suit), suit.skeleton.name, seed=1)


def relay_chunks(
    motion: BodyMotion,
    seconds: float,
    has_relay: bool = True,
    imperfections: Imperfections = IDEAL,
) -> list[Chunk]:
    """Return what the suit sends in so many seconds, one chunk a transmission, arrival times as emulated."""
    settings = SuitSettings(sampling_rate_hz=100.0, has_relay=has_relay)
    traffic = SuitTraffic(motion, settings, imperfections, seed=1)
    return [Chunk(sent.data, round(sent.time_s * 1e9), LINK) for sent in traffic.transmissions(seconds)]


def errors_deg(frames: list[SkeletonFrame], motion: BodyMotion, from_s: float) -> FloatArray:
    """Return the RMSE of each segment from ``from_s`` on, °, (n_segments,)."""
    times_s = np.array([frame.time_ns for frame in frames]) * 1e-9
    settled = times_s >= from_s
    q_wb = np.stack([frame.q_wb for frame in frames])[settled]
    return rmse_deg(orientation_error(q_wb, motion.state(times_s[settled]).q_wb).total)


def measure_walk(frames: list[SkeletonFrame], motion: BodyMotion) -> WalkResult:
    """Return figures of a walk from ``WALK_FROM_S`` on; places are counted from where the body is then."""
    times = np.array([frame.time_ns for frame in frames]) * 1e-9
    kept = np.flatnonzero(times >= WALK_FROM_S)
    truth = motion.state(times[kept])
    place = np.array([frames[k].p_w[0] for k in kept])
    true_place = truth.joint_position[:, 0]
    # Nothing measures where the body began: only its way counts.
    off = (place - place[0]) - (true_place - true_place[0])
    length, true_length = (
        float(np.linalg.norm(np.diff(p[:, :2], axis=0), axis=1).sum()) for p in (place, true_place)
    )
    root = np.array([frames[k].root for k in kept])
    switches = np.flatnonzero(np.diff(root))
    q_wb = np.stack([frames[k].q_wb for k in kept])
    steps = _error_steps_deg(q_wb, truth.q_wb)
    error = orientation_error(q_wb, truth.q_wb)
    return WalkResult(
        total_deg=float(rmse_deg(error.total).mean()),
        tilt_deg=float(rmse_deg(error.inclination).mean()),
        covered_percent=coverage_percent(error.total, np.stack([frames[k].sigma for k in kept])),
        distance_m=true_length,
        length_error=length / true_length - 1.0,
        end_error=float(np.linalg.norm(off[-1, :2])) / true_length,
        height_error_m=float(np.abs(off[:, 2]).max()),
        switches=len(switches),
        largest_step_deg=float(steps[switches].max()) if len(switches) else 0.0,
    )


def _error_steps_deg(q_wb: FloatArray, true_q_wb: FloatArray) -> FloatArray:
    """Return the change of the worst segment's orientation error from frame to frame, °, (T − 1,)."""
    shape = q_wb.shape[:2]
    estimate, truth = (Rotation.from_quat(q.reshape(-1, 4), scalar_first=True) for q in (q_wb, true_q_wb))
    error = (estimate * truth.inv()).as_quat().reshape(*shape, 4)
    after, before = (Rotation.from_quat(part.reshape(-1, 4)) for part in (error[1:], error[:-1]))
    angle = (after * before.inv()).magnitude().reshape(shape[0] - 1, shape[1])
    worst: FloatArray = np.degrees(angle.max(axis=1))
    return worst
