"""Writes a recording while the gateway runs: a queue, and a thread that empties it at a bounded interval.

Nothing is ever left out of a recording. The queue is bounded; when the disk is slower than the suit, whoever
feeds it waits (``catch_up``), which is counted and shown, and if the disk does not come back within
``LONGEST_STALL_S`` the recording ends, says so, and the live stream goes on.
"""

from __future__ import annotations

import asyncio
import json
import logging
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

from devices import recording_format as fmt
from devices.link import Chunk, SentChunk, gateway_time_ns
from gateway.contract.messages import plain_json
from gateway.contract.ros_messages import BodyTransforms
from gateway.frames import SkeletonFrame
from gateway.recording.pose_encoding import encode_markers_of, encode_skeleton_frame

LONGEST_QUEUE_BYTES = 32 << 20
"""17 modules at 100 Hz fill it in about two minutes."""
LONGEST_STALL_S = 2.0
_POLL_S = 0.01
_FRAME_BYTES = 2048
"""Counted for a queued skeleton frame, which is encoded by the thread."""
_EARLY = 0.75
"""Part of the flush interval after which the thread writes, so that writing itself fits into it."""

log = logging.getLogger(__name__)


class RecordingSink(NamedTuple):
    """What the thread does: see ``gateway.recording.files``."""

    write: Callable[[str, int, bytes, Mapping[str, str]], None]
    """Topic, time in ns, message, metadata of the channel."""
    flush: Callable[[], str | None]
    """Ends a flush interval: why the recording must end, or None. Raises OSError."""
    close: Callable[[], None]
    """Raises OSError."""
    abandon: Callable[[], None]


@dataclass
class MessageCounts:
    """What became of what was handed over, by kind of message: chunks, sent, skeleton, markers, tf,
    events, statistics."""

    queued: Counter[str] = field(default_factory=Counter)
    written: Counter[str] = field(default_factory=Counter)
    """In the file, flushed."""
    lost: Counter[str] = field(default_factory=Counter)
    """Handed over and not in the file: only after the recording had to end."""
    stalls: int = 0
    """How often the stream had to wait for the disk."""
    stalled_s: float = 0.0
    longest_flush_s: float = 0.0


class RecorderBalance(NamedTuple):
    """What became of the chunks that were handed over."""

    handed: int
    written: int
    lost: int
    waiting: int
    """In the queue, or in the file and not flushed."""


class Recorder:
    """Takes everything from the event loop, never waiting, and hands it to a sink in a thread."""

    def __init__(
        self,
        sink: RecordingSink,
        flush_s: float,
        on_end: Callable[[str], None] | None = None,
        transforms: BodyTransforms | None = None,
    ) -> None:
        """Start the thread that writes to ``sink``.

        flush_s: longest time until what was handed over is safe on disk, s.
        on_end: called in the thread with the reason, when the recording ends by itself.
        transforms: with it, poses are written as transforms too, for viewers.
        """
        self.counts = MessageCounts()
        self.ended: str | None = None
        """Why nothing is recorded any more; None while it is."""
        self._sink = sink
        self._interval_s = flush_s * _EARLY
        self._on_end = on_end
        self._transforms = transforms
        self._queue: deque[tuple[str, int, bytes | SkeletonFrame, Mapping[str, str]]] = deque()
        self._queue_bytes = 0
        self._lock = threading.Lock()
        self._handed = 0  # chunks
        self._unflushed: Counter[str] = Counter()  # taken from the queue and not yet safe
        self._wake = threading.Event()
        self._closing: str | None = None
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._thread.start()

    # What the event loop calls.

    def chunk(self, chunk: Chunk, content: str) -> None:
        """Take what a link gave."""
        self._handed += 1
        metadata = {"link": chunk.link, "framing": str(content)}
        topic, data = fmt.message_of(chunk)
        self._put(topic, chunk.arrived_ns, data, metadata)

    def sent(self, sent: SentChunk, content: str) -> None:
        """Take what was written to a link."""
        metadata = {"link": sent.link, "framing": str(content)}
        self._put(fmt.SENT + sent.link, sent.sent_ns, sent.data, metadata)

    def skeleton(self, frame: SkeletonFrame, arrived_ns: int) -> None:
        """Take a frame, and when the chunk that completed it arrived."""
        self._put(fmt.SKELETON, arrived_ns, frame, {})
        if frame.markers is not None:
            self._put(fmt.MARKERS, arrived_ns, frame, {})
        if self._transforms is not None:
            self._put(fmt.TRANSFORMS, arrived_ns, frame, {})

    def event(self, name: str, data: Mapping[str, object], time_ns: int) -> None:
        """Take something that happened."""
        plain = {"time_ns": time_ns, "name": name, "data": plain_json(data)}
        self._put(fmt.EVENTS, time_ns, json.dumps(plain).encode(), {})

    def statistics(self, values: Mapping[str, object], time_ns: int) -> None:
        """Take counters."""
        self._put(fmt.STATISTICS, time_ns, json.dumps(plain_json(values)).encode(), {})

    @property
    def balance(self) -> RecorderBalance:
        """Of chunks, at one moment."""
        with self._lock:
            waiting = self._unflushed["chunks"] + sum(_kind(topic) == "chunks" for topic, *_ in self._queue)
            return RecorderBalance(
                self._handed, self.counts.written["chunks"], self.counts.lost["chunks"], waiting
            )

    @property
    def is_behind(self) -> bool:
        """Whether the caller should ``catch_up`` before it feeds more."""
        return self._queue_bytes > LONGEST_QUEUE_BYTES and self.ended is None and self._closing is None

    @property
    def queued_bytes(self) -> int:
        """Handed over and not yet written."""
        return self._queue_bytes

    async def catch_up(self) -> None:
        """Wait until there is room in the queue; end the recording if there is none for too long."""
        self.counts.stalls += 1
        self._wake.set()
        begun = time.monotonic()
        while self.is_behind:
            if time.monotonic() - begun > LONGEST_STALL_S:
                self.end(f"the disk took nothing for {LONGEST_STALL_S:g} s: choose a faster one")
                break
            await asyncio.sleep(_POLL_S)
        self.counts.stalled_s += time.monotonic() - begun

    def end(self, reason: str) -> None:
        """Write what is queued and close the file, in the thread; returns at once."""
        with self._lock:
            self._closing = self._closing or reason
        self._wake.set()

    def join(self, timeout_s: float) -> bool:
        """Wait for the thread to be through; False when it was not in time."""
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _put(
        self, topic: str, time_ns: int, data: bytes | SkeletonFrame, metadata: Mapping[str, str]
    ) -> None:
        kind = _kind(topic)
        with self._lock:  # or the thread might end between the question and the answer
            if self.ended is not None or self._closing is not None:
                self.counts.lost[kind] += 1
                return
            self.counts.queued[kind] += 1
            self._queue.append((topic, time_ns, data, metadata))
            self._queue_bytes += len(data) if isinstance(data, bytes) else _FRAME_BYTES

    # What the thread does.

    def _run(self) -> None:
        reason = None
        try:
            while reason is None:
                self._wake.wait(self._interval_s)
                self._wake.clear()
                # Read before the queue is written: what is put in before closing is then surely written.
                closing = self._closing
                reason = self._write_queued() or closing
            # Once more for what came while the last write was going on.
            self._write_queued()
            self._write_end(reason)
            self._sink.close()
        except OSError as error:
            reason = f"it cannot be written any more ({error.strerror or error})"
            # A disk that is full must not lose what is on it already: nothing more is written to the file.
            self._sink.abandon()
        except Exception as error:
            log.exception("the recorder failed")
            reason = f"this should not have happened ({error!r})"
            self._sink.abandon()
        self._conclude(reason)

    def _write_queued(self) -> str | None:
        """Write everything in the queue to the file; return why the recording must end, or None."""
        begun = time.monotonic()
        # Only swapping the queue needs the lock: the event loop never waits for the disk.
        with self._lock:
            items, self._queue = self._queue, deque()
            self._unflushed.update(_kind(topic) for topic, *_ in items)
        written = 0
        for topic, time_ns, data, metadata in items:
            self._sink.write(topic, time_ns, self._encoded(topic, data), metadata)
            written += len(data) if isinstance(data, bytes) else _FRAME_BYTES
        reason = self._sink.flush()
        # Counted as written only after the flush: until then a crash may still lose them.
        with self._lock:
            self.counts.written.update(self._unflushed)
            self._unflushed.clear()
            self._queue_bytes -= written
        self.counts.longest_flush_s = max(self.counts.longest_flush_s, time.monotonic() - begun)
        return reason

    def _encoded(self, topic: str, data: bytes | SkeletonFrame) -> bytes:
        if isinstance(data, bytes):
            return data
        if topic == fmt.MARKERS and data.markers is not None:
            return encode_markers_of(data.sequence, data.time_ns, data.markers)
        if topic == fmt.TRANSFORMS and self._transforms is not None:
            return self._transforms.encode(data.time_ns, data.q_wb, data.p_w)
        return encode_skeleton_frame(data)

    def _write_end(self, reason: str) -> None:
        time_ns = gateway_time_ns()
        event = {"time_ns": time_ns, "name": "recording_ended", "data": {"reason": reason}}
        self._sink.write(fmt.EVENTS, time_ns, json.dumps(event).encode(), {})
        self.counts.written["events"] += 1

    def _conclude(self, reason: str) -> None:
        with self._lock:
            self.ended = reason
            left, self._queue, self._queue_bytes = self._queue, deque(), 0
            self.counts.lost.update(self._unflushed)
            self.counts.lost.update(_kind(topic) for topic, *_ in left)
            self._unflushed.clear()
        if self._on_end is not None:
            self._on_end(reason)


def _kind(topic: str) -> str:
    """Return what a topic holds: ``chunks``, ``sent``, ``skeleton``, ``markers``, ``tf``, ``events``,
    ``statistics``.
    """
    return "chunks" if topic.startswith(fmt.DATAGRAMS) else topic.split("/", 2)[1]
