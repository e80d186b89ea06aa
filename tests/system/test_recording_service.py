"""A gateway that records while it publishes: by setting, on request, through faults; then replayed."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import json
import random
import re
import signal
import time

import aiomqtt
import pytest
import yaml

from gateway.body.rig import load_rig
from gateway.cli.run import record
from gateway.errors import GatewayError
from gateway.outputs.settings import MqttSettings
from gateway.recording import files, open_recording
from gateway.recording.control import RecordingControl
from gateway.recording.recovery import recover_in_place
from gateway.recording.solving import verify
from gateway.service.service import Service
from gateway.settings import GatewaySettings, RecordingSettings
from gateway.sources.link_settings import LinkSettings
from tests.patience import PATIENCE_S

pytestmark = pytest.mark.system

RIG = "robot_arm_4"
MB = 10**6
FIFTY = pytest.mark.slow(reason="fifty recordings in real time; one of them is always tried")


@pytest.fixture
def emulated(command, tmp_path):
    """``await emulated(*options)``: the port of an emulated arm in a process of its own."""

    async def start(*options):
        port = tmp_path / "port"
        suit = command("emulate", "--rig", RIG, "--on", "pty", "--link", port, "--json", *options)
        await suit.until_it_says('"url"')
        return port

    return start


def settings_for(port, folder, broker_port, **recording):
    kept = {"folder": str(folder), "min_free_mb": 1, "warn_free_mb": 1, "flush_ms": 50} | recording
    return GatewaySettings(
        gateway="lab",
        links=[LinkSettings(name="suit", url=str(port))],
        rig=RIG,
        reconstructor="independent",
        mqtt=MqttSettings(port=broker_port, health_interval=1),
        recording=RecordingSettings(**kept),
    )


@contextlib.asynccontextmanager
async def running(settings):
    service = Service(settings, load_rig(RIG))
    serving = asyncio.create_task(service.run())
    try:
        async with asyncio.timeout(2 * PATIENCE_S):
            while service.pipeline.skeleton_frames < 20 and not serving.done():
                await asyncio.sleep(0.02)
        yield service
    finally:
        serving.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await serving


async def test_a_recording_from_the_start_replays_bit_for_bit(tmp_path, emulated, mosquitto, until):
    port = await emulated("--imperfections", "typical")
    settings = settings_for(port, tmp_path / "kept", mosquitto.port, at_start=True)
    async with running(settings) as service:
        await until(lambda: service.pipeline.skeleton_frames > 280)
    status = service.recording.status()
    assert (status["state"], status["ended"], status["lost"]) == ("off", "stopped", {})
    recording = open_recording(status["file"])
    assert recording.meta.from_start
    found = verify(recording)
    assert found.difference is None
    assert found.compared == status["written"]["skeleton"] == service.pipeline.skeleton_frames > 200
    assert sum(1 for _ in recording.chunks()) == status["written"]["chunks"] > 20
    assert sum(1 for _ in recording.sent()) >= 8  # time requests are part of what poses depend on
    names = [event.name for event in recording.events()]
    assert names == ["recording_begun", "link", "link", "link", "recording_ended"]
    last = list(recording.statistics())[-1].values
    assert last["skeleton_frames"] == service.pipeline.skeleton_frames


async def test_requests_start_and_stop_recordings(tmp_path, emulated, mosquitto, until):
    async with (
        running(settings_for(await emulated(), tmp_path / "kept", mosquitto.port)) as service,
        aiomqtt.Client("127.0.0.1", mosquitto.port) as client,
    ):
        await client.subscribe("mocap/lab/bridge/response/recording/#")
        await client.subscribe("mocap/lab/bridge/health")
        numbers = itertools.count()

        async def ask(verb, **data):
            transaction = str(next(numbers))
            payload = json.dumps({**data, "transaction": transaction})
            await client.publish(f"mocap/lab/bridge/request/recording/{verb}", payload, qos=1)
            async for message in client.messages:
                answer = json.loads(message.payload)
                if answer.get("transaction") == transaction:
                    return answer
            raise AssertionError

        async with asyncio.timeout(2 * PATIENCE_S):
            await until(lambda: service.requests.is_connected)
            assert (await ask("status"))["data"]["state"] == "off"
            begun = await ask("start", name="walk")
            assert begun["status"] == "ok"
            assert re.search(r"\d{8}T\d{6}Z_walk\.mcap$", begun["data"]["file"])
            assert "already recording" in (await ask("start"))["error"]
            frames = service.pipeline.skeleton_frames
            await until(lambda: service.pipeline.skeleton_frames > frames + 50)
            async for message in client.messages:
                if message.topic.matches("mocap/lab/bridge/health"):
                    health = json.loads(message.payload)["statistics"]["recording"]
                    if health["state"] == "recording":
                        assert health["file"] == begun["data"]["file"]
                        break
            ended = await ask("stop")
            assert ended["data"]["state"] == "off"
            assert "nothing is being recorded" in (await ask("stop"))["error"]
            for name in ("../../etc/x", "a/b", ""):
                assert "a name of up to 64 letters" in (await ask("start", name=name))["error"]
            assert "'name' is 5: a text is wanted" in (await ask("start", name=5))["error"]
            assert "unknown setting 'folder'" in (await ask("start", folder="/etc"))["error"]
            assert "did you mean 'start'" in (await ask("stort"))["error"]
    (path,) = (tmp_path / "kept").iterdir()
    recording = open_recording(path)
    assert not recording.meta.from_start
    assert recording.defect is None
    assert sum(1 for _ in recording.skeleton_frames()) > 20


async def test_the_live_stream_goes_on_when_the_disk_is_full(
    tmp_path, emulated, mosquitto, monkeypatch, caplog, until
):
    free = [10_000 * MB]
    monkeypatch.setattr(
        files.SessionFiles.__init__,
        "__kwdefaults__",
        {**files.SessionFiles.__init__.__kwdefaults__, "free": lambda _: free[0]},
    )
    port = await emulated()
    settings = settings_for(port, tmp_path / "kept", mosquitto.port, at_start=True, min_free_mb=500)
    async with running(settings) as service:
        free[0] = 100 * MB
        await until(lambda: not service.recording.is_recording)
        before = service.pipeline.skeleton_frames, service.mqtt.counters.published
        await until(lambda: service.pipeline.skeleton_frames > before[0] + 50)
        await until(lambda: service.mqtt.counters.published > before[1] + 50)
        status = service.recording.status()
    assert "100 MB free, less than min_free_mb 500" in status["ended"]
    assert "recording has stopped" in caplog.text
    assert "The live stream goes on" in caplog.text
    assert open_recording(status["file"]).defect is None


@pytest.fixture
def recorder(command, tmp_path):
    """``recorder(settings, *options)``: ``mocap-gateway record`` under way."""

    def start(settings, *options):
        config = tmp_path / "gateway.yaml"
        config.write_text(yaml.safe_dump(settings.model_dump(mode="json", exclude_none=True)))
        return command("record", "-c", config, "--name", "cli", *options)

    return start


async def written_beyond(folder, size, process):
    """Wait until the recording in the folder is so large; its path."""

    def large():
        return [path for path in folder.glob("*.mcap") if path.stat().st_size > size]

    await process.until_so(large, f"a recording of {size} bytes")
    return large()[0]


async def test_record_ends_with_a_whole_file_on_ctrl_c(tmp_path, emulated, recorder, mosquitto):
    folder = tmp_path / "kept"
    port = await emulated("--imperfections", "typical")
    process = recorder(settings_for(port, folder, mosquitto.port))
    path = await written_beyond(folder, 100_000, process)
    process.send_signal(signal.SIGINT)
    assert await process.ended() == 0
    assert re.search(r"_cli\.mcap: [\d.]+ s, [\d.]+ MB, \d+ chunks, \d+ poses", process.output)
    assert verify(open_recording(path)).is_identical
    assert open_recording(path).defect is None


@pytest.mark.parametrize("kills", [1, pytest.param(50, marks=[FIFTY, pytest.mark.timeout(1200)])])
async def test_a_kill_at_any_moment_costs_no_more_than_the_flush_interval(
    tmp_path, emulated, recorder, mosquitto, kills
):
    flush_ms = 200
    moments, late = random.Random(5), []
    port = await emulated("--imperfections", "typical")
    for attempt in range(kills):
        folder = tmp_path / f"kept{attempt}"
        settings = settings_for(port, folder, mosquitto.port, flush_ms=flush_ms)
        process = recorder(settings, "--quiet")
        path = await written_beyond(folder, 20_000, process)
        await asyncio.sleep(moments.uniform(0, 1.0))
        process.kill()
        killed_ns = time.time_ns()
        await process.ended()
        recording = open_recording(path)
        chunks = list(recording.chunks())
        anchor = recording.meta.begun_utc_ns - recording.meta.begun_ns
        lost_ms = (killed_ns - (chunks[-1].arrived_ns + anchor)) * 1e-6
        late.append(lost_ms - flush_ms - 12)  # the suit speaks every 10 ms
        assert -1 < lost_ms <= 3 * flush_ms
        assert verify(recording).is_identical
        assert recover_in_place(path).messages > len(chunks)
        again = open_recording(path)
        assert list(again.chunks()) == chunks
        assert again.defect is None
    # A kill may meet a machine that is busy with something else; most do not.
    assert kills == 1 or sorted(late)[9 * kills // 10] <= 0


def config_of(tmp_path, port, broker_port):
    path = tmp_path / "gateway.yaml"
    settings = {
        "gateway": "lab",
        "rig": RIG,
        "reconstructor": "independent",
        "links": [{"name": "suit", "url": str(port)}],
        "mqtt": {"port": broker_port},
        "recording": {"folder": str(tmp_path / "kept"), "min_free_mb": 1, "warn_free_mb": 1},
    }
    path.write_text(yaml.safe_dump(settings))
    return path


def slow_to_start(seconds, monkeypatch):
    """Let outputs take so long until a recording can begin."""
    opened = Service.run

    async def run(self):
        await asyncio.sleep(seconds)
        await opened(self)

    monkeypatch.setattr(Service, "run", run)


def test_seconds_count_from_where_the_recording_begins(command, tmp_path, mosquitto, monkeypatch):
    port = tmp_path / "port"
    command("emulate", "--rig", RIG, "--on", "pty", "--link", port, "--json").until_said('"url"')
    slow_to_start(1.5, monkeypatch)
    monkeypatch.setattr("gateway.cli.run.set_up_logging", lambda *_: None)
    record(config_of(tmp_path, port, mosquitto.port), seconds=1.0, quiet=True)
    (kept,) = (tmp_path / "kept").glob("*.mcap")
    written = list(open_recording(kept).events())
    assert written[0].name == "recording_begun"
    begun_ns, ended_ns = (
        next(e.time_ns for e in written if e.name == f"recording_{w}") for w in ("begun", "ended")
    )
    assert ended_ns - begun_ns >= 0.9e9


def test_a_recording_that_is_ended_before_it_begins_says_so(tmp_path, mosquitto, monkeypatch):
    async def cancelled(_service):
        raise asyncio.CancelledError

    monkeypatch.setattr(Service, "run", cancelled)
    monkeypatch.setattr("gateway.cli.run.set_up_logging", lambda *_: None)
    with pytest.raises(GatewayError, match="nothing was recorded: it was ended before it had begun"):
        record(config_of(tmp_path, tmp_path / "port", mosquitto.port), quiet=True)
    assert not list(tmp_path.glob("**/*.mcap"))


def recorded_of(url, tmp_path, mosquitto, monkeypatch, seconds=0.1):
    monkeypatch.setattr("gateway.cli.run.set_up_logging", lambda *_: None)
    record(config_of(tmp_path, url, mosquitto.port), seconds=seconds, quiet=True)


def test_a_time_that_runs_out_while_an_error_ends_all_hides_no_error(tmp_path, mosquitto, monkeypatch):
    """It ended as if all were well."""
    stopped = RecordingControl.stop

    async def slowly(self):
        await asyncio.sleep(0.3)
        return await stopped(self)

    monkeypatch.setattr(RecordingControl, "stop", slowly)
    with pytest.raises(GatewayError, match=r"absent\.mcap cannot be read"):
        recorded_of("recording:///absent.mcap", tmp_path, mosquitto, monkeypatch)


def test_a_recording_of_nothing_tells_where_to_look(tmp_path, mosquitto, monkeypatch, capsys):
    recorded_of(tmp_path / "absent", tmp_path, mosquitto, monkeypatch)
    assert "nothing came over any link: `mocap-gateway doctor -c" in capsys.readouterr().err
