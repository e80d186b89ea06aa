"""Two gateways on a real broker, compared while they run."""

from __future__ import annotations

import asyncio

import numpy as np
import orjson
from scipy.spatial.transform import Rotation

from gateway.cli.compare import Alignment, Live, run_live
from gateway.contract.messages import BodyMessage, BodySegment, ComparisonMessage, PoseMessage
from gateway.outputs.connection import broker_connection
from gateway.outputs.settings import MqttSettings
from tests.patience import PATIENCE_S

SEGMENTS = ("upper", "lower")
HEADING_DEG, LAG_S, APART_DEG = 40.0, 7.5, 12.0


def body(name):
    place = {"offset": (0, 0, 0), "tip": (0, -0.4, 0)}
    upper, lower = SEGMENTS
    return BodyMessage(
        name=name,
        segments=(
            BodySegment(name=upper, parent=None, **place),
            BodySegment(name=lower, parent=upper, **place),
        ),
    )


def poses(count, turned_deg, later_s, apart_deg):
    """12 s of an arm at 50 Hz."""
    time_s = np.arange(count) / 50.0
    rng = np.random.default_rng(2)
    turn = Rotation.from_rotvec([0, 0, np.radians(turned_deg)])
    mounting = Rotation.from_rotvec([np.radians(apart_deg), 0, 0])
    q = {}
    for name in SEGMENTS:
        f, phase = rng.uniform(0.2, 1.0, 3), rng.uniform(0, 6, 3)
        own = Rotation.from_rotvec(np.sin(2 * np.pi * f * time_s[:, None] + phase))
        q[name] = (turn * own * mounting).as_quat(scalar_first=True)
    for i in range(count):
        yield PoseMessage(
            t_ns=10**18 + round((time_s[i] + later_s) * 1e9),
            seq=i,
            frame="ENU",
            order="wxyz",
            root=SEGMENTS[0],
            segments={name: tuple(q[name][i]) for name in SEGMENTS},
            status=dict.fromkeys(SEGMENTS, "measured"),
        )


async def play(settings, gateway, *motion):
    async with broker_connection(settings, settings.port, gateway) as client:
        await client.publish(f"mocap/{gateway}/body", body(gateway).payload(), qos=1, retain=True)
        for number, pose in enumerate(poses(600, *motion)):
            await client.publish(f"mocap/{gateway}/pose", pose.payload())
            if number % 20 == 0:  # no faster than a reader of 256 poses can take them
                await asyncio.sleep(0.01)


async def listen(settings, heard):
    async with broker_connection(settings, settings.port, "listener") as client:
        await client.subscribe("mocap/+/comparison")
        heard.ready.set()
        async for message in client.messages:
            heard.messages.append((message.topic.value, message.payload))
            return


class Heard:
    def __init__(self):
        self.ready, self.messages = asyncio.Event(), []


async def until_said(capsys, words):
    """Until the words were written for the user."""
    written = ""
    async with asyncio.timeout(PATIENCE_S):
        while words not in written:
            await asyncio.sleep(0.05)
            written += capsys.readouterr().err


async def test_two_gateways_are_compared_and_the_figures_published(mosquitto, capsys):
    settings, heard = MqttSettings(port=mosquitto.port), Heard()
    listening = asyncio.create_task(listen(settings, heard))
    await heard.ready.wait()
    wanted = Live("suit", "cameras", Alignment(), 20.0, 1, True)
    comparing = asyncio.create_task(asyncio.to_thread(run_live, settings, wanted))
    await until_said(capsys, "waiting for poses of gateway 'suit'")
    await play(settings, "suit", 0.0, 0.0, 0.0)
    await play(settings, "cameras", HEADING_DEG, LAG_S, APART_DEG)
    async with asyncio.timeout(PATIENCE_S):
        assert await comparing == 0
        await listening
    (topic, payload) = heard.messages[0]
    assert topic == "mocap/suit/comparison"
    said = ComparisonMessage.model_validate_json(payload)
    assert abs(said.lag_s - LAG_S) < 2e-3
    assert abs(said.heading_deg - HEADING_DEG) < 0.5
    assert said.correlation > 0.99
    for name in SEGMENTS:
        assert said.segments[name].rms_deg < 0.5
        assert abs(said.segments[name].axes_apart_deg - APART_DEG) < 0.5
        assert said.segments[name].position_rms_m is None
    assert orjson.loads(capsys.readouterr().out.splitlines()[-1])["second"] == "cameras"


async def test_a_gateway_that_is_not_there_is_waited_for(mosquitto, capsys):
    settings = MqttSettings(port=mosquitto.port)
    wanted = Live("suit", "cameras", Alignment(), 20.0, 1, True)
    comparing = asyncio.create_task(asyncio.to_thread(run_live, settings, wanted))
    await until_said(capsys, "waiting for poses of gateway 'suit'")
    await play(settings, "suit", 0.0, 0.0, 0.0)
    await play(settings, "cameras", 0.0, 0.0, 0.0)
    async with asyncio.timeout(PATIENCE_S):
        assert await comparing == 0
