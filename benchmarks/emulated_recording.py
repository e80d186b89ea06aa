"""Recordings of emulated suits, made without waiting: the instants in them begin now."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

from devices import recording_format as fmt
from devices.emulators.bodies import EmulatedBody
from devices.emulators.faults.fault_plan import FaultPlan
from devices.emulators.faults.faulty_suit import FaultySuit
from devices.emulators.imperfections import TYPICAL
from devices.emulators.motion.motions import BodyMotion
from devices.emulators.suit_traffic import SuitSettings, SuitTraffic
from devices.link import Chunk, Framing, gateway_time_ns
from gateway.body.rig import load_rig
from gateway.contract.ros_messages import BodyTransforms
from gateway.emulation.rig import dress, move
from gateway.frames import SkeletonFrame
from gateway.pipeline import Pipeline
from gateway.recording.files import Contents, SessionFiles
from gateway.recording.pose_encoding import encode_skeleton_frame
from gateway.recording.snapshot import attachments_of
from gateway.settings import GatewaySettings, RecordingSettings

FLUSH_MS = 200.0
LINK = "suit"
_STEP_S = 0.02


def write_session(
    files: SessionFiles,
    handled: Iterable[tuple[Chunk, list[SkeletonFrame]]],
    transforms: BodyTransforms | None = None,
) -> None:
    """Write chunks and what came of them as the recorder's thread does; flushed by the time of the data.

    transforms: with them the channel for viewers, too.
    """
    due_ns = 0
    for chunk, frames in handled:
        files.write(f"/chunks/{chunk.link}", chunk.arrived_ns, chunk.data, {})
        for frame in frames:
            files.write("/skeleton", chunk.arrived_ns, encode_skeleton_frame(frame), {})
            if transforms is not None:
                encoded = transforms.encode(frame.time_ns, frame.q_wb, frame.p_w)
                files.write(fmt.TRANSFORMS, chunk.arrived_ns, encoded, {})
        if chunk.arrived_ns >= due_ns:
            due_ns = chunk.arrived_ns + round(FLUSH_MS * 1e6)
            files.flush()
    files.close()


def record_walk(
    folder: Path,
    seconds: float,
    settings: GatewaySettings,
    plan: FaultPlan,
    seed: int,
    motion: Callable[[EmulatedBody, str, int], BodyMotion] = move,
) -> Path:
    """A person walks in the rig of the settings, what the plan says goes wrong; the recording of it all."""
    suit = load_rig(settings.rig)
    traffic = SuitTraffic(motion(dress(suit), suit.skeleton.name, seed), SuitSettings(), TYPICAL, seed)
    pipeline = Pipeline.from_settings(settings, suit)
    pipeline.add_link(LINK, Framing.BYTE_STREAM)
    chunks = _chunks(FaultySuit(traffic, plan), seconds)
    handled = [(chunk, pipeline.feed(chunk)) for chunk in chunks]
    contents = Contents({LINK: Framing.BYTE_STREAM}, attachments_of(settings, suit), "emulated", True)
    kept = RecordingSettings(folder=str(folder), min_free_mb=1, warn_free_mb=1)
    files = SessionFiles(kept, contents, "walk")
    write_session(files, handled)
    return files.path


def _chunks(suit: FaultySuit, seconds: float) -> Iterable[Chunk]:
    begin_ns = gateway_time_ns()
    for k in range(1, round(seconds / _STEP_S) + 1):
        for sent in suit.advance(k * _STEP_S):
            yield Chunk(sent.data, begin_ns + round(sent.time_s * 1e9), LINK)
