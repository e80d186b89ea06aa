"""A recording, for whatever is made of it: replay, exports, reports, plots.

recording = open_recording("recordings/20261121T131500Z_walk.mcap")
recording.meta.suit, recording.meta.settings
for chunk in recording.chunks(): ...
arrays = recording.skeleton_arrays()
arrays.q_wb  # (F, S, 4)
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from devices import recording_format as fmt
from devices.link import Chunk, InputEvent, LinkItem, SentChunk
from devices.recording_file import RecordedMessage, RecordingError, RecordingParts, parse_json
from devices.replay_link import event_of
from gateway.body.skeleton import Skeleton, WornSuit
from gateway.errors import SettingsError
from gateway.frames import MarkerFit, SkeletonFrame
from gateway.reconstruction import DELAYS_IN_NAMES
from gateway.recording.arrays import SkeletonArrays, arrays_of, marker_arrays
from gateway.recording.pose_encoding import RecordedMarkers, decode_markers, decode_skeleton_frame
from gateway.recording.snapshot import decode_suit
from gateway.settings import GatewaySettings
from gateway.support.settings_files import explained, is_union_tag

_log = logging.getLogger(__name__)

Progress = Callable[[int, int], None]
"""Called now and then with bytes read and bytes in all."""

_MESSAGES_A_REPORT = 512


@dataclass(frozen=True, slots=True)
class RecordedStatistics:
    """Counters and clock models at one instant, as in ``bridge/health``."""

    time_ns: int
    values: dict[str, Any]


RecordedItem = Chunk | SentChunk | InputEvent | RecordedStatistics | SkeletonFrame | RecordedMarkers


class RecordingMeta:
    """What a recording says about itself. Attributes raise ``SettingsError`` where they cannot be read."""

    def __init__(self, parts: RecordingParts) -> None:
        head = parts.head
        session = head.session
        self.path = parts.path
        self.name = session.get("name", "")
        self.session = session.get("session", "")
        """Unique; the same in all parts of a session."""
        self.software = session.get("software", "")
        """Version of the gateway that wrote it."""
        self.begun_ns = self._nanoseconds(session, "begun_ns")
        """Gateway time at the beginning, ns."""
        self.begun_utc_ns = self._nanoseconds(session, "begun_utc_ns")
        """The host's wall clock at the same instant, ns since 1970."""
        self.from_start = session.get("from_start") == "1" and head.part == 1
        """Whether it has all that the gateway was fed: then a replay is bit-identical."""
        self.smoothed = session.get("smoothed") == "1"
        """Whether its poses were made forward and backward through another recording of the same bytes."""
        self.solved_by = session.get("solved_by", "")
        """The offline method that made its poses, which no pipeline makes again; empty: a pipeline did."""
        self.imported_from = session.get("imported_from", "")
        """Kind of the files that it was made from, whose 0 s is then its beginning; empty: it came live."""
        self.links: dict[str, str] = parts.links
        self.n_parts = len(parts.files)
        self.size = parts.size
        """Bytes, all parts."""
        self.attachments = head.attachments
        """All of them by name, see ``devices.recording_format``."""

    @cached_property
    def suit(self) -> WornSuit:
        """Skeleton, rig and calibration exactly as used."""
        return decode_suit(self._attachment(fmt.SUIT))

    @property
    def skeleton(self) -> Skeleton:
        """The body."""
        return self.suit.skeleton

    @cached_property
    def settings(self) -> GatewaySettings:
        """The gateway's configuration, without secrets. What ``clock.table`` names is ``clock_table``.

        Settings of another version that this one does not know are left out, with a warning.
        """
        try:
            plain = parse_json(self._attachment(fmt.SETTINGS))
            _take_delay_out_of_name(plain)
            _take_out_receivers(plain)
            unknown = _take_out_unknown(plain)
            if unknown:
                _log.warning("%s: settings of version %s left out: %s", self.path, self.software, unknown)
            return GatewaySettings.model_validate(plain)
        except ValidationError as error:
            problem = explained(error.errors()[0], GatewaySettings)
            raise SettingsError(
                f"{self.path}: the recorded configuration cannot be read: {problem}"
            ) from error
        except ValueError as error:
            raise SettingsError(f"{self.path}: the recorded configuration cannot be read: {error}") from error

    @property
    def has_suit(self) -> bool:
        """Whether the suit is known: a file downloaded from a memory card has only chunks."""
        return fmt.SUIT in self.attachments

    @property
    def rig(self) -> str:
        """The rig as the text of a rig file. Raises ``SettingsError`` for one that is damaged."""
        return self._text(fmt.RIG)

    @property
    def body(self) -> str:
        """The body as the text of a body file. Raises ``SettingsError`` for one that is damaged."""
        return self._text(fmt.BODY)

    @property
    def clock_table(self) -> str | None:
        """Text of the clock table used; None without one. Raises ``SettingsError`` for a damaged one."""
        return self._text(fmt.CLOCK_TABLE) if fmt.CLOCK_TABLE in self.attachments else None

    @property
    def host(self) -> dict[str, Any]:
        """Versions, kernel and processor of the machine that recorded; nothing where that is damaged."""
        try:
            host = parse_json(self.attachments.get(fmt.HOST, b"{}"))
        except ValueError:
            return {}
        return host if isinstance(host, dict) else {}

    def _nanoseconds(self, session: Mapping[str, str], key: str) -> int:
        try:
            return int(session.get(key, 0))
        except ValueError as error:
            raise SettingsError(f"{self.path}: the recorded '{key}' is no number: {error}") from error

    def _text(self, name: str) -> str:
        try:
            return self._attachment(name).decode()
        except UnicodeDecodeError as error:
            raise SettingsError(f"{self.path}: the recorded '{name}' is damaged: {error}") from error

    def _attachment(self, name: str) -> bytes:
        if name not in self.attachments:
            raise SettingsError(
                f"{self.path} holds no '{name}': it was not recorded by a gateway (a memory card knows no "
                "suit); replay it as a link of a configuration that names the rig"
            )
        return self.attachments[name]


class Recording:
    """All parts of one session, from the one opened on. Every iterator reads anew, in the recorded order."""

    def __init__(self, path: str | Path) -> None:
        """Open a recording and read its metadata. Raises ``RecordingError``."""
        self.parts = RecordingParts(path)
        self.meta = RecordingMeta(self.parts)

    @property
    def defect(self) -> str | None:
        """What was wrong with the files, once something was read to the end; None when they are whole."""
        return self.parts.defect

    def items(self, progress: Progress | None = None) -> Iterator[RecordedItem]:
        """Yield everything, in the order in which the gateway handled it."""
        return self._decoded("/", progress)

    def chunks(self) -> Iterator[Chunk]:
        """Return what came over the links, not parsed."""
        return (item for item in self._decoded((fmt.CHUNKS, fmt.DATAGRAMS)) if isinstance(item, Chunk))

    def inputs(self, progress: Progress | None = None) -> Iterator[LinkItem]:
        """Return all that a reconstruction depends on: what came over the links, what was written to them,
        and events, of which resets and calibrations count."""
        inputs = self._decoded((*fmt.OF_LINKS, fmt.EVENTS), progress)
        return (item for item in inputs if isinstance(item, LinkItem))

    def sent(self) -> Iterator[SentChunk]:
        """Return what the gateway wrote to the links."""
        return (item for item in self._decoded(fmt.SENT) if isinstance(item, SentChunk))

    def events(self) -> Iterator[InputEvent]:
        """Return what happened: ``link``, ``module_restarted``, ``recording_begun``, ``reset``,
        ``calibrated``, …"""
        return (item for item in self._decoded(fmt.EVENTS) if isinstance(item, InputEvent))

    def statistics(self) -> Iterator[RecordedStatistics]:
        """Yield the counters and clock models, as written at intervals."""
        return (item for item in self._decoded(fmt.STATISTICS) if isinstance(item, RecordedStatistics))

    def skeleton_frames(self) -> Iterator[SkeletonFrame]:
        """Return the reconstruction as it was while recording."""
        return (item for item in self._decoded(fmt.SKELETON) if isinstance(item, SkeletonFrame))

    def markers(self) -> Iterator[RecordedMarkers]:
        """Return what became of the markers, of poses made from any."""
        return (item for item in self._decoded(fmt.MARKERS) if isinstance(item, RecordedMarkers))

    def skeleton_arrays(self, progress: Progress | None = None) -> SkeletonArrays:
        """Return the whole reconstruction as arrays. Raises ``RecordingError`` when none was recorded."""
        fits: dict[int, MarkerFit] = {}
        arrays = arrays_of(self._frames_with(fits, progress), self.meta.skeleton)
        if arrays is None:
            raise RecordingError(
                f"{self.parts.path} has no skeleton frames: make some with "
                f"`mocap-gateway replay {self.parts.path} --offline --output NEW.mcap`"
            )
        # Imported files count time from their own beginning.
        if self.meta.imported_from:
            arrays = replace(arrays, origin_ns=self.meta.begun_ns)
        if not fits or self.meta.suit.markers is None:
            return arrays
        return replace(arrays, markers=marker_arrays(self.meta.suit.markers.labels, arrays.time_ns, fits))

    def _frames_with(self, fits: dict[int, MarkerFit], progress: Progress | None) -> Iterator[SkeletonFrame]:
        """Yield the reconstruction; what became of its markers goes to ``fits``, by instant."""
        for item in self._decoded((fmt.SKELETON, fmt.MARKERS), progress):
            if isinstance(item, RecordedMarkers):
                fits[item.time_ns] = item.fit
            elif isinstance(item, SkeletonFrame):
                yield item

    def _decoded(
        self, prefix: str | tuple[str, ...], progress: Progress | None = None
    ) -> Iterator[RecordedItem]:
        """Yield messages whose topic begins so, decoded. One that cannot be is left out, as damaged ones
        are."""
        total = self.parts.size
        for count, message in enumerate(self.parts.messages()):
            if progress is not None and count % _MESSAGES_A_REPORT == 0:
                progress(self.parts.position, total)
            if message.topic.startswith(prefix):
                item = decode_message(message)
                if item is not None:
                    yield item
        if progress is not None:
            progress(total, total)


def _take_delay_out_of_name(plain: Any) -> None:
    """Translate the method of a version whose methods' names held their delays."""
    name = plain.get("reconstructor") if isinstance(plain, dict) else None
    if isinstance(name, str) and name in DELAYS_IN_NAMES:
        plain["reconstructor"], plain["reconstructor_delay_ms"] = "gyro_free", DELAYS_IN_NAMES[name] * 1e3


def _take_out_receivers(plain: Any) -> None:
    """Remove what every link used to say, and is the settings of a satellite receiver."""
    links = plain.get("links", ()) if isinstance(plain, dict) else ()
    for link in links:
        if isinstance(link, dict) and link.get("carries") != "gnss":
            for name in ("device", "latency_ms", "origin"):
                link.pop(name, None)


def _take_out_unknown(plain: dict[str, Any]) -> str:
    """Remove, and name, the settings that this version does not know."""
    try:
        GatewaySettings.model_validate(plain)
    except ValidationError as error:
        unknown = [problem["loc"] for problem in error.errors() if problem["type"] == "extra_forbidden"]
    else:
        return ""
    # Pydantic names the member of a union that it tried as a step of the path; the file has no such step.
    places = [(*(part for part in path if not is_union_tag(part)), key) for *path, key in unknown]
    for *path, key in places:
        holder: Any = plain
        for part in path:
            holder = holder[part]
        del holder[key]
    return ", ".join(".".join(map(str, place)) for place in places)


def open_recording(path: str | Path) -> Recording:
    """Return the recording in a file, with the later parts of its session that lie beside it.

    A file that was never closed (kill, power cut) is read up to its last good byte. Raises ``RecordingError``
    for a file that is absent or no recording.
    """
    return Recording(path)


def decode_message(message: RecordedMessage) -> RecordedItem | None:
    """Return a message's meaning; None for a topic or content that this version does not know."""
    topic, time_ns, data = message
    if topic.startswith((fmt.CHUNKS, fmt.DATAGRAMS)):
        return fmt.chunk_of(topic, time_ns, data)
    if topic.startswith(fmt.SENT):
        return SentChunk(data, time_ns, topic.removeprefix(fmt.SENT))
    if topic == fmt.EVENTS:
        return event_of(data)
    try:
        decode = _DECODERS.get(topic)
        return None if decode is None else decode(message)
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError):
        return None


def _statistics(message: RecordedMessage) -> RecordedItem:
    return RecordedStatistics(message.time_ns, dict(parse_json(message.data)))


_DECODERS: dict[str, Callable[[RecordedMessage], RecordedItem]] = {
    fmt.SKELETON: lambda message: decode_skeleton_frame(message.data),
    fmt.MARKERS: lambda message: decode_markers(message.data),
    fmt.STATISTICS: _statistics,
}
