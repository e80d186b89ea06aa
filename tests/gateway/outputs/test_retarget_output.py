"""Joint states of a robot that follows: the same over MQTT, as datagrams, and to nodes of ROS 2."""

from __future__ import annotations

import asyncio
import json
import socket
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from devices.ros_definitions import JOINT_STATE, TF_MESSAGE, TYPE_HASHES
from gateway.body.rig import load_rig
from gateway.contract.messages import RobotMessage
from gateway.emulation.rig import dress, move
from gateway.errors import OutputError
from gateway.frames import SkeletonFrame
from gateway.outputs.retarget import RetargetSink
from gateway.outputs.settings import OutputsSettings
from gateway.outputs.side_outputs import SideOutputs
from tests.patience import PATIENCE_S

SUIT = load_rig("suit_17")
WALK = move(dress(SUIT), SUIT.skeleton.name, 3)


@pytest.fixture
def urdf() -> Path:
    pytest.importorskip("mink", reason="the extra robot is not installed")
    models = pytest.importorskip("icub_models", reason="icub-models is not installed")
    return Path(models.get_model_file("iCubGazeboV2_7"))


def pose(k: int) -> SkeletonFrame:
    n = SUIT.skeleton.n_segments
    q_wb = WALK.state(np.array([2.0 + 0.01 * k])).q_wb[0]
    nowhere, zeros = np.full((n, 3), np.nan), np.zeros((n, 3))
    return SkeletonFrame(
        k, 1_700_000_000_000_000_000 + 10_000_000 * k, q_wb, zeros, zeros, nowhere, np.zeros(n),
        np.zeros(n, np.uint8), 0,
    )  # fmt: skip


@pytest.fixture
def receiver():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as found:
        found.bind(("127.0.0.1", 0))
        found.settimeout(PATIENCE_S)
        yield found


async def test_the_broker_and_a_datagram_get_the_same_message(urdf, receiver):
    given = []
    settings = OutputsSettings.model_validate(
        {"retarget": {"robot": "icub", "urdf": urdf, "udp": {"port": receiver.getsockname()[1]}}}
    )
    side = SideOutputs(settings, SUIT.skeleton, "lab", 100.0, publish=lambda *told: not given.append(told))
    async with side.running():
        for k in range(3):
            side.offer(pose(k))
            await asyncio.sleep(0)
        assert side.counters["retarget"].published == 3
    topic, payload = given[-1]
    assert topic == "robot/joint_states"
    assert [receiver.recv(65536) for _ in range(3)] == [payload for _, payload in given]
    message = RobotMessage.model_validate_json(payload)
    assert (message.robot, message.seq, message.t_ns) == ("iCub", 2, pose(2).time_ns)
    assert len(message.joints) == 32
    assert set(message.joints) == set(message.rates)
    assert 0.5 < message.base.position[2] < 0.65
    assert message.joints["l_elbow"] >= 0.2617993877991494  # its limit, as sent too
    assert message.error_deg < 20  # it has only begun to move


async def test_what_the_broker_does_not_take_counts_as_dropped(urdf):
    settings = OutputsSettings.model_validate({"retarget": {"robot": "icub", "urdf": urdf}})
    side = SideOutputs(settings, SUIT.skeleton, "lab", 100.0, publish=lambda *_: False)
    async with side.running():
        side.offer(pose(0))
        await asyncio.sleep(0)
        assert side.counters["retarget"].dropped == 1


async def test_a_node_of_ros_2_gets_joint_states_and_the_base(urdf, unused_port):
    zenoh = pytest.importorskip("zenoh", reason="the extra ros2 is not installed")
    rosbags = pytest.importorskip("rosbags.typesys")
    config = zenoh.Config.from_json5(
        json.dumps(
            {
                "mode": "router",
                "listen": {"endpoints": [f"tcp/127.0.0.1:{unused_port}"]},
                "scouting": {"multicast": {"enabled": False}},
            }
        )
    )
    found: dict[str, bytes] = {}
    with zenoh.open(config) as node:
        keys = {
            "joints": f"0/robot/joint_states/sensor_msgs::msg::dds_::JointState_/{TYPE_HASHES[JOINT_STATE]}",
            "tf": f"0/tf/tf2_msgs::msg::dds_::TFMessage_/{TYPE_HASHES[TF_MESSAGE]}",
        }
        subscribers = [
            node.declare_subscriber(
                key, lambda sample, name=name: found.update({name: bytes(sample.payload)})
            )
            for name, key in keys.items()
        ]
        settings = OutputsSettings.model_validate(
            {
                "retarget": {
                    "robot": "icub",
                    "urdf": urdf,
                    "mqtt": False,
                    "ros2": {"router": f"tcp/127.0.0.1:{unused_port}"},
                }
            }
        )
        sink = RetargetSink(settings.retarget, SUIT.skeleton, lambda *_: pytest.fail("mqtt is off"))
        await sink.open()
        try:
            async with asyncio.timeout(PATIENCE_S):
                k = 0
                while set(found) < set(keys):
                    assert sink.send(pose(k))
                    k += 1
                    await asyncio.sleep(0.02)
        finally:
            sink.close()
            for subscriber in subscribers:
                subscriber.undeclare()
    store = rosbags.get_typestore(rosbags.Stores.ROS2_JAZZY)
    state = store.deserialize_cdr(found["joints"], JOINT_STATE)
    assert len(state.name) == len(state.position) == len(state.velocity) == 32
    assert len(state.effort) == 0
    assert {"l_knee", "r_elbow", "torso_yaw"} <= set(state.name)
    assert state.header.stamp.sec == 1_700_000_000
    (base,) = store.deserialize_cdr(found["tf"], TF_MESSAGE).transforms
    assert (base.header.frame_id, base.child_frame_id) == ("map", "root_link")
    assert 0.5 < base.transform.translation.z < 0.65


async def test_a_robot_that_there_is_not_ends_the_start_with_a_remedy():
    settings = OutputsSettings.model_validate({"retarget": {"robot": "icub", "urdf": "none.urdf"}})
    with pytest.raises(OutputError, match=r"outputs\.retarget: none\.urdf: no such file"):
        await SideOutputs(settings, SUIT.skeleton, "lab", 100.0).open()
    with pytest.raises(ValidationError, match="robot"):
        OutputsSettings.model_validate({"retarget": {}})
