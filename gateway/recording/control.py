"""Starts and stops recordings of a running gateway, and says how they fare. Belongs to one event loop."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Awaitable, Callable, Mapping
from pathlib import Path
from typing import Any

import gateway
from devices.link import Chunk, SentChunk, gateway_time_ns
from devices.recording_file import RecordingError
from gateway.body.skeleton import WornSuit
from gateway.contract.requests import MarkRequest, Request, StartRecordingRequest, asked
from gateway.contract.ros_messages import BodyTransforms
from gateway.errors import GatewayError
from gateway.frames import SkeletonFrame
from gateway.recording.files import Contents, SessionFiles, prepare_folder
from gateway.recording.recorder import Recorder, RecorderBalance, RecordingSink
from gateway.recording.snapshot import attachments_of
from gateway.settings import GatewaySettings
from gateway.support.supervision import kept_running
from gateway.support.whole_files import free_bytes

STATISTICS_INTERVAL_S = 5.0
WATCH_INTERVAL_S = 0.5
"""How soon a restart of a module becomes an event."""
_LONGEST_CLOSE_S = 10.0
_CUT_OFF_S = 2.0
"""Without a broker, before that is worth a recording: longer than another node of a cluster takes."""
_MB = 1e6

log = logging.getLogger(__name__)


class RecordingControl:
    """The recorder's place in the gateway: handed everything, it keeps what is to be kept.

    statistics: asked for counters and clock models; restarts: for how often each module has begun anew.
    """

    def __init__(
        self,
        settings: GatewaySettings,
        suit: WornSuit,
        links: Mapping[str, str],
        statistics: Callable[[], Mapping[str, object]],
        restarts: Callable[[], Mapping[int, int]],
    ) -> None:
        self._settings = settings
        self._suit = suit
        self._links = dict(links)
        self._statistics = statistics
        self._restarts = restarts
        self._recorder: Recorder | None = None
        self._files: SessionFiles | None = None
        self._begun = 0.0
        self._lasted_s = 0.0
        self._has_been_fed = False
        self._is_wanted = False
        self.marks = 0
        """Made in the recording under way, or in the last one."""
        self._watching: asyncio.Task[None] | None = None
        self._verbs: dict[str, Callable[[Any], Awaitable[None]]] = {
            "start": self._asked_to_start,
            "stop": self._asked_to_stop,
            "status": self._asked_for_status,
            "mark": self._asked_to_mark,
        }

    @property
    def is_recording(self) -> bool:
        """Whether everything that comes now is being kept."""
        return self._recorder is not None and self._recorder.ended is None

    @property
    def failure(self) -> str | None:
        """Why what is wanted is not recorded any more; None: it is, or nobody wants it."""
        return self._recorder.ended if self._is_wanted and self._recorder is not None else None

    def check(self) -> None:
        """See that a recording could begin now. Raises ``RecordingError`` with what stands against it."""
        prepare_folder(self._settings.recording)

    def start(self, name: str | None = None) -> None:
        """Begin a new recording.

        Raises ``RecordingError``: one is under way, bad name, no room, folder that cannot be written.
        """
        if self.is_recording:
            raise RecordingError(f"already recording to {self.status()['file']}: stop that first")
        # Only a recording with every input from the start gives bit-identical poses: the filters' state is
        # not saved.
        begins_whole = not self._has_been_fed
        contents = Contents(
            self._links, attachments_of(self._settings, self._suit), gateway.__version__, begins_whole
        )
        files = SessionFiles(self._settings.recording, contents, name)
        sink = RecordingSink(files.write, files.flush, files.close, files.abandon)

        self._files, self._begun = files, time.monotonic()
        self._is_wanted = True
        self.marks = 0
        transforms = BodyTransforms(self._suit.skeleton) if self._settings.recording.transforms else None
        self._recorder = Recorder(
            sink, self._settings.recording.flush_ms * 1e-3, self._log_why_it_ended, transforms
        )
        self.event("recording_begun", {"from_start": begins_whole})
        self._watching = asyncio.get_running_loop().create_task(
            kept_running("the recording's watch", self._watch), name="recording"
        )
        log.info("recording to %s", files.path)

    async def stop(self) -> None:
        """End the recording, if there is one; all that was handed over is then in the file."""
        recorder = self._recorder
        self._is_wanted = False
        if self._watching is not None:
            self._watching.cancel()
            self._watching = None
        if recorder is None or recorder.ended is not None:
            return
        self._keep_statistics()
        recorder.end("stopped")
        closed = await asyncio.to_thread(recorder.join, _LONGEST_CLOSE_S)
        if not closed:
            log.error("the disk did not take the end of the recording within %g s", _LONGEST_CLOSE_S)

    async def record_while(self, is_cut_off: Callable[[], bool]) -> None:
        """Record, for ever, for as long as no broker takes poses; what was begun otherwise is left alone."""
        # A recording that was begun by hand is not ended here.
        is_ours, since = False, time.monotonic()
        while True:
            await asyncio.sleep(WATCH_INTERVAL_S)
            if not is_cut_off():
                since = time.monotonic()
                if is_ours and self.is_recording:
                    await self.stop()
                is_ours = False
            elif not is_ours and not self.is_recording and time.monotonic() - since > _CUT_OFF_S:
                is_ours = True
                try:
                    self.start("cut_off")
                except RecordingError as error:
                    log.error("no broker takes poses, and they cannot be recorded: %s", error)

    # What the service hands over, at once and in order.

    def chunk(self, chunk: Chunk, content: str) -> None:
        """Record what a link gave, before it is parsed."""
        self._has_been_fed = True
        if self._recorder is not None and self._is_wanted:
            self._recorder.chunk(chunk, content)

    def sent(self, sent: SentChunk) -> None:
        """Record what was written to a link."""
        if self._recorder is not None and self._is_wanted:
            self._recorder.sent(sent, self._links[sent.link])

    def skeleton(self, frame: SkeletonFrame, arrived_ns: int) -> None:
        """Record a pose that was solved, if the configuration asks for poses."""
        if self._recorder is not None and self._is_wanted and self._settings.recording.skeleton:
            self._recorder.skeleton(frame, arrived_ns)

    def event(self, name: str, data: Mapping[str, object]) -> None:
        """Record an event: a link's state, a reset, a calibration."""
        if self._recorder is not None and self._is_wanted:
            self._recorder.event(name, data, gateway_time_ns())

    def worn(self, suit: WornSuit) -> None:
        """Note how the suit is worn from now on; recordings begun later contain this."""
        self._suit = suit

    @property
    def is_behind(self) -> bool:
        """Whether the disk has fallen far behind: the caller should ``catch_up`` before it feeds more."""
        return self._recorder is not None and self._recorder.is_behind

    async def catch_up(self) -> None:
        """Let the disk catch up, if it has fallen far behind."""
        if self._recorder is not None and self._recorder.is_behind:
            log.warning("the disk is slower than the suit: the stream waits for it")
            await self._recorder.catch_up()

    # What others ask.

    def status(self) -> dict[str, Any]:
        """Return state, file, sizes and losses, for the health message, the command line and requests."""
        recorder, files = self._recorder, self._files
        if recorder is None or files is None:
            return {"state": "off", **self._room()}
        counts = recorder.counts
        if recorder.ended is None:
            self._lasted_s = time.monotonic() - self._begun
        status: dict[str, Any] = {
            "state": "recording" if recorder.ended is None else "off",
            "file": str(files.path),
            "part": files.part,
            "bytes": files.size,
            "seconds": round(self._lasted_s, 1),
            "written": dict(counts.written),
            "lost": dict(counts.lost),
            "queued_bytes": recorder.queued_bytes,
            "stalls": counts.stalls,
            "stalled_s": round(counts.stalled_s, 3),
            "marks": self.marks,
            **self._room(),
        }
        if recorder.ended is not None:
            status["ended"] = recorder.ended
        if files.warning is not None:
            status["warning"] = files.warning
        return status

    def _room(self) -> dict[str, Any]:
        """Return the free space of the recordings' disk, MB; empty where it cannot be read."""
        folder = Path(self._settings.recording.folder).absolute()
        try:
            # The folder is made with the first recording: until then its nearest parent is on the same disk.
            free_mb = free_bytes(next(each for each in (folder, *folder.parents) if each.exists())) / _MB
        except OSError:
            return {}
        return {"free_mb": round(free_mb), "is_low": free_mb < self._settings.recording.warn_free_mb}

    @property
    def balance(self) -> RecorderBalance | None:
        """What became of the chunks of the recording under way, or of the last one; None before the first."""
        return None if self._recorder is None else self._recorder.balance

    async def perform(self, verb: str, data: Mapping[str, Any]) -> dict[str, Any]:
        """Perform ``recording/start`` (optional ``name``), ``stop``, ``status`` or ``mark`` (``text``);
        return the status.
        """
        request = asked("recording", verb, data)
        await self._verbs[verb](request)
        return self.status()

    async def _asked_to_start(self, request: StartRecordingRequest) -> None:
        self.start(request.name)

    async def _asked_to_stop(self, _request: Request) -> None:
        if not self.is_recording:
            raise GatewayError("nothing is being recorded")
        await self.stop()

    async def _asked_to_mark(self, request: MarkRequest) -> None:
        if not self.is_recording:
            raise GatewayError("nothing is being recorded: start a recording, then mark instants of it")
        self.marks += 1
        self.event("mark", {"number": self.marks, "text": request.text})

    @property
    def file(self) -> Path | None:
        """The file that is being written; None: nothing is recorded."""
        return self._files.path if self.is_recording and self._files is not None else None

    async def _asked_for_status(self, _request: Request) -> None:
        """Do nothing: ``perform`` answers with the status."""

    def _keep_statistics(self) -> None:
        if self._recorder is not None:
            self._recorder.statistics(self._statistics(), gateway_time_ns())

    async def _watch(self) -> None:
        """Record restarts of modules as they happen, and counters now and then, until the recording ends."""
        known = dict(self._restarts())
        due = time.monotonic() + STATISTICS_INTERVAL_S
        while self.is_recording:
            await asyncio.sleep(WATCH_INTERVAL_S)
            for module, count in self._restarts().items():
                if count > known.get(module, 0):
                    self.event("module_restarted", {"module": module, "restarts": count})
                known[module] = count
            if time.monotonic() >= due:
                self._keep_statistics()
                due += STATISTICS_INTERVAL_S

    def _log_why_it_ended(self, reason: str) -> None:
        """Called in the recorder's thread."""
        self._lasted_s = time.monotonic() - self._begun
        if reason == "stopped":
            log.info("recording ended")
        else:
            log.error("recording has stopped: %s. The live stream goes on", reason)
