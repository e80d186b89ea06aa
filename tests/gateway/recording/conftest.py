"""Recordings of an emulated suit, made by feeding a pipeline and a recorder as the service does."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from devices.emulators import SuitSettings, SuitTraffic
from devices.emulators.imperfections import TYPICAL
from devices.link import Chunk, Framing, SentChunk
from gateway.body.rig import load_rig
from gateway.cli.main import app
from gateway.contract.ros_messages import BodyTransforms
from gateway.emulation.rig import dress, move
from gateway.pipeline import Pipeline
from gateway.recording.files import Contents, SessionFiles
from gateway.recording.recorder import Recorder, RecordingSink
from gateway.recording.snapshot import attachments_of
from gateway.settings import GatewaySettings, RecordingSettings
from gateway.sources.link_settings import LinkSettings

RIG = "robot_arm_4"
ROOM = RecordingSettings(min_free_mb=1, warn_free_mb=2, flush_ms=10)


@pytest.fixture(scope="session")
def arm_chunks() -> list[Chunk]:
    """Two seconds of an arm with four modules, over two links in turns."""
    suit = load_rig(RIG)
    motion = move(dress(suit), suit.skeleton.name, seed=3)
    traffic = SuitTraffic(motion, SuitSettings(), TYPICAL, seed=3)
    names = itertools.cycle(("left", "left", "right"))
    return [
        Chunk(sent.data, 10**18 + round(sent.time_s * 1e9), next(names))
        for sent in traffic.transmissions(2.0)
    ]


@pytest.fixture
def record(tmp_path: Path, arm_chunks: list[Chunk]) -> Callable[..., Path]:
    """``record(settings=, name=, from_start=, links=)``: the path of a finished recording."""

    def make(
        settings: RecordingSettings = ROOM,
        name: str | None = None,
        chunks: list[Chunk] = arm_chunks,
        from_start: bool = True,
    ) -> Path:
        kept = settings.model_copy(update={"folder": str(tmp_path / "recordings")})
        links = [LinkSettings(name=link, url="/dev/null") for link in ("left", "right")]
        whole = GatewaySettings(links=links, rig=RIG, reconstructor="independent", recording=kept)
        suit = load_rig(RIG)
        framings = {"left": Framing.BYTE_STREAM, "right": Framing.BYTE_STREAM}
        contents = Contents(framings, attachments_of(whole, suit), "1.2.3", from_start)
        files = SessionFiles(kept, contents, name)
        path = files.path
        sink = RecordingSink(files.write, files.flush, files.close, files.abandon)
        transforms = BodyTransforms(suit.skeleton)
        recorder = Recorder(sink, kept.flush_ms * 1e-3, transforms=transforms)
        pipeline = Pipeline.from_settings(whole, suit)
        for link in framings:
            pipeline.add_link(link, Framing.BYTE_STREAM)
        for chunk in chunks:
            recorder.chunk(chunk, Framing.BYTE_STREAM)
            for frame in pipeline.feed(chunk):
                recorder.skeleton(frame, chunk.arrived_ns)
        recorder.sent(SentChunk(b"hello", chunks[-1].arrived_ns, "left"), Framing.BYTE_STREAM)
        recorder.event("reset", {"segment": "base"}, chunks[-1].arrived_ns)
        recorder.statistics(pipeline.statistics(), chunks[-1].arrived_ns)
        recorder.end("stopped")
        assert recorder.join(10)
        return path

    return make


@pytest.fixture
def typed() -> Callable[..., tuple[int, Any]]:
    """``typed("export", path, …)``: exit code and what it printed; with ``--json`` that, decoded."""

    def run(*arguments: object) -> tuple[int, Any]:
        result = CliRunner().invoke(app, [str(argument) for argument in arguments])
        if result.exception is not None and not isinstance(result.exception, SystemExit):
            raise result.exception
        return result.exit_code, json.loads(result.stdout) if "--json" in arguments else result.stdout

    return run
