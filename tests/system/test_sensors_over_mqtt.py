"""Sensors are calibrated by requests, and on the page, while the gateway runs."""

from __future__ import annotations

import asyncio

import pytest

from gateway.body.rig import load_rig
from gateway.modules.operations import RequestError
from gateway.modules.remote import remote_suit
from gateway.outputs.settings import MqttSettings
from tests.patience import PATIENCE_S
from tests.suit_service import GATEWAY, started

pytestmark = pytest.mark.system


@pytest.fixture
def tumbled(command, mosquitto, tmp_path, monkeypatch):
    """``await tumbled()``: the gateway of a suit that lies in a box and is turned."""
    monkeypatch.chdir(tmp_path)

    async def start():
        words = ["--tumbling", "--imperfections", "uncalibrated"]
        gateway = await started(command, tmp_path, mosquitto.port, "arm_3", *words, allow_device_writes=True)
        await gateway.until_it_says("connected to the MQTT broker")
        return MqttSettings(port=mosquitto.port)

    return start


async def until(ask, condition):
    async with asyncio.timeout(2 * PATIENCE_S):
        while not condition(status := await ask.perform("status", {})):
            await asyncio.sleep(0.3)
    return status


async def test_gyroscopes_are_calibrated_into_a_rig_file_and_into_modules(tumbled, tmp_path):
    mqtt = await tumbled()
    async with remote_suit(mqtt, GATEWAY, "sensors") as ask:
        with pytest.raises(RequestError, match="sensors/begin first"):
            await ask.perform("result", {})
        with pytest.raises(RequestError, match="the rig has no module 40: it has 1, 8, 9"):
            await ask.perform("begin", {"modules": [40]})
        with pytest.raises(RequestError, match="sensors/begin"):
            await ask.perform("begin", {"sensors": ["nose"]})
        assert (await ask.perform("status", {}))["phase"] == "idle"
        await ask.perform("begin", {"sensors": ["gyroscope"]})
        status = await until(ask, lambda told: told["enough"])
        assert status["advice"] == "enough"
        assert {one["segment"] for one in status["modules"]} == {"thorax", "right_upper_arm", "right_forearm"}
        found = (await ask.perform("result", {}))["modules"]
        assert {one["gyroscope"]["quality"] for one in found.values()} <= {"good", "fair", "poor"}
        kept = await ask.perform("accept", {"poor": True})
        kept_in = str(tmp_path / "arm_3.worn.yaml")
        assert kept == {"accepted": [1, 8, 9], "file": kept_in, "is_configured": True}
        worn = load_rig(kept_in).calibrations
        for module, one in found.items():
            bias = worn[int(module)].gyroscope_bias
            assert abs(bias - one["gyroscope"]["bias"]).max() < 1e-5
        await ask.perform("begin", {"sensors": ["gyroscope"], "modules": [8]})
        await until(ask, lambda told: told["enough"])
        assert (await ask.perform("accept", {"flash": True, "poor": True}))["accepted"] == [8]
        assert (await ask.perform("status", {}))["phase"] == "idle"
    async with remote_suit(mqtt, GATEWAY) as ask:
        settings = (await ask.perform("read", {"device": "8"}))["settings"]
        assert any(settings["calibration"])


async def test_what_was_begun_on_a_page_is_gone_on_with_on_another(tumbled, unused_port, chromium):
    from gateway.viewer.sensor_tab import LOOK_S  # noqa: PLC0415 - needs the extra
    from tests.shown_page import open_tab, page_of, press  # noqa: PLC0415 - needs the extra

    mqtt = await tumbled()
    for begins in (True, False):
        async with page_of(mqtt, unused_port, chromium) as (page, _):
            await page.get_by_text(f"{GATEWAY}: online").wait_for()
            await open_tab(page, "4 Sensors")
            if begins:
                await press(page, "Begin with the sensors")
            else:
                await press(page, "Go on with what was begun")
            await page.get_by_role("cell", name="right forearm").wait_for()
            if not begins:
                await press(page, "Give it up")
                answer = page.get_by_text("given up; nothing has changed")
                await answer.wait_for()
                await asyncio.sleep(2 * LOOK_S)
                assert await answer.is_visible(), "what watched until now has said so over it"
