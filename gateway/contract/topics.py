"""Where everything is published: ``<base_topic>/<gateway>/…``."""

from __future__ import annotations

from dataclasses import dataclass

from gateway.errors import GatewayError

BRIDGE_STATE = "bridge/state"
BRIDGE_INFO = "bridge/info"
BRIDGE_HEALTH = "bridge/health"
BRIDGE_ECHO = "bridge/echo/{id}"
BRIDGE_REQUEST = "bridge/request"
BRIDGE_RESPONSE = "bridge/response"
BODY = "body"
POSE = "pose"
POSE_MSGPACK = "pose/msgpack"
PREDICTED_POSE = "pose/predicted"
PREDICTED_POSE_MSGPACK = "pose/predicted/msgpack"
LATE_POSE = "pose/late"
ROBOT = "robot/joint_states"
SEGMENT = "segment/{name}"
MARKERS = "markers"
MODULE_STATE = "module/{id}/state"
MODULE_AVAILABILITY = "module/{id}/availability"

COMPARISON = "comparison"
CAMERA = "mocap_cameras/{camera}"
"""Heat maps of a camera, unless told otherwise; outside of the gateways' own topics."""

ANY_GATEWAY = "+"


class TopicError(GatewayError, ValueError):
    """A name that cannot stand in a topic."""


@dataclass(frozen=True)
class Topics:
    """Topics of one gateway; with ``ANY_GATEWAY`` as its name, filters for all of them.

    Raises ``TopicError`` for a gateway name that is not one level of a topic.
    """

    base_topic: str
    gateway: str

    def __post_init__(self) -> None:
        if self.gateway != ANY_GATEWAY and (not self.gateway or set(self.gateway) & set("+#/\0")):
            raise TopicError(f"gateway name '{self.gateway}' must not be empty, nor hold any of + # /")

    @property
    def root(self) -> str:
        """What all topics of the gateway begin with."""
        return f"{self.base_topic}/{self.gateway}"

    @property
    def bridge_state(self) -> str:
        """``online`` or ``offline``: birth, will and clean stop; retained."""
        return f"{self.root}/{BRIDGE_STATE}"

    @property
    def bridge_info(self) -> str:
        """What the gateway is and runs; retained."""
        return f"{self.root}/{BRIDGE_INFO}"

    @property
    def bridge_health(self) -> str:
        """Counters, from time to time."""
        return f"{self.root}/{BRIDGE_HEALTH}"

    @property
    def bridge_echo(self) -> str:
        """Below it, what goes from one broker of a cluster to another, and back to its sender."""
        return f"{self.root}/{BRIDGE_ECHO.removesuffix('/{id}')}"

    @property
    def body(self) -> str:
        """The skeleton; retained."""
        return f"{self.root}/{BODY}"

    @property
    def pose(self) -> str:
        """One message a skeleton frame."""
        return f"{self.root}/{POSE}"

    @property
    def pose_msgpack(self) -> str:
        """The same in MessagePack, where configured."""
        return f"{self.root}/{POSE_MSGPACK}"

    @property
    def predicted_pose(self) -> str:
        """The pose of an instant to come, where configured."""
        return f"{self.root}/{PREDICTED_POSE}"

    @property
    def predicted_pose_msgpack(self) -> str:
        """The same in MessagePack."""
        return f"{self.root}/{PREDICTED_POSE_MSGPACK}"

    @property
    def late_pose(self) -> str:
        """Poses from while the broker was away, where configured."""
        return f"{self.root}/{LATE_POSE}"

    @property
    def robot(self) -> str:
        """Joints of the robot that follows the person, where configured."""
        return f"{self.root}/{ROBOT}"

    def segment(self, name: str) -> str:
        """Return one segment of the poses, where configured."""
        return f"{self.root}/{SEGMENT.format(name=name)}"

    @property
    def markers(self) -> str:
        """What became of the markers, from an optical source."""
        return f"{self.root}/{MARKERS}"

    @property
    def comparison(self) -> str:
        """How far this gateway and another agree, from ``compare --live``."""
        return f"{self.root}/{COMPARISON}"

    def module_state(self, module: int) -> str:
        """Return figures of one module; retained."""
        return f"{self.root}/{MODULE_STATE.format(id=module)}"

    def module_availability(self, module: int) -> str:
        """Return the topic that says whether a module is ``online`` or ``offline``; retained."""
        return f"{self.root}/{MODULE_AVAILABILITY.format(id=module)}"

    def request(self, verb: str) -> str:
        """Return where a request is published."""
        return f"{self.root}/{BRIDGE_REQUEST}/{verb}"

    def response(self, verb: str) -> str:
        """Return where its answer comes, unless the request says otherwise (MQTT 5)."""
        return f"{self.root}/{BRIDGE_RESPONSE}/{verb}"

    def split(self, topic: str) -> tuple[str, str] | None:
        """Return (gateway, rest) of a topic of this gateway, or None for one that is not."""
        prefix = f"{self.base_topic}/"
        if not topic.startswith(prefix):
            return None
        gateway, _, below = topic.removeprefix(prefix).partition("/")
        if not below or self.gateway not in (ANY_GATEWAY, gateway):
            return None
        return gateway, below
