"""Poses live to Foxglove and to ROS 2: a client that speaks the protocol gets what was offered."""

from __future__ import annotations

import asyncio
import json
import socket
import struct

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from devices.ros_definitions import JOINT_STATE, TF_MESSAGE, TYPE_HASHES
from gateway.body.rig import load_rig
from gateway.body.skeleton import Skeleton
from gateway.emulation.rig import dress, move
from gateway.errors import OutputError
from gateway.frames import SkeletonFrame
from gateway.outputs.foxglove import FoxgloveSink
from gateway.outputs.ros2 import Ros2Sink, publisher_id
from gateway.outputs.settings import FoxgloveSettings, OutputsSettings, Ros2Settings
from gateway.outputs.side_outputs import SideOutputs
from tests.patience import PATIENCE_S

BEGUN_NS = 1_700_000_000_123_456_789
SUIT = load_rig("suit_17")
WALK = move(dress(SUIT), SUIT.skeleton.name, 3)


def pose(k: int) -> SkeletonFrame:
    """A walking person, 20 ms a pose."""
    n = SUIT.skeleton.n_segments
    p_w = np.full((n, 3), np.nan)
    p_w[0] = [0.1 * k, 0.2, 0.9]
    return SkeletonFrame(
        sequence=k,
        time_ns=BEGUN_NS + 20_000_000 * k,
        q_wb=WALK.state(np.array([2.0 + 0.02 * k])).q_wb[0],
        angular_rate=np.zeros((n, 3)),
        joint_acceleration=np.zeros((n, 3)),
        p_w=p_w,
        sigma=np.zeros(n),
        status=np.zeros(n, np.uint8),
        root=0,
    )


def assert_is_pose(frame: SkeletonFrame, transforms, skeleton: Skeleton) -> None:
    """transforms: (parent, child, place, rotation x y z w); chained from ``map`` they are the pose."""
    found = {"map": (Rotation.identity(), np.zeros(3))}
    for parent, child, place, turn in transforms:
        of_parent, from_place = found[parent]
        found[child] = of_parent * Rotation.from_quat(turn), from_place + of_parent.apply(place)
    neutral = Rotation.from_quat(skeleton.neutral, scalar_first=True)
    for s, name in enumerate(skeleton.segment_names):
        expected = Rotation.from_quat(frame.q_wb[s], scalar_first=True)
        assert (expected.inv() * found[name][0] * neutral).magnitude() < 1e-9
    np.testing.assert_allclose(found["pelvis"][1], frame.p_w[0], atol=1e-12)


class ViewerOfFoxglove:
    """What Foxglove does when it opens a connection, as far as it is needed to see a body."""

    def __init__(self, connection) -> None:
        self.connection = connection
        self.channels: dict[str, dict] = {}

    async def subscribe(self, topics: set[str]) -> None:
        while not topics <= set(self.channels):
            message = await self.connection.recv()
            if isinstance(message, str):
                told = json.loads(message)
                for channel in told.get("channels", ()):
                    self.channels[channel["topic"]] = channel
        wanted = [
            {"id": self.channels[topic]["id"], "channelId": self.channels[topic]["id"]} for topic in topics
        ]
        await self.connection.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))

    async def next(self) -> tuple[str, int, bytes]:
        """Topic, time in ns, message."""
        topics = {channel["id"]: topic for topic, channel in self.channels.items()}
        while True:
            message = await self.connection.recv()
            if isinstance(message, bytes) and message[0] == 1:
                subscription, time_ns = struct.unpack_from("<IQ", message, 1)
                return topics[subscription], time_ns, message[13:]


async def test_foxglove_shows_what_is_offered_at_its_own_instants():
    pytest.importorskip("foxglove", reason="the extra foxglove is not installed")
    schemas = pytest.importorskip("foxglove_schemas_protobuf.FrameTransforms_pb2")
    scenes = pytest.importorskip("foxglove_schemas_protobuf.SceneUpdate_pb2")
    from websockets.asyncio.client import connect  # noqa: PLC0415 - comes with the viewer

    sink = FoxgloveSink(FoxgloveSettings(port=0), SUIT.skeleton, "lab")
    await sink.open()
    try:
        async with asyncio.timeout(PATIENCE_S):
            url = f"ws://127.0.0.1:{sink.port}"
            async with connect(url, subprotocols=["foxglove.sdk.v1"]) as connection:
                viewer = ViewerOfFoxglove(connection)
                await viewer.subscribe({"/tf", "/body", "/joint_angles"})
                found: dict[str, tuple[int, bytes]] = {}
                k = 0
                while set(found) < {"/tf", "/body", "/joint_angles"}:
                    assert sink.send(pose(k))
                    k += 1
                    with_time = asyncio.create_task(viewer.next())
                    done, _ = await asyncio.wait({with_time}, timeout=0.05)
                    if done:
                        topic, time_ns, data = with_time.result()
                        found[topic] = time_ns, data
                    else:
                        with_time.cancel()
    finally:
        sink.close()
    time_ns, data = found["/tf"]
    frame = pose(round((time_ns - BEGUN_NS) / 20_000_000))
    assert frame.time_ns == time_ns
    message = schemas.FrameTransforms.FromString(data)
    assert {each.timestamp.ToNanoseconds() for each in message.transforms} == {time_ns}
    transforms = [
        (
            each.parent_frame_id,
            each.child_frame_id,
            [getattr(each.translation, name) for name in "xyz"],
            [getattr(each.rotation, name) for name in "xyzw"],
        )
        for each in message.transforms
    ]
    assert_is_pose(frame, transforms, SUIT.skeleton)
    entities = scenes.SceneUpdate.FromString(found["/body"][1]).entities
    assert [entity.frame_id for entity in entities] == list(SUIT.skeleton.segment_names)
    assert set(json.loads(found["/joint_angles"][1])) == {joint.name for joint in SUIT.skeleton.joints}


async def test_a_port_that_is_taken_is_an_error_that_says_so():
    pytest.importorskip("foxglove", reason="the extra foxglove is not installed")
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        sink = FoxgloveSink(FoxgloveSettings(port=port), SUIT.skeleton, "lab")
        with pytest.raises(OutputError, match=rf"outputs.foxglove: cannot listen on 127.0.0.1:{port}"):
            await sink.open()


@pytest.fixture
def router(unused_port):
    """(port, messages so far, session): what rmw_zenohd is, and a listener."""
    zenoh = pytest.importorskip("zenoh", reason="the extra ros2 is not installed")
    plain = {
        "mode": "router",
        "listen": {"endpoints": [f"tcp/127.0.0.1:{unused_port}"]},
        "scouting": {"multicast": {"enabled": False}},
    }
    with zenoh.open(zenoh.Config.from_json5(json.dumps(plain))) as session:
        messages: list[tuple[str, bytes, bytes]] = []

        def take(sample) -> None:
            messages.append((str(sample.key_expr), bytes(sample.payload), bytes(sample.attachment)))

        listening = session.declare_subscriber("*/**", take)
        yield unused_port, messages, session
        listening.undeclare()


async def test_nodes_of_ros_2_get_transforms_and_joints_with_the_measurements_own_stamps(router, until):
    typesys = pytest.importorskip("rosbags.typesys", reason="rosbags is not installed")
    types = typesys.get_typestore(typesys.Stores.ROS2_JAZZY)
    port, messages, session = router
    side = SideOutputs(
        OutputsSettings(ros2={"router": f"tcp/127.0.0.1:{port}", "domain": 7, "rate": 1000}),
        SUIT.skeleton,
        "lab",
        100.0,
    )
    topics = {
        "7/tf/tf2_msgs::msg::dds_::TFMessage_/" + TYPE_HASHES[TF_MESSAGE],
        "7/humans/bodies/mocap/joint_states/sensor_msgs::msg::dds_::JointState_/" + TYPE_HASHES[JOINT_STATE],
    }
    async with side.running():
        k = 0

        def all_came() -> bool:
            nonlocal k
            side.offer(pose(k))
            k += 1
            return {key for key, *_ in messages} >= topics

        await until(all_came)
        tokens = [str(reply.ok.key_expr) for reply in session.liveliness().get("@ros2_lv/**")]
    kinds = sorted(token.split("/")[5] for token in tokens)
    assert kinds == ["MP", "MP", "NN"]
    assert any(
        token.split("/")[9:12] == ["%tf", "tf2_msgs::msg::dds_::TFMessage_", TYPE_HASHES[TF_MESSAGE]]
        for token in tokens
    )
    counts: dict[str, list[int]] = {}
    for key, data, attachment in messages:
        number, source_ns, size, who = struct.unpack("<qqB16s", attachment)
        counts.setdefault(key, []).append(number)
        assert (size, len(who)) == (16, 16)
        kind = TF_MESSAGE if key.startswith("7/tf/") else JOINT_STATE
        message = types.deserialize_cdr(data, kind)
        headers = [each.header for each in message.transforms] if kind == TF_MESSAGE else [message.header]
        assert {each.stamp.sec * 10**9 + each.stamp.nanosec for each in headers} == {source_ns}
        if kind == TF_MESSAGE:
            transforms = [
                (
                    each.header.frame_id,
                    each.child_frame_id,
                    [getattr(each.transform.translation, name) for name in "xyz"],
                    [getattr(each.transform.rotation, name) for name in "xyzw"],
                )
                for each in message.transforms
            ]
            assert_is_pose(pose((source_ns - BEGUN_NS) // 20_000_000), transforms, SUIT.skeleton)
        else:
            assert len(message.name) == len(message.position) > 20
    for numbers in counts.values():
        assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))


@pytest.mark.parametrize(
    "session", ["8837b8266bcd4e99fa6ca0e78de03a03", "837b8266bcd4e99fa6ca0e78de03a03", "7"]
)
def test_sessions_of_any_id_make_an_id_of_16_bytes(session):
    assert len(publisher_id(session, 2)) == 16
    assert publisher_id(session, 1) != publisher_id(session, 2)


def test_hashes_of_types_are_those_of_ros():
    typesys = pytest.importorskip("rosbags.typesys", reason="rosbags is not installed")
    types = typesys.get_typestore(typesys.Stores.ROS2_JAZZY)
    for message, expected in TYPE_HASHES.items():
        assert types.hash_rihs01(message) == expected


async def test_a_router_that_comes_later_is_found(unused_port, until):
    zenoh = pytest.importorskip("zenoh", reason="the extra ros2 is not installed")
    sink = Ros2Sink(Ros2Settings(router=f"tcp/127.0.0.1:{unused_port}"), SUIT.skeleton)
    await sink.open()
    try:
        assert sink.send(pose(0))
        plain = {
            "mode": "router",
            "listen": {"endpoints": [f"tcp/127.0.0.1:{unused_port}"]},
            "scouting": {"multicast": {"enabled": False}},
        }
        with zenoh.open(zenoh.Config.from_json5(json.dumps(plain))) as session:
            came = []
            listening = session.declare_subscriber("0/tf/**", came.append)
            await until(lambda: sink.send(pose(1)) and came)
            listening.undeclare()
    finally:
        sink.close()


@pytest.mark.parametrize(
    ("kind", "module", "extra"), [("foxglove", "foxglove", "foxglove"), ("ros2", "zenoh", "ros2")]
)
async def test_absent_extras_are_named(monkeypatch, kind, module, extra):
    monkeypatch.setitem(__import__("sys").modules, module, None)
    side = SideOutputs(OutputsSettings(**{kind: {}}), SUIT.skeleton, "lab", 100.0)
    with pytest.raises(OutputError, match=rf"outputs\.{kind}: .*\[{extra}\]"):
        await side.open()


@pytest.mark.parametrize(
    "wrong", [{"router": "127.0.0.1"}, {"domain": 233}, {"body": "7"}, {"body": "a/b"}, {"rate": 0}]
)
def test_settings_that_make_no_sense_are_refused(wrong):
    with pytest.raises(ValidationError, match=next(iter(wrong))):
        Ros2Settings(**wrong)
