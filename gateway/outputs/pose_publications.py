"""The messages that one skeleton frame becomes: the pose in one encoding or two, and single segments."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from paho.mqtt.properties import Properties

from gateway.body.joint_angles import JointAngles
from gateway.body.skeleton import Skeleton
from gateway.contract.properties import JSON, MSGPACK, properties_of
from gateway.contract.topics import Topics
from gateway.frames import SkeletonFrame
from gateway.outputs.marker_encoding import markers_message
from gateway.outputs.pose_encoding import PoseEncoder, as_json, as_msgpack, segment_messages
from gateway.outputs.settings import MqttSettings, PoseFormat, PoseMap
from gateway.outputs.thinning import Thinning


class Outgoing(NamedTuple):
    """One message as it is published, with QoS 0."""

    topic: str
    payload: bytes
    properties: Properties | None


class PosePublications:
    """Frames of one skeleton to messages."""

    def __init__(
        self, settings: MqttSettings, skeleton: Skeleton, topics: Topics, markers: tuple[str, ...] = ()
    ) -> None:
        """markers: names of those that the body has, for poses made from them."""
        angles = JointAngles(skeleton) if PoseMap.JOINT_ANGLES in settings.include else None
        self._encoder = PoseEncoder(skeleton.segment_names, settings.decimals, settings.include, angles)
        self._formats = settings.pose_formats
        self._topics = topics
        self._segment_topics = {name: topics.segment(name) for name in skeleton.segment_names}
        self._segments_due = None if settings.segment_rate is None else Thinning(settings.segment_rate)
        self._markers = markers
        self._markers_due = None if settings.marker_rate is None else Thinning(settings.marker_rate)
        self.has_segments = True
        """Whether messages of single segments and of markers are made, where they are configured."""
        protocol, expiry_s = settings.spoken_protocol, settings.pose_expiry_s
        self._json = properties_of(protocol, JSON, expiry_s)
        self._msgpack = properties_of(protocol, MSGPACK, expiry_s)

    def of(self, frame: SkeletonFrame) -> Iterator[Outgoing]:
        """The messages of a frame. Raises ``ValueError`` for one of another skeleton."""
        message = self._encoder.message(frame)
        if PoseFormat.JSON in self._formats:
            yield Outgoing(self._topics.pose, as_json(message), self._json)
        if PoseFormat.MSGPACK in self._formats:
            yield Outgoing(self._topics.pose_msgpack, as_msgpack(message), self._msgpack)
        due = self._segments_due if self.has_segments else None
        if due is not None and due.admits(frame.time_ns):
            for name, segment in segment_messages(message):
                yield Outgoing(self._segment_topics[name], as_json(segment), self._json)
        if self.has_segments:
            yield from self._of_markers(frame)

    def _of_markers(self, frame: SkeletonFrame) -> Iterator[Outgoing]:
        due = self._markers_due
        if due is None or frame.markers is None or not due.admits(frame.time_ns):
            return
        message = markers_message(self._markers, frame)
        if message is not None:
            yield Outgoing(self._topics.markers, as_json(message), self._json)
