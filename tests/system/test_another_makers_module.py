"""A module of another maker needs one file: the source below, and its line in ``SOURCES``.

Lines of text over TCP, ``module,count,microseconds,fx,fy,fz,wx,wy,wz`` (m/s², rad/s), become readings, poses,
a recording and figures like those of any other module.
"""

from __future__ import annotations

import asyncio
import contextlib

import pytest

from devices.link import Chunk
from firmware_protocol import InertialSample
from gateway.body.rig import load_rig
from gateway.contract.balances import Balance, unaccounted
from gateway.errors import SettingsError
from gateway.frames import NOT_READ, InertialBatch, Sample
from gateway.outputs.settings import MqttSettings
from gateway.pipeline import Pipeline
from gateway.recording import open_recording
from gateway.recording.solving import verify
from gateway.service.service import Service
from gateway.settings import GatewaySettings, RecordingSettings
from gateway.sources.registry import SOURCES, SourceKind
from gateway.sources.source import ListeningSource

PERIOD_S = 0.01
GOOD = b"1,%d,%d,0.0,0.0,9.81,0.0,0.0,0.5\n"


class TextSource(ListeningSource):
    """Lines of text to readings."""

    observes = InertialBatch

    def __init__(self, context):
        self.modules = context.modules
        self.rest, self.bad, self.readings = {}, {}, 0

    def add_link(self, name, content):
        self.modules.add_link(name)
        self.rest[name], self.bad[name] = b"", 0

    def receive(self, chunk: Chunk):
        *lines, self.rest[chunk.link] = (self.rest[chunk.link] + chunk.data).split(b"\n")
        self.modules.begin_chunk(chunk)
        samples = [sample for line in lines if (sample := self.read(line, chunk)) is not None]
        self.readings += len(samples)
        return [InertialBatch.of(samples)] if samples else []

    def read(self, line, chunk):
        try:
            module, count, time_us, *values = line.split(b",")
            fx, fy, fz, wx, wy, wz = map(float, values)
            record, time_ns = self.modules.timed(int(module), int(time_us), chunk)
        except ValueError:
            self.bad[chunk.link] += 1
            return None
        counter = record.counter(InertialSample.KIND)
        number = counter.count(int(count) & 0xFFFF, self.modules.losses(chunk.link))
        if number is None:
            return None
        return Sample(record.module, number, time_ns, ((fx, fy, fz), (wx, wy, wz), NOT_READ))

    def dropped(self):
        return {name: {"bad_line": count} for name, count in self.bad.items()}

    def balances(self):
        yield Balance("packets_decoded", self.readings, {})
        yield Balance("readings", self.readings, {})


@pytest.fixture
def text_source(monkeypatch):
    monkeypatch.setitem(SOURCES, "text", SourceKind(TextSource))


async def test_a_source_in_one_file_serves_like_any_other(text_source, tmp_path, mosquitto, until):
    async def send(_reader, writer):
        start = asyncio.get_running_loop().time()
        with contextlib.suppress(ConnectionError):
            for k in range(100_000):
                writer.write(GOOD % (k, k * round(PERIOD_S * 1e6)))
                if k % 50 == 7:
                    writer.write(b"what is this?\n")
                await writer.drain()
                due = start + k * PERIOD_S
                await asyncio.sleep(max(0.0, due - asyncio.get_running_loop().time()))

    server = await asyncio.start_server(send, "127.0.0.1", 0)
    port = server.sockets[0].getsockname()[1]
    settings = GatewaySettings(
        gateway="lab",
        links=[{"name": "text", "url": f"tcp://127.0.0.1:{port}", "carries": "text"}],
        rig="single",
        reconstructor="independent",
        mqtt=MqttSettings(port=mosquitto.port),
        recording=RecordingSettings(at_start=True, folder=str(tmp_path), min_free_mb=1, warn_free_mb=1),
    )
    service = Service(settings, load_rig("single"))
    serving = asyncio.create_task(service.run())
    try:
        await until(lambda: service.pipeline.skeleton_frames > 150)
        figures = service.observer.figures()
        assert unaccounted(service.balances()) == {}
    finally:
        serving.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await serving
        server.close()
    (link,) = figures.links
    assert link.is_up
    assert link.dropped["bad_line"] > 0
    (module,) = figures.modules
    assert module.availability == "online"
    assert service.mqtt.counters.published > 50
    recording = open_recording(service.recording.status()["file"])
    assert recording.meta.links == {"text": "text"}
    assert verify(recording).is_identical


def test_a_word_that_no_source_has_is_refused_with_those_there_are(text_source):
    with pytest.raises(ValueError, match=r"carries: no source reads 'texts' \(did you mean 'text'\?\)"):
        GatewaySettings(links=[{"name": "a", "url": "tcp://h:1", "carries": "texts"}], rig="single")


def test_a_recording_of_a_source_that_is_gone_says_so():
    pipeline = Pipeline.from_settings(
        GatewaySettings(links=[{"name": "a", "url": "tcp://h:1"}], rig="single", reconstructor="independent"),
        load_rig("single"),
    )
    with pytest.raises(SettingsError, match="no source of this version reads 'text'"):
        pipeline.add_link("a", "text")
