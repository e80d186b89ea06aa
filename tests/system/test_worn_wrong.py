"""A module that is worn upside down: from a real port to what apps read about it."""

from __future__ import annotations

import asyncio

import aiomqtt
import orjson
import pytest

from devices.emulators.emulated_suit import EmulatedSuit
from devices.emulators.imperfections import TYPICAL
from devices.emulators.suit_traffic import SuitSettings, SuitTraffic
from devices.emulators.transports import PtyTransport
from gateway.body.rig import load_rig
from gateway.emulation.rig import dress, move, worn_wrong
from gateway.service.service import Service
from gateway.settings import GatewaySettings
from tests.patience import PATIENCE_S
from tests.running_suit import running

pytestmark = pytest.mark.system

RIG, SEGMENT = "suit_lower_7", "left_shank"


async def test_its_segment_is_doubtful_and_its_state_says_why(tmp_path, mosquitto):
    port, suit = tmp_path / "suit", load_rig(RIG)
    settings = GatewaySettings(
        gateway="lab",
        links=[{"name": "suit", "url": str(port)}],
        rig=RIG,
        reconstructor="joint",
        mqtt={"port": mosquitto.port},
    )
    module = int(suit.module_ids[suit.module_of_segment[suit.skeleton.index(SEGMENT)]])
    body = worn_wrong(dress(suit), [module], [])
    traffic = SuitTraffic(move(body, suit.skeleton.name, 1), SuitSettings(), TYPICAL, 1)
    service, emulated = Service(settings, suit), EmulatedSuit(traffic, PtyTransport(port))
    doubts, doubtful = {}, set()
    try:
        async with (
            running(service),
            running(emulated),
            asyncio.timeout(PATIENCE_S),
            aiomqtt.Client("127.0.0.1", mosquitto.port) as client,
        ):
            await client.subscribe("mocap/lab/module/+/state")
            await client.subscribe("mocap/lab/pose")
            async for message in client.messages:
                told = orjson.loads(message.payload)
                if message.topic.matches("mocap/lab/pose"):
                    doubtful = {name for name, status in told["status"].items() if status == "doubtful"}
                elif told.get("doubt"):
                    doubts[int(str(message.topic).split("/")[3])] = told["doubt"]
                if module in doubts and SEGMENT in doubtful:
                    break
    except TimeoutError:
        pytest.fail(f"doubts {doubts}, doubtful {doubtful}; {service.statistics()}")
    assert doubts.keys() == {module}
    assert "180°" in doubts[module]
    assert doubtful == {SEGMENT}
