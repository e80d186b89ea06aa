"""Poses as topics of ROS 2: ``/tf`` and joint states, by Zenoh as rmw_zenoh speaks it (extra ``ros2``).

No part of ROS is needed here. Nodes find the topics by liveliness tokens, and messages by keys that name
domain, topic, type and the type's hash. Header stamps and source times are the instants of the measurement.
"""

from __future__ import annotations

import asyncio
import importlib
import json
import struct
from typing import Any

from devices.extras import how_to_add
from devices.ros_definitions import JOINT_STATE, TF, TF_MESSAGE, TYPE_HASHES
from gateway.body.skeleton import Skeleton
from gateway.contract.ros_messages import BodyJointStates, BodyTransforms
from gateway.errors import OutputError
from gateway.frames import SkeletonFrame
from gateway.outputs.settings import Ros2Settings

NODE = "mocap_gateway"
_QOS = "::,10:,:,:,,"
"""Reliable, volatile, the last 10: what listeners of /tf ask for."""
_ATTACHMENT = struct.Struct("<qqB16s")
"""Sequence number, source time in ns, size of the id, id of the publisher."""


def topic_key(domain: int, topic: str, message: str) -> str:
    """Return the key that messages of a topic are published under."""
    return f"{domain}/{topic.strip('/')}/{dds_name(message)}/{TYPE_HASHES[message]}"


def dds_name(message: str) -> str:
    """Return ``tf2_msgs::msg::dds_::TFMessage_`` of ``tf2_msgs/msg/TFMessage``."""
    package, kind, name = message.split("/")
    return f"{package}::{kind}::dds_::{name}_"


def node_token(domain: int, session: str) -> str:
    """Return the liveliness token of the node."""
    return f"@ros2_lv/{domain}/{session}/0/0/NN/%/%/{NODE}"


def publisher_token(domain: int, session: str, number: int, topic: str, message: str) -> str:
    """Return the liveliness token of a publisher. number: of the entity, from 1."""
    mangled = topic.replace("/", "%")
    return (
        f"@ros2_lv/{domain}/{session}/0/{number}/MP/%/%/{NODE}/{mangled}/{dds_name(message)}/"
        f"{TYPE_HASHES[message]}/{_QOS}"
    )


def publisher_id(session: str, number: int) -> bytes:
    """Return 16 bytes that no other publisher has. session: hexadecimal, of up to 32 digits."""
    return number.to_bytes(8, "big") + bytes.fromhex(session.zfill(32))[-8:]


class RosTopic:
    """A publisher and what goes with each of its messages."""

    def __init__(self, session: Any, domain: int, number: int, topic: str, message: str) -> None:
        name = str(session.zid())
        self._publisher = session.declare_publisher(topic_key(domain, topic, message))
        token = publisher_token(domain, name, number, topic, message)
        self._token = session.liveliness().declare_token(token)
        self._id = publisher_id(name, number)
        self._count = 0

    def put(self, time_ns: int, data: bytes) -> None:
        """Publish. Zenoh drops what its line does not take."""
        self._count += 1
        self._publisher.put(data, attachment=_ATTACHMENT.pack(self._count, time_ns, 16, self._id))


class RosNode:
    """A session of Zenoh as a node of ROS 2, which finds its router again by itself."""

    def __init__(self, output: str, router: str, domain: int) -> None:
        """output: whose node it is, for errors."""
        self._output, self._router, self._domain = output, router, domain
        self._session: Any = None
        self._n_topics = 0

    async def open(self) -> None:
        """Open the session, router or not. Raises ``OutputError`` without the extra."""
        try:
            zenoh = importlib.import_module("zenoh")
        except ImportError as error:
            raise OutputError(
                f"outputs.{self._output}: Zenoh is not there ({error}): {how_to_add('ros2')}"
            ) from error
        plain = {
            "mode": "peer",
            "connect": {
                "endpoints": [self._router],
                "timeout_ms": -1,  # for ever
                "exit_on_failure": False,
                "retry": {"period_init_ms": 500, "period_max_ms": 4000, "period_increase_factor": 2},
            },
            "listen": {"endpoints": []},
            "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        }
        try:
            config = zenoh.Config.from_json5(json.dumps(plain))
            self._session = await asyncio.to_thread(zenoh.open, config)
        except zenoh.ZError as error:
            raise OutputError(
                f"outputs.{self._output}: no session with {self._router} ({error}): correct router"
            ) from error
        node = node_token(self._domain, str(self._session.zid()))
        self._node = self._session.liveliness().declare_token(node)

    def topic(self, topic: str, message: str) -> RosTopic:
        """Return a publisher; the node is open."""
        self._n_topics += 1
        return RosTopic(self._session, self._domain, self._n_topics, topic, message)

    def close(self) -> None:
        """End the session."""
        if self._session is not None:
            self._session.close()
            self._session = None
            self._n_topics = 0


class Ros2Sink:
    """Poses of the body."""

    def __init__(self, settings: Ros2Settings, skeleton: Skeleton) -> None:
        self._node = RosNode("ros2", settings.router, settings.domain)
        self._transforms = BodyTransforms(skeleton)
        self._states = BodyJointStates(skeleton, settings.body)

    async def open(self) -> None:
        """Open the session, router or not. Raises ``OutputError`` without the extra."""
        await self._node.open()
        self._tf = self._node.topic(TF, TF_MESSAGE)
        self._joint_states = self._node.topic(self._states.topic, JOINT_STATE)

    def send(self, frame: SkeletonFrame) -> bool:
        """Publish a pose; Zenoh drops what its line does not take."""
        time_ns = frame.time_ns
        self._tf.put(time_ns, self._transforms.encode(time_ns, frame.q_wb, frame.p_w))
        if self._states.names:
            self._joint_states.put(time_ns, self._states.encode(time_ns, frame.q_wb))
        return True

    def close(self) -> None:
        """End the session."""
        self._node.close()
