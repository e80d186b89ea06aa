"""What fails beside the stream is said and started again; the watchdog knows what cannot be."""

import asyncio
import logging

from gateway.body.rig import load_rig
from gateway.service.service import Service
from gateway.settings import GatewaySettings
from gateway.support import supervision
from gateway.support.supervision import kept_running
from tests.patience import PATIENCE_S


async def test_what_fails_is_said_and_started_again(monkeypatch, caplog):
    monkeypatch.setattr(supervision, "FIRST_PAUSE_S", 0.001)
    runs = 0

    async def fails_twice() -> None:
        nonlocal runs
        runs += 1
        if runs < 3:
            raise ValueError(f"no luck {runs}")

    await asyncio.wait_for(kept_running("the triggerer", fails_twice), PATIENCE_S)
    assert runs == 3
    errors = [record for record in caplog.records if record.levelno == logging.ERROR]
    assert [record.getMessage().split(";")[0] for record in errors] == ["the triggerer failed"] * 2
    assert "no luck 2" in str(errors[1].exc_info)


async def test_data_cannot_flow_once_the_output_has_died(unused_port):
    settings = GatewaySettings.model_validate(
        {"links": [{"name": "suit", "url": "/dev/nothing"}], "rig": "single", "mqtt": {"port": unused_port}}
    )
    service = Service(settings, load_rig("single"))
    running = asyncio.create_task(service.run())
    async with asyncio.timeout(PATIENCE_S):
        while not service.can_flow:
            await asyncio.sleep(0.01)
    task = service.mqtt._task
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
    assert not service.can_flow
    running.cancel()
    await asyncio.gather(running, return_exceptions=True)
