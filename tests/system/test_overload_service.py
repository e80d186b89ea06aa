"""A gateway whose reconstruction is too slow says so, gives up in order, goes on recording, and recovers."""

from __future__ import annotations

import asyncio
import contextlib
import sys
import time

import pytest

from devices.links.reconnect import LinkState
from gateway.body.rig import load_rig
from gateway.contract.balances import unaccounted
from gateway.recording import open_recording
from gateway.recording.solving import verify
from gateway.service import overload
from gateway.service.overload import SHED
from gateway.service.service import Service
from gateway.settings import GatewaySettings
from tests.running_suit import running
from tests.system.test_observability import fetch

pytestmark = [
    pytest.mark.system,
    pytest.mark.slow(reason="a gateway recovers only on a machine that has time for it: to be run alone"),
    pytest.mark.timeout(400),
]


MODULES, RATE_HZ, SECONDS = 4, 100, 120
PATIENCE_S = 60


@contextlib.asynccontextmanager
async def suit_process(link):
    """A suit in a process of its own: what holds up the gateway does not hold up the suit."""
    arguments = ("-m", "devices.emulators.paced_writer", str(link), str(MODULES), str(RATE_HZ), str(SECONDS))
    process = await asyncio.create_subprocess_exec(
        sys.executable, *arguments, stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE
    )
    await process.stdout.readline()
    try:
        yield process.stdin
    finally:
        process.kill()
        await process.wait()


@contextlib.asynccontextmanager
async def gateway_of(link, broker_port, **settings):
    gateway_settings = GatewaySettings(
        gateway="lab",
        links=[{"name": "suit", "url": str(link)}],
        rig="robot_arm_4",
        mqtt={"port": broker_port, "health_interval": 0.2, "segment_rate": 20},
        **settings,
    )
    service = Service(gateway_settings, load_rig("robot_arm_4"))
    async with running(service):
        yield service


async def test_order_report_recording_and_recovery(mosquitto, until, monkeypatch, tmp_path, caplog):
    monkeypatch.setattr(overload, "CALM_S_FIRST", 0.4)
    settings = {
        "metrics": {"port": 0},
        "outputs": {"udp_json": {"rate": 1000, "port": 39613}},
        "recording": {"folder": str(tmp_path), "at_start": True},
    }
    link = tmp_path / "suit"
    async with suit_process(link) as begin, gateway_of(link, mosquitto.port, **settings) as service:
        await until(lambda: service.links[0].state is LinkState.UP, PATIENCE_S)
        begin.write(b"\n")
        await until(lambda: service.pipeline.skeleton_frames > 50, PATIENCE_S)
        feed, cost_s = service.pipeline.feed, 0.015

        def slow_feed(chunk):
            frames = feed(chunk)
            time.sleep(cost_s * len(frames))
            return frames

        monkeypatch.setattr(service.pipeline, "feed", slow_feed)  # 1.5 s of work for a second of samples
        await until(lambda: service.load.stage >= 4, PATIENCE_S)
        paused = service.side.counters["udp_json"].published
        assert service.mqtt.health().statistics["load"]["stage"] >= 4
        _, _, metrics = await fetch(service.observer.metrics.port, "/metrics")
        assert float(metrics.decode().split("\nmocap_load_stage ")[1].split()[0]) >= 4
        _, _, health = await fetch(service.observer.metrics.port, "/healthz")
        assert b'"degraded"' in health
        assert b"half_the_frames" in health
        assert service.side.counters["udp_json"].published == paused
        cost_s = 0.0
        await until(lambda: service.load.stage == 0, PATIENCE_S)
        seen = service.side.counters["udp_json"].published
        await until(lambda: service.side.counters["udp_json"].published > seen, PATIENCE_S)
        assert service.pipeline.module_stage.left_out > 0
        assert unaccounted(service.balances()) == {}
        monkeypatch.undo()
    told = [record.getMessage() for record in caplog.records if record.getMessage().startswith("load stage")]
    assert [line.split()[2] for line in told[:4]] == ["1", "2", "3", "4"]
    assert told[-1].startswith(f"load stage 0 of {len(SHED) - 1}: everything is done")

    recording = open_recording(next(tmp_path.glob("*.mcap")))
    assert sum(event.name == "load" for event in recording.events()) == len(told)
    await asyncio.to_thread(lambda: _assert_whole(recording))


def _assert_whole(recording):
    """Nothing that arrived is missing, and a replay leaves out the same frames."""
    statistics = list(recording.statistics())[-1].values
    assert all(module["lost"] == 0 for module in statistics["modules"].values())
    verification = verify(recording)
    assert verification.is_identical, verification
    assert verification.compared > 100
