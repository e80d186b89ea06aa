"""Poses of a recording, smoothed: all of it is gone through before the first one comes out."""

from __future__ import annotations

import contextlib
import tempfile
from array import array
from collections import deque
from collections.abc import Iterator, Mapping
from itertools import islice
from pathlib import Path
from typing import Any

from devices.link import Chunk, LinkItem, SentChunk
from gateway.errors import GatewayError
from gateway.frames import ImuFrame, SkeletonFrame
from gateway.pipeline import CALIBRATED_EVENT, RESET_EVENT, Pipeline
from gateway.reconstruction.smoothing import Progress, Smoother

FRAMES_AT_A_TIME = 256


class _Section:
    """A stretch of the recording with one suit: a calibration begins another one."""

    def __init__(self, pipeline: Pipeline, folder: Path) -> None:
        folder.mkdir()
        self._smoother = Smoother(pipeline.module_stage.reconstructor, folder)
        self._resets = pipeline.resets
        self._asked: deque[tuple[int, Mapping[str, Any]]] = deque()
        self._waiting: list[ImuFrame] = []
        self.n_frames = 0

    def add(self, frames: list[ImuFrame]) -> None:
        """Collect frames, and hand them to the smoother in batches."""
        self._waiting += frames
        self.n_frames += len(frames)
        if len(self._waiting) >= FRAMES_AT_A_TIME:
            self._smoother.add(self._waiting)
            self._waiting = []

    def ask(self, reset: Mapping[str, Any]) -> None:
        """Note a reset; it holds for the poses from here on."""
        self._asked.append((self.n_frames, reset))

    def poses(self, progress: Progress | None) -> Iterator[SkeletonFrame]:
        """Yield the smoothed poses of the section, with its resets applied."""
        self._smoother.add(self._waiting)
        for index, pose in enumerate(self._smoother.smoothed(progress)):
            while self._asked and self._asked[0][0] <= index:
                reset = self._asked.popleft()[1]
                with contextlib.suppress(GatewayError, KeyError, TypeError, ValueError):  # as ``replay`` does
                    self._resets.reset(str(reset["kind"]), float(reset.get("facing", 0.0)))
            yield self._resets.apply(pose)


class RecordingSmoother:
    """Takes all inputs of a recording, then hands the poses out, grouped as the inputs completed them.

    A context manager: its temporary folder, some 6 kB a frame of 17 modules, goes with it.
    """

    def __init__(self, pipeline: Pipeline) -> None:
        """Prepare to smooth. Raises ``GatewayError`` when the pipeline's method cannot be smoothed."""
        self._pipeline = pipeline
        self._temporary = tempfile.TemporaryDirectory(prefix="mocap-smoothing-")
        self._completed = array("I")
        self._sections: list[_Section] = []
        try:
            self._begin_section()
        except GatewayError:
            self._temporary.cleanup()
            raise

    def __enter__(self) -> RecordingSmoother:
        return self

    def __exit__(self, *_: object) -> None:
        self._temporary.cleanup()

    def take(self, item: LinkItem | None) -> None:
        """Take the next input; None: one that cannot be read, which completes no poses."""
        frames: list[ImuFrame] = []
        if isinstance(item, Chunk):
            frames = self._pipeline.imu_frames(item)
            self._sections[-1].add(frames)
        elif isinstance(item, SentChunk):
            self._pipeline.sent(item)
        elif item is not None and item.name == RESET_EVENT:
            self._sections[-1].ask(item.data)
        elif item is not None and item.name == CALIBRATED_EVENT:
            with contextlib.suppress(GatewayError):  # with another suit it may not be possible
                # A calibration changes the model, so smoothing must not go across it.
                self._pipeline.event(item.name, item.data)
                self._begin_section()
        self._completed.append(len(frames))

    def groups(self, progress: Progress | None = None) -> Iterator[list[SkeletonFrame]]:
        """Return, for every input in turn, the poses that it completed."""
        poses = self.poses(progress)
        return (list(islice(poses, count)) for count in self._completed)

    def poses(self, progress: Progress | None = None) -> Iterator[SkeletonFrame]:
        """Yield all of them. progress: of this half of the work, called per section in proportion to its
        frames."""
        total, done = max(1, sum(section.n_frames for section in self._sections)), 0
        for section in self._sections:
            share, begun = section.n_frames, done

            def report(part: int, parts: int, share: int = share, begun: int = begun) -> None:
                if progress is not None:
                    progress(begun + share * part // max(1, parts), total)

            yield from section.poses(report)
            done += share

    def _begin_section(self) -> None:
        folder = Path(self._temporary.name) / str(len(self._sections))
        self._sections.append(_Section(self._pipeline, folder))
