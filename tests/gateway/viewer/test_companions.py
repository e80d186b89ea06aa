"""Other people on the page: they come, are drawn where they stand, and go."""

import asyncio
import contextlib

import aiomqtt
import numpy as np
import pytest

pytest.importorskip("viser", reason="the extra 'viewer' is not installed")

import viser

from devices.link import gateway_time_ns
from gateway.body.rig import load_rig
from gateway.contract.messages import BridgeHealth, OutputCounters, PoseMessage, describe_body
from gateway.outputs.settings import MqttSettings
from gateway.outputs.subscriber import ReceivedPose
from gateway.viewer.companions import Companions
from gateway.viewer.live import LiveViewer
from gateway.viewer.stage import ViewerStage
from tests.patience import PATIENCE_S

BODY = load_rig("suit_17").skeleton
MESSAGE = describe_body(BODY)


def received(gateway, x, age_s=0.0):
    names = BODY.segment_names
    pose = PoseMessage(
        t_ns=1, seq=1, frame="ENU", order="wxyz", root="pelvis",
        segments=dict.fromkeys(names, tuple(BODY.neutral.tolist())),
        status=dict.fromkeys(names, "measured"), position={"pelvis": (x, 0.0, 0.95)},
    )  # fmt: skip
    return ReceivedPose(gateway, gateway_time_ns() - round(age_s * 1e9), pose, b"")


def shown(companions):
    return sorted(companions._drawn)


def test_those_of_the_same_room_are_drawn_and_leave_with_their_poses():
    server = viser.ViserServer("127.0.0.1", 0, verbose=False)
    try:
        companions = Companions(server, ViewerStage(server))
        bodies = dict.fromkeys(("lab_1", "lab_2", "lab_3", "hall_1", "lab"), MESSAGE)

        def draw(beside, bodies):
            for k, name in enumerate(bodies):
                companions.add(received(name, 1.0 * k))
            companions.draw(beside, bodies)

        draw("lab_1", bodies)
        assert shown(companions) == ["lab_2", "lab_3"]
        scene = companions._drawn["lab_2"]._scene
        places = scene._figure._limbs.batched_positions
        assert np.abs(np.median(places[:, 0]) - 1.0) < 0.2
        label = server.scene._handle_from_node_name["/companions/lab_2/name"]
        assert label.text == "lab_2"
        assert places[:, 2].max() < label.position[2] < places[:, 2].max() + 0.5
        draw("lab_1", {name: body for name, body in bodies.items() if name != "lab_2"})
        assert shown(companions) == ["lab_3"]
        draw("lab", bodies)
        assert shown(companions) == []
        draw("lab_1", bodies)
        companions.add(received("lab_2", 1.0, age_s=5.0))
        companions.draw("lab_1", bodies)
        assert shown(companions) == ["lab_3"]
    finally:
        server.stop()


def test_people_with_markers_in_one_room_are_drawn_beside_each_other():
    server = viser.ViserServer("127.0.0.1", 0, verbose=False)
    try:
        companions = Companions(server, ViewerStage(server))
        bodies = dict.fromkeys(("lab", "lab_eve", "lab_bob", "laboratory", "lab_suit"), MESSAGE)
        marked = ("lab", "lab_eve", "lab_bob", "laboratory")
        for beside, others in (("lab", ["lab_bob", "lab_eve"]), ("lab_eve", ["lab", "lab_bob"])):
            for _ in range(2):  # whose poses are wanted is known by the markers of the picture before
                for name in bodies:
                    companions.add(received(name, 0.0))
                companions.draw(beside, bodies, marked)
            assert shown(companions) == others
        companions.draw("lab_suit", bodies, marked)
        assert shown(companions) == []
    finally:
        server.stop()


def health(*present):
    counters = OutputCounters(published=0, dropped=0, thinned=0, queued=0, connections=1)
    people = {"people": {"present": list(present)}}
    return BridgeHealth(t_ns=1, uptime_s=1.0, mqtt=counters, statistics=people).payload()


async def test_a_page_for_a_gateway_shows_the_people_before_its_cameras(mosquitto):
    """The gateway itself has no pose to show: each of the people has a name of their own."""
    mosquitto.is_for_gateways_only = False
    server = viser.ViserServer("127.0.0.1", 0, verbose=False)
    viewer = LiveViewer(server, MqttSettings(port=mosquitto.port), "lab")
    said = []
    viewer._panel.show_status = lambda *texts, **_: said.append(texts)
    showing = asyncio.create_task(viewer.run())
    try:
        async with aiomqtt.Client("127.0.0.1", mosquitto.port) as client, asyncio.timeout(PATIENCE_S):
            await client.publish("mocap/lab/bridge/state", "online", qos=1, retain=True)
            while not any("nobody is before the cameras" in texts for texts in said):
                await client.publish("mocap/lab/bridge/health", health(), qos=1)
                await asyncio.sleep(0.05)
            for name in ("hall_1", "lab_1", "lab_2"):
                await client.publish(f"mocap/{name}/bridge/state", "online", qos=1, retain=True)
                await client.publish(f"mocap/{name}/body", MESSAGE.payload(), qos=1, retain=True)
            while not shown(viewer._companions):
                for k, name in enumerate(("hall_1", "lab_1", "lab_2")):
                    pose = received(name, 1.0 * k).pose
                    await client.publish(f"mocap/{name}/pose", pose.payload(), qos=1)
                await asyncio.sleep(0.05)
            assert sorted([viewer._gateway, *shown(viewer._companions)]) == ["lab_1", "lab_2"]
    finally:
        showing.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await showing
        server.stop()
