"""What a running gateway tells of itself: modules, gateway time against UTC, metrics, health."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import time
import urllib.error
import urllib.request
from collections import defaultdict
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import orjson
import pytest
from prometheus_client.openmetrics.parser import text_string_to_metric_families as parse_openmetrics
from prometheus_client.parser import text_string_to_metric_families as parse_text

from gateway.body.rig import load_rig
from gateway.contract.messages import BridgeHealth, BridgeInfo, ModuleState, PoseMessage
from gateway.errors import OutputError
from gateway.outputs.connection import broker_connection
from gateway.service.observability import Observer
from gateway.service.service import Service
from gateway.settings import GatewaySettings
from tests.patience import PATIENCE_S
from tests.typed_here import typed_here

pytestmark = pytest.mark.system

HOUR_NS = 3600 * 10**9
SILENT_AFTER_S = 2.0
"""Longer than a busy machine keeps a gateway from reading."""


class Listener:
    """All that a broker relays, by topic."""

    def __init__(self):
        self.messages = defaultdict(list)

    def newest(self, topic):
        messages = self.messages[f"mocap/lab/{topic}"]
        return orjson.loads(messages[-1]) if messages else None

    async def listen(self, client):
        async for message in client.messages:
            self.messages[message.topic.value].append(message.payload)


@contextlib.asynccontextmanager
async def gateway_of(suit, broker_port, **settings):
    """(service, listener) of a gateway on an emulated robot arm."""
    gateway_settings = GatewaySettings(
        gateway="lab",
        links=[{"name": "suit", "url": "loopback"}],
        rig="robot_arm_4",
        reconstructor="independent",
        mqtt={"port": broker_port, "health_interval": 0.1, "queue_length": 1000},
        modules={"state_interval_s": 0.5, "silent_after_s": SILENT_AFTER_S},
        **settings,
    )
    service = Service(gateway_settings, load_rig("robot_arm_4"), [suit.link])
    service.load.observe = lambda *_: False  # nothing is given up on a machine that is too busy
    listener = Listener()
    async with broker_connection(gateway_settings.mqtt, broker_port, "listener") as client:
        await client.subscribe("mocap/#", qos=1)
        listening = asyncio.create_task(listener.listen(client))
        serving = asyncio.create_task(service.run())
        try:
            yield service, listener, serving
        finally:
            serving.cancel()
            await asyncio.gather(serving, return_exceptions=True)
            with contextlib.suppress(TimeoutError):  # a broker that is away relays no farewell
                async with asyncio.timeout(PATIENCE_S):
                    while listener.newest("bridge/state") != {"state": "offline"} and not listening.done():
                        await asyncio.sleep(0.01)
            listening.cancel()
            await asyncio.gather(listening, return_exceptions=True)


def get(port, path, accept=""):
    """Status, content type and body of a real GET."""
    request = urllib.request.Request(f"http://127.0.0.1:{port}{path}", headers={"Accept": accept})
    try:
        with urllib.request.urlopen(request, timeout=PATIENCE_S) as response:
            return response.status, response.headers["Content-Type"], response.read()
    except urllib.error.HTTPError as error:
        return error.code, error.headers["Content-Type"], error.read()


async def fetch(port, path, accept=""):
    """The same, while the event loop goes on."""
    return await asyncio.to_thread(get, port, path, accept)


async def test_modules_are_told_of_fall_silent_come_back_and_end_offline(commanded_suit, mosquitto, until):
    async with commanded_suit() as suit:
        async with gateway_of(suit, mosquitto.port) as (_, listener, _serving):
            await until(lambda: listener.newest("module/3/availability") == {"state": "online"})
            await until(lambda: (listener.newest("module/1/state") or {}).get("rate_hz"))
            suit.traffic.cut_power(1, suit.soon_s(), off_s=2 * SILENT_AFTER_S)
            await until(lambda: listener.newest("module/1/availability") == {"state": "offline"})
            await until(lambda: listener.newest("module/1/state")["availability"] == "offline")
            state = ModuleState.model_validate(listener.newest("module/1/state"))
            assert state.silent_since_ns == state.last_arrival_ns
            assert listener.newest("module/0/availability") == {"state": "online"}
            await until(lambda: listener.newest("module/1/availability") == {"state": "online"})
            await until(lambda: listener.newest("module/1/state")["resets"] == 1)
            assert listener.newest("module/1/state")["silent_since_ns"] is None
            await until(lambda: abs((listener.newest("module/2/state")["rate_hz"] or 0) - 100) < 15)
            state = ModuleState.model_validate(listener.newest("module/2/state"))
            assert (state.segment, state.lost, state.duplicates) == ("link_3", 0, 0)
            assert state.clock.bound_us is not None
            # told at its start, so by the module that has just started again
            assert listener.newest("module/1/state")["unique_id"] == suit.unique_id(1).hex()
        for module in range(4):
            assert listener.newest(f"module/{module}/availability") == {"state": "offline"}
            assert listener.newest(f"module/{module}/state")["availability"] == "offline"
        assert listener.newest("bridge/state") == {"state": "offline"}


async def test_health_tells_of_a_recording_that_ended_by_itself(commanded_suit, mosquitto, until, tmp_path):
    """A full disk ended it, the log said so once, and the health check went on saying ok."""
    recording = {"folder": str(tmp_path), "at_start": True}
    async with (
        commanded_suit() as suit,
        gateway_of(suit, mosquitto.port, recording=recording) as (service, _listener, _),
    ):
        await until(lambda: service.observer.health()["status"] == "ok")
        service.recording._files._free = lambda _folder: 0
        await until(lambda: service.observer.health()["status"] == "degraded")
        assert "min_free_mb" in service.observer.health()["recording_ended"]
        frames = service.pipeline.skeleton_frames
        await until(lambda: service.pipeline.skeleton_frames > frames)
        await service.recording.stop()
        assert service.observer.health()["recording_ended"] is None


async def test_a_broker_that_forgot_is_told_again(commanded_suit, mosquitto, until):
    async with commanded_suit() as suit, gateway_of(suit, mosquitto.port) as (service, listener, _):
        await until(lambda: listener.newest("module/3/availability") is not None)
        mosquitto.restart()  # it keeps nothing
        await until(lambda: service.mqtt.counters.connections == 2)
        late = Listener()
        settings = service.mqtt._settings
        async with broker_connection(settings, mosquitto.port, "late") as client:
            await client.subscribe("mocap/lab/module/#", qos=1)
            listening = asyncio.create_task(late.listen(client))
            await until(lambda: len(late.messages) == 8)
            listening.cancel()
        assert late.newest("module/3/availability") == {"state": "online"}


async def test_a_host_clock_set_by_an_hour_moves_the_anchor_and_no_pose(
    commanded_suit, mosquitto, until, monkeypatch, caplog
):
    wall_ns = time.time_ns
    set_by_ns = 0
    plain_init = Observer.__init__
    monkeypatch.setattr(
        Observer, "__init__", lambda *a, **k: plain_init(*a, **k, utc_ns=lambda: wall_ns() + set_by_ns)
    )
    async with commanded_suit() as suit, gateway_of(suit, mosquitto.port) as (_, listener, _serving):
        poses = listener.messages["mocap/lab/pose"]
        await until(lambda: len(poses) > 30 and listener.newest("bridge/info")["utc"] is not None)
        before = BridgeInfo.model_validate(listener.newest("bridge/info")).utc
        assert (before.steps, before.last_step_ns) == (0, None)
        at_step = len(poses)
        set_by_ns = HOUR_NS
        await until(lambda: listener.newest("bridge/health")["utc"]["steps"] == 1)
        await until(lambda: len(poses) > at_step + 50)
        info = BridgeInfo.model_validate(listener.newest("bridge/info")).utc
        health = BridgeHealth.model_validate(listener.newest("bridge/health")).utc
    assert info.last_step_ns == health.last_step_ns == pytest.approx(HOUR_NS, abs=2_000_000)
    assert info.offset_ns - before.offset_ns == info.last_step_ns
    assert health.offset_ns == info.offset_ns
    assert info.last_step_t_ns == info.t_ns > before.t_ns
    spacing_ns = np.diff([PoseMessage.model_validate_json(pose).t_ns for pose in poses])
    assert set((spacing_ns % 10_000_000).tolist()) == {0}
    assert 0 < spacing_ns.min() <= spacing_ns.max() < HOUR_NS / 60
    assert "UTC was set by +3600.00" in caplog.text


async def test_metrics_of_links_modules_poses_outputs_and_process(commanded_suit, mosquitto, until):
    async with (
        commanded_suit() as suit,
        gateway_of(suit, mosquitto.port, metrics={"port": 0}) as (service, _, _serving),
    ):

        async def metrics():
            status, content_type, text = await fetch(service.observer.metrics.port, "/metrics")
            assert (status, content_type.split(";")[0]) == (200, "text/plain")
            return {
                (sample.name, *sample.labels.values()): sample.value
                for family in parse_text(text.decode())
                for sample in family.samples
            }

        await until(lambda: service.mqtt.counters.published > 100)
        rate, deadline_s = ("mocap_module_rate_hz", "3", "link_4"), time.monotonic() + PATIENCE_S
        while abs((samples := await metrics()).get(rate, 0.0) - 100) > 15:
            assert time.monotonic() < deadline_s, samples
            await asyncio.sleep(0.1)
        assert samples["mocap_link_up", "suit"] == 1
        assert samples["mocap_module_online", "3", "link_4"] == 1
        assert samples["mocap_module_received_total", "3", "link_4"] > 80
        assert samples["mocap_module_lost", "3", "link_4"] == 0
        assert abs(samples["mocap_module_clock_offset_seconds", "3", "link_4"]) > 1
        assert samples["mocap_output_poses_total", "mqtt", "published"] > 50
        assert samples["mocap_output_connected", "mqtt"] == 1
        assert samples["process_resident_memory_bytes",] > 50e6
        assert samples["process_cpu_seconds_total",] > 0
        assert samples["mocap_utc_steps_total",] == 0
        frames = samples["mocap_skeleton_frames_total",]
        await until(lambda: service.pipeline.skeleton_frames > frames)
        accept = "application/openmetrics-text; version=1.0.0"
        status, content_type, text = await fetch(service.observer.metrics.port, "/metrics", accept)
        assert content_type.startswith("application/openmetrics-text")
        again = {f.name: f.samples for f in parse_openmetrics(text.decode())}
        assert again["mocap_skeleton_frames"][0].value > frames
        status, _, answer = await fetch(service.observer.metrics.port, "/elsewhere")
        assert (status, b"/metrics and /healthz" in answer) == (404, True)


async def healthy(service):
    """Return the port of a gateway once it says that it is well."""
    told, deadline_s = None, time.monotonic() + PATIENCE_S
    while told is None or told["status"] != "ok":
        assert time.monotonic() < deadline_s, told
        await asyncio.sleep(0.05)
        if service.observer.metrics.port:
            told = orjson.loads((await fetch(service.observer.metrics.port, "/healthz"))[2])
    return service.observer.metrics.port


async def test_health_tells_what_stands_in_the_way(commanded_suit, mosquitto, until):
    async with (
        commanded_suit() as suit,
        gateway_of(suit, mosquitto.port, metrics={"port": 0}) as (service, _, _serving),
    ):

        async def health():
            status, _, body = await fetch(service.observer.metrics.port, "/healthz")
            return status, orjson.loads(body)

        await healthy(service)
        status, told = await health()
        assert (status, told["status"], told["links_down"]) == (200, "ok", [])
        mosquitto.stop()
        await until(lambda: not service.mqtt.is_connected)
        status, told = await health()
        assert (status, told["status"], told["outputs_connected"]) == (200, "degraded", {"mqtt": False})


async def test_an_event_loop_that_is_stuck_is_unhealthy(commanded_suit, mosquitto, until, monkeypatch):
    monkeypatch.setattr("gateway.service.metrics_server.PATIENCE_S", 0.2)
    async with (
        commanded_suit() as suit,
        gateway_of(suit, mosquitto.port, metrics={"port": 0}) as (service, _, _serving),
    ):
        await until(lambda: service.mqtt.is_connected)
        with ThreadPoolExecutor() as other:  # which is waited for by the loop itself: it is stuck until then
            asking = other.submit(get, service.observer.metrics.port, "/healthz")
            status, _, body = asking.result(PATIENCE_S)
        assert (status, orjson.loads(body)["status"]) == (503, "stuck")


async def test_a_port_in_use_is_named(commanded_suit, mosquitto):
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        async with commanded_suit() as suit:
            settings = GatewaySettings(
                links=[{"name": "suit", "url": "x"}], rig="robot_arm_4", reconstructor="independent",
                mqtt={"port": mosquitto.port}, metrics={"port": port},
            )  # fmt: skip
            service = Service(settings, load_rig("robot_arm_4"), [suit.link])
            with pytest.raises(
                OutputError, match=rf"metrics: cannot listen at 127.0.0.1:{port} .*metrics.port"
            ):
                await service.run()


async def test_the_health_command_is_for_scripts(commanded_suit, mosquitto):
    async with (
        commanded_suit() as suit,
        gateway_of(suit, mosquitto.port, metrics={"port": 0}) as (service, _, _serving),
    ):
        port = await healthy(service)
        code, output, _ = await asyncio.to_thread(typed_here, ["health", "--port", port])
        assert (code, orjson.loads(output)["status"]) == (0, "ok")
    code, _, errors = await asyncio.to_thread(typed_here, ["health", "--port", port])
    assert code == 1
    assert "no gateway answers" in errors
