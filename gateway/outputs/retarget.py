"""A robot that follows the person: joint states over MQTT, as datagrams and to nodes of ROS 2."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

import numpy as np
import orjson

from gateway.body.retargeting import Retargeter, RobotPose
from gateway.body.robot import load_robot
from gateway.body.skeleton import Skeleton
from gateway.contract.ros_messages import (
    JOINT_STATE,
    TF,
    TF_MESSAGE,
    WORLD_FRAME,
    JointStateEncoder,
    TransformsEncoder,
)
from gateway.contract.topics import ROBOT
from gateway.errors import GatewayError, OutputError
from gateway.frames import FloatArray, SkeletonFrame
from gateway.outputs.datagrams import DatagramSender
from gateway.outputs.ros2 import RosNode, RosTopic
from gateway.outputs.settings import RetargetSettings, RobotRos2Settings

Beside = Callable[[str, bytes], bool]
"""Publishes a payload below the gateway's topics; whether the broker takes it now."""
_DECIMALS = 6


class RetargetSink:
    """Solves each pose offered, and sends it wherever the settings say."""

    def __init__(self, settings: RetargetSettings, skeleton: Skeleton, publish: Beside) -> None:
        self._settings = settings
        self._skeleton = skeleton
        self._publish = publish
        self._datagrams: DatagramSender | None = None
        self._node: _RobotNode | None = None

    async def open(self) -> None:
        """Read the robot, and open what is sent by. Raises ``OutputError``."""
        settings = self._settings
        try:
            robot = load_robot(settings.robot, self._skeleton, settings.urdf)
            self._solver = await asyncio.to_thread(Retargeter, robot, self._skeleton)
        except GatewayError as error:
            raise OutputError(f"outputs.retarget: {error}") from error
        if (udp := settings.udp) is not None:
            self._datagrams = DatagramSender("retarget.udp", udp.host, udp.port)
            await self._datagrams.open()
        if settings.ros2 is not None:
            self._node = _RobotNode(settings.ros2, robot.joint_names, robot.tree.links[0])
            await self._node.open()

    def send(self, frame: SkeletonFrame) -> bool:
        """Send a frame; return whether the robot has a pose, and all took it.

        Raises ``GatewayError``, ``OSError``.
        """
        pose = self._solver.solve(frame)
        if pose is None:
            return False
        is_sent = True
        if self._settings.mqtt or self._datagrams is not None:
            robot = self._solver.robot
            payload = orjson.dumps(robot_message(robot.tree.name, robot.joint_names, pose))
            if self._settings.mqtt:
                is_sent = self._publish(ROBOT, payload)
            if self._datagrams is not None:
                is_sent = self._datagrams.send([payload]) and is_sent
        if self._node is not None:
            self._node.publish(pose)
        return is_sent

    def close(self) -> None:
        """Give sockets and session back."""
        if self._datagrams is not None:
            self._datagrams.close()
        if self._node is not None:
            self._node.close()


def robot_message(robot: str, joint_names: tuple[str, ...], pose: RobotPose) -> dict[str, object]:
    """Return the content of a ``RobotMessage``."""
    known = pose.errors[np.isfinite(pose.errors)]
    message: dict[str, object] = {
        "t_ns": pose.time_ns,
        "seq": pose.sequence,
        "robot": robot,
        # Not rounded: an angle at its limit is not to come out beyond it.
        "joints": dict(zip(joint_names, pose.angles.tolist(), strict=True)),
        "rates": dict(zip(joint_names, _plain(pose.rates), strict=True)),
        "error_deg": round(float(np.degrees(np.mean(known))), 3) if len(known) else None,
    }
    if pose.base_position is not None:
        message["base"] = {
            "orientation": _plain(pose.base_orientation),
            "position": _plain(pose.base_position),
        }
    return message


def _plain(numbers: FloatArray) -> list[float]:
    plain: list[float] = np.round(numbers, _DECIMALS).tolist()
    return plain


class _RobotNode:
    """The robot's joint states, and its base link in the world."""

    def __init__(self, settings: RobotRos2Settings, joint_names: tuple[str, ...], base: str) -> None:
        self._node = RosNode("retarget.ros2", settings.router, settings.domain)
        self._topic = settings.topic
        self._states = JointStateEncoder(joint_names, has_rates=True)
        self._transform = TransformsEncoder([(WORLD_FRAME, base)])
        self._tf: RosTopic | None = None

    async def open(self) -> None:
        """Join ROS 2 and announce the topics. Raises as ``RosNode.open``."""
        await self._node.open()
        self._joint_states = self._node.topic(self._topic, JOINT_STATE)
        self._tf = self._node.topic(TF, TF_MESSAGE)

    def publish(self, pose: RobotPose) -> None:
        """Publish the joints' angles and rates, and the base where it is known."""
        numbers = np.stack([pose.angles, pose.rates])
        self._joint_states.put(pose.time_ns, self._states.encode(pose.time_ns, numbers))
        if pose.base_position is not None and self._tf is not None:
            data = self._transform.encode(pose.time_ns, pose.base_position[None], pose.base_orientation[None])
            self._tf.put(pose.time_ns, data)

    def close(self) -> None:
        """Leave ROS 2."""
        self._node.close()
