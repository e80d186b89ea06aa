"""What the exports of messages have in common: instants as recorded, and an MCAP file of many channels."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import NamedTuple, Self

import numpy as np
from mcap.writer import CompressionType, Writer

import gateway
from devices.link import Chunk, SentChunk
from gateway.frames import FloatArray, InertialBatch, Sample
from gateway.recording.exporters.take import Take
from gateway.recording.reading import Recording
from gateway.recording.solving import recorded_sources


class TakePose(NamedTuple):
    """One recorded pose."""

    time_ns: int
    """Gateway time of the measurement."""
    q_wb: FloatArray  # (S, 4); NaN: not known
    p_w: FloatArray  # (S, 3) m


class ModuleSample(NamedTuple):
    """One sample of one module, as it came: without the calibration of its sensors."""

    module: int
    time_ns: int
    """Gateway time of the measurement, by the module's clock model."""
    specific_force: FloatArray  # (3,) m/s², module axes
    angular_rate: FloatArray  # (3,) rad/s
    magnetic_field: FloatArray  # (3,) µT; NaN: not read


class MessageFile:
    """An MCAP file in the making; log and publish times are those of the measurement."""

    def __init__(self, path: Path, profile: str) -> None:
        self._file = path.open("wb")
        self._writer = Writer(self._file, compression=CompressionType.ZSTD)
        self._writer.start(profile, f"mocap-gateway {gateway.__version__}")
        self._schemas: dict[str, int] = {}
        self._counts: dict[int, int] = {}

    def channel(
        self,
        topic: str,
        schema: tuple[str, str, bytes],
        encoding: str,
        metadata: dict[str, str] | None = None,
    ) -> int:
        """Register a channel, and return its number. schema: name, encoding, data."""
        name, kind, data = schema
        if name not in self._schemas:
            self._schemas[name] = self._writer.register_schema(name, kind, data)
        return self._writer.register_channel(topic, encoding, self._schemas[name], metadata or {})

    def add(self, channel: int, time_ns: int, data: bytes) -> None:
        """Append a message."""
        count = self._counts[channel] = self._counts.get(channel, -1) + 1
        self._writer.add_message(channel, max(time_ns, 0), data, max(time_ns, 0), count)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        with self._file:
            if kind is None:
                self._writer.finish()  # type: ignore[no-untyped-call]


def poses_of(take: Take) -> Iterator[TakePose]:
    """Yield poses at the instants that were recorded; nothing is interpolated."""
    recorded = take.recorded
    rows = zip(recorded.time_ns.tolist(), recorded.q_wb, recorded.p_w, strict=True)
    return (TakePose(time_ns, q_wb, p_w) for time_ns, q_wb, p_w in rows)


def samples_of(recording: Recording) -> Iterator[ModuleSample]:
    """Yield the samples of all inertial modules, roughly in order of time; none for other sources."""
    if not recording.meta.has_suit or recording.meta.solved_by:
        return
    sources = recorded_sources(recording)
    for item in recording.inputs():
        if isinstance(item, SentChunk):
            sources.sent(item)
        elif isinstance(item, Chunk) and sources.has_modules(item.link):
            for batch in sources.receive(item):
                if isinstance(batch, InertialBatch):
                    yield from _samples(batch)


def _samples(batch: InertialBatch) -> Iterator[ModuleSample]:
    for sample in map(Sample._make, batch.samples.tolist()):
        yield ModuleSample(sample.module, sample.time_ns, *np.asarray(sample.measured))
