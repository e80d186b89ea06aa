"""Poses from a recording again: the same, bit for bit, or with another rig, calibration or method."""

from __future__ import annotations

import contextlib
import tempfile
import uuid
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from pathlib import Path

import numpy as np

import gateway
from devices import recording_format as fmt
from devices.link import Chunk, InputEvent, SentChunk
from devices.recording_file import RecordedMessage, RecordingError
from devices.recording_writer import DerivedRecordingWriter, session_record
from gateway.body.skeleton import WornSuit
from gateway.contract.ros_messages import BodyTransforms
from gateway.frames import SkeletonFrame
from gateway.geometry.comparison import orientation_error
from gateway.pipeline import Pipeline, sources_from_settings
from gateway.recording.arrays import SkeletonArrays, arrays_of
from gateway.recording.pose_encoding import decode_skeleton_frame, frame_messages
from gateway.recording.reading import (
    Progress,
    Recording,
    decode_message,
)
from gateway.recording.smoothing import RecordingSmoother
from gateway.recording.snapshot import attachments_of
from gateway.settings import GatewaySettings
from gateway.sources.sources import Sources

_MESSAGES_A_REPORT = 512

_MOST_WAITING = 4096
_MADE_ANEW = (fmt.SKELETON, fmt.MARKERS, fmt.TRANSFORMS)


@dataclass(frozen=True)
class Verification:
    """Whether the poses of a recording come out of its bytes again."""

    compared: int
    """Skeleton frames compared."""
    difference: str | None
    """The first difference, in words; None when all were identical to the last bit."""
    not_recorded: int
    """Frames recomputed at the end that the recording has no more: it was cut off before them."""

    @property
    def is_identical(self) -> bool:
        """Whether every recorded pose was made again, bit for bit."""
        return self.difference is None and self.compared > 0


@dataclass(frozen=True)
class SolvingSetup:
    """What poses are made with."""

    suit: WornSuit
    settings: GatewaySettings
    smoothed: bool = False
    """Forward and backward: see ``gateway.reconstruction.smoothing``."""


def recorded_setup(recording: Recording) -> SolvingSetup:
    """Return what the recorded poses were made with. Raises ``SettingsError``."""
    return SolvingSetup(recording.meta.suit, recording.meta.settings, recording.meta.smoothed)


def recording_pipeline(recording: Recording, setup: SolvingSetup) -> Pipeline:
    """Return a pipeline that has not begun yet; the recording's links are announced."""
    with with_recorded_table(recording, setup.settings) as settings:
        pipeline = Pipeline.from_settings(settings, setup.suit)
    for name, content in recording.meta.links.items():
        pipeline.add_link(name, content)
    return pipeline


def recorded_sources(recording: Recording) -> Sources:
    """Return sources that nothing was fed to yet, with the recording's links, as ``recording_pipeline`` has
    them."""
    with with_recorded_table(recording, recording.meta.settings) as settings:
        sources = sources_from_settings(settings, recording.meta.suit)
    for name, content in recording.meta.links.items():
        sources.add_link(name, content)
    return sources


def solve(
    recording: Recording,
    setup: SolvingSetup | None = None,
    progress: Progress | None = None,
) -> Iterator[SkeletonFrame]:
    """Yield skeleton frames made anew from the recorded bytes; setup: None for what was recorded."""
    chosen = setup or recorded_setup(recording)
    pipeline = recording_pipeline(recording, chosen)
    if not chosen.smoothed:
        yield from pipeline.replay(recording.inputs(progress))
        return
    with RecordingSmoother(pipeline) as smoothing:
        # Smoothing goes forward and backward: half of the work each.
        for item in recording.inputs(_half(progress, 0)):
            smoothing.take(item)
        yield from smoothing.poses(_half(progress, 1))


def smoothed_arrays(recording: Recording, progress: Progress | None = None) -> SkeletonArrays:
    """Return all poses made anew, forward and backward.

    Raises ``GatewayError`` for a method that cannot go backward, ``RecordingError`` when there is no pose."""
    setup = replace(recorded_setup(recording), smoothed=True)
    arrays = arrays_of(solve(recording, setup, progress), setup.suit.skeleton)
    if arrays is None:
        raise RecordingError(f"{recording.parts.path} gives no pose")
    return replace(arrays, origin_ns=recording.meta.begun_ns if recording.meta.imported_from else None)


def verify(recording: Recording, progress: Progress | None = None) -> Verification:
    """Recompute every skeleton frame, and compare it with the recorded one byte by byte; and what became of
    its markers, where that was recorded.

    Raises ``RecordingError`` when no skeleton frames were recorded, or an offline method made them.
    """
    if recording.meta.solved_by:
        raise RecordingError(
            f"{recording.parts.path}: its poses are of the offline method '{recording.meta.solved_by}', "
            "which replaying cannot compare: solve the trial again, with `mocap-gateway optical solve` or "
            "`video solve`"
        )
    recomputed: deque[bytes] = deque()
    markers: deque[bytes] = deque(maxlen=_MOST_WAITING)  # left here where none were recorded
    compared = 0
    with _poses_by_message(recording, recorded_setup(recording), progress) as (poses_of, read_progress):
        for message in _with_progress(recording, read_progress):
            if message.topic == fmt.SKELETON:
                made = recomputed.popleft() if recomputed else None
                if made != message.data:
                    return Verification(compared, _difference(compared, message.data, made), 0)
                compared += 1
            elif message.topic == fmt.MARKERS:
                if not markers or markers.popleft() != message.data:
                    what = "its markers were explained in another way"
                    return Verification(compared, f"frame {compared - 1} (counted from 0): {what}", 0)
            else:
                for topic, made_now in chain.from_iterable(map(frame_messages, poses_of(message))):
                    (recomputed if topic == fmt.SKELETON else markers).append(made_now)
    if compared == 0:
        raise RecordingError(f"{recording.parts.path} has no skeleton frames to compare with")
    return Verification(compared, None, len(recomputed))


def write_solved(
    recording: Recording,
    target: Path,
    setup: SolvingSetup,
    progress: Progress | None = None,
) -> int:
    """Return a new recording of the same bytes, with poses made anew, and the suit and configuration they
    were made with. Returns how many. Raises ``RecordingError`` when ``target`` exists, OSError as ``open``
    does.
    """
    meta, frames = recording.meta, 0
    with with_recorded_table(recording, setup.settings) as settings:
        attachments = attachments_of(settings, setup.suit)
    session = session_record(
        meta.links,
        session=_solved_session(meta.session, attachments),
        software=gateway.__version__,
        begun_ns=str(meta.begun_ns),
        begun_utc_ns=str(meta.begun_utc_ns),
        from_start=str(int(meta.from_start)),
        name=target.stem,
        solved_from=f"{meta.path.name} {meta.session}",
        smoothed=str(int(setup.smoothed)),
        **({"imported_from": meta.imported_from} if meta.imported_from else {}),
    )

    is_shown = setup.settings.recording.transforms
    transforms = BodyTransforms(setup.suit.skeleton) if is_shown else None
    with (
        _poses_by_message(recording, setup, progress) as (poses_of, read_progress),
        DerivedRecordingWriter(target, session, attachments, meta.begun_ns) as writer,
    ):
        # Everything else is copied as it is, so that the new recording replays like the old one.
        for count, message in enumerate(_with_progress(recording, read_progress)):
            if message.topic not in _MADE_ANEW:
                writer.add(message.topic, message.time_ns, message.data, _metadata(recording, message.topic))
            for frame in poses_of(message):
                for topic, made in frame_messages(frame):
                    writer.add(topic, message.time_ns, made)
                if transforms is not None:
                    writer.add(
                        fmt.TRANSFORMS,
                        message.time_ns,
                        transforms.encode(frame.time_ns, frame.q_wb, frame.p_w),
                    )
                frames += 1
            if count % _MESSAGES_A_REPORT == 0:
                writer.flush()
    return frames


def _solved_session(solved_from: str, attachments: Mapping[str, bytes]) -> str:
    """Return the same for the same session, suit, configuration and host: solving twice gives the same
    file."""
    contents = b"".join(attachments[name] for name in sorted(attachments))
    return uuid.uuid5(uuid.NAMESPACE_OID, f"{solved_from} {contents!r}").hex


@contextlib.contextmanager
def _poses_by_message(
    recording: Recording, setup: SolvingSetup, progress: Progress | None
) -> Iterator[tuple[Callable[[RecordedMessage], list[SkeletonFrame]], Progress | None]]:
    """Yield a function that gives the frames each message completes, and what takes the progress meanwhile.

    The function is called with every message, in order. For smoothed poses all messages are gone through
    before, and progress has then been reported.
    """
    pipeline = recording_pipeline(recording, setup)
    if not setup.smoothed:
        yield partial(_fed, pipeline), progress
        return
    with RecordingSmoother(pipeline) as smoothing:
        # A smoother needs the end before the first pose: all messages are gone through twice.
        for message in _with_progress(recording, _half(progress, 0)):
            if _is_input(message):
                item = decode_message(message)
                smoothing.take(item if isinstance(item, Chunk | SentChunk | InputEvent) else None)
        groups = smoothing.groups(_half(progress, 1))
        yield lambda message: next(groups) if _is_input(message) else [], None


def _half(progress: Progress | None, which: int) -> Progress | None:
    """Report the whole of a stage as the first (0) or the second (1) half of the work."""
    if progress is None:
        return None
    return lambda done, total: progress(which * total + done, 2 * total)


def _is_input(message: RecordedMessage) -> bool:
    return message.topic.startswith(fmt.OF_LINKS) or message.topic == fmt.EVENTS


def _fed(pipeline: Pipeline, message: RecordedMessage) -> list[SkeletonFrame]:
    """Return the frames that a message completes."""
    item = decode_message(message) if _is_input(message) else None
    return pipeline.take(item) if isinstance(item, Chunk | SentChunk | InputEvent) else []


def _with_progress(recording: Recording, progress: Progress | None) -> Iterator[RecordedMessage]:
    """Yield all messages of known topics; reports how far it is."""
    total = recording.parts.size
    for count, message in enumerate(recording.parts.messages()):
        if progress is not None and count % _MESSAGES_A_REPORT == 0:
            progress(recording.parts.position, total)
        if fmt.is_known(message.topic):
            yield message
    if progress is not None:
        progress(total, total)


def _metadata(recording: Recording, topic: str) -> dict[str, str]:
    """Return the metadata of a link's channel; empty for other topics."""
    link = fmt.link_of(topic)
    return {} if link is None else {"link": link, "framing": recording.meta.links[link]}


@contextlib.contextmanager
def with_recorded_table(recording: Recording, settings: GatewaySettings) -> Iterator[GatewaySettings]:
    """Yield the settings, naming a temporary file with the recording's clock table if they need one."""
    text = recording.meta.clock_table
    if settings.clock.table is None or text is None:
        yield settings
        return
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / fmt.CLOCK_TABLE
        path.write_text(text)
        clock = settings.clock.model_copy(update={"table": str(path)})
        yield settings.model_copy(update={"clock": clock})


def _difference(index: int, recorded: bytes, made: bytes | None) -> str:
    """Return what differs first, for the user."""
    if made is None:
        return f"frame {index}: recorded, but not made again from the bytes"
    was, now = decode_skeleton_frame(recorded), decode_skeleton_frame(made)
    # Differences here explain those of orientations, so they come first.
    for name in ("sequence", "time_ns", "root", "status"):
        if not np.array_equal(getattr(was, name), getattr(now, name)):
            return f"frame {index}: {name} was {getattr(was, name)}, is {getattr(now, name)}"
    if was.q_wb.shape == now.q_wb.shape and not np.array_equal(was.q_wb, now.q_wb, equal_nan=True):
        degrees = np.degrees(orientation_error(now.q_wb, was.q_wb)[0])
        return (
            f"frame {index} (sequence {was.sequence}): orientations differ by up to {np.nanmax(degrees):.2g}°"
        )
    return f"frame {index} (sequence {was.sequence}): other values than orientations differ"
