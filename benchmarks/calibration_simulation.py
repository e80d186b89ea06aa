"""An emulated wearer goes through the body calibration: through the wire, with all errors of the modules."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from devices.calibration_script import PERIOD_S, timetable
from devices.emulators.bodies import EmulatedBody
from devices.emulators.imperfections import TYPICAL
from devices.emulators.motion.calibrating import calibration_motion, strapped_on
from devices.emulators.suit_traffic import SuitSettings, SuitTraffic
from devices.link import Chunk, Framing
from gateway.body.skeleton import WornSuit
from gateway.calibration.body_result import BodyResult
from gateway.calibration.body_session import BodySession
from gateway.emulation.rig import dress
from gateway.frames import FloatArray, ImuFrame
from gateway.pipeline import Pipeline
from gateway.sources.clock_mode import ClockMode
from gateway.stages.frame_assembler import AssemblyParams

LINK = "simulated"
RATE_HZ = 60.0


def simulated_body(suit: WornSuit, seed: int) -> EmulatedBody:
    """Modules turned at random, each 2 cm off its place."""
    return strapped_on(dress(suit), seed)


def imu_frames(
    suit: WornSuit,
    body: EmulatedBody,
    heading: float,
    seed: int,
) -> list[ImuFrame]:
    """What the gateway assembles of the whole script, by its own clock: motion time is gateway time."""
    motion = calibration_motion(body, seed, heading)
    settings = SuitSettings(
        sampling_rate_hz=RATE_HZ, gravity=suit.gravity, magnetic_field=suit.magnetic_field, is_fine=True
    )
    traffic = SuitTraffic(motion, settings, TYPICAL, seed)
    pipeline = Pipeline(
        suit, AssemblyParams(1e9 / RATE_HZ, 50_000_000, 100_000_000, 500_000_000), "independent",
        ClockMode.ESTIMATED,
    )  # fmt: skip
    frames: list[ImuFrame] = []
    pipeline.module_stage.on_frame = frames.append
    pipeline.add_link(LINK, Framing.BYTE_STREAM)
    for sent in traffic.transmissions(PERIOD_S):
        pipeline.feed(Chunk(sent.data, round(sent.time_s * 1e9), LINK))
    return frames


def session_of(suit: WornSuit, frames: list[ImuFrame], uses_field: bool = True) -> BodySession:
    """The frames with the script's steps marked in them."""
    session = BodySession(suit, uses_field)
    for frame in frames:
        session.add(frame)
    for name, (begin, end) in timetable().items():
        session.mark(name, round(begin * 1e9), round(end * 1e9))
    return session


def errors(result: BodyResult, body: EmulatedBody) -> tuple[FloatArray, FloatArray]:
    """By module: error of ``q_bs``, degrees, and of the lever arm, m."""
    angles, metres = [], []
    for module in result.modules:
        segment = body.segment_names.index(module.segment)
        true = Rotation.from_quat(body.sensor_to_segment[segment], scalar_first=True)
        assert module.sensor_to_segment is not None
        found = Rotation.from_quat(module.sensor_to_segment, scalar_first=True)
        angles.append(np.degrees((found * true.inv()).magnitude()))
        metres.append(np.linalg.norm(module.position - body.module_positions[segment]))
    return np.array(angles), np.array(metres)
