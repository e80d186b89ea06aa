"""How the gateway reaches its MQTT broker and what it publishes there; where poses go beside it."""

from __future__ import annotations

import ipaddress
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from gateway.support.credentials import AccessToken, read_secret
from gateway.support.settings_files import Strict

PASSWORD_VARIABLE = "MOCAP_MQTT_PASSWORD"
"""Environment variable that may hold the broker password."""

WEBSOCKET_TOKEN_VARIABLE = "MOCAP_WEBSOCKET_TOKEN"
"""Environment variable that may hold the token with which WebSocket clients publish."""

LONGEST_HORIZON_MS = 100.0
"""Of a prediction: further ahead guesses are worth little, see the table in docs/guide/outputs.md."""

LOOPBACK_HOSTS = ("127.0.0.1", "localhost")


ResponsePrefix = Annotated[str, Field(pattern=r"^[^+#$/\s]([^+#\s]*[^+#\s/])?$")]


Horizon = Annotated[float, Field(gt=0, le=LONGEST_HORIZON_MS, allow_inf_nan=False)]


class PoseMap(StrEnum):
    """What a pose message may carry beside the orientations: maps by segment name, angles by joint name."""

    POSITION = "position"
    ACCELERATION = "acceleration"
    ANGULAR_RATE = "angular_rate"
    SIGMA = "sigma"
    JOINT_ANGLES = "joint_angles"


class PoseFormat(StrEnum):
    """How poses are encoded: the same fields, each on a topic of its own."""

    JSON = "json"
    MSGPACK = "msgpack"


class TlsSettings(Strict):
    """Files of a TLS connection."""

    ca_file: Path | None = Field(
        default=None,
        description="Certificates (PEM) to check the broker against; none: those of the system.",
    )
    certificate: Path | None = Field(
        default=None, description="Certificate (PEM) to show to the broker, where it asks for one."
    )
    key: Path | None = Field(default=None, description="Private key (PEM) of that certificate.")

    @model_validator(mode="after")
    def _certificate_comes_with_its_key(self) -> Self:
        if (self.certificate is None) != (self.key is None):
            raise ValueError("certificate and key belong together: give both, or neither")
        return self


class LateSettings(Strict):
    """Poses that no broker took, published later on topic ``pose/late``."""

    folder: Path = Field(description="Where they are kept meanwhile, in a file of the gateway's name.")
    most_mb: float = Field(
        default=500, gt=0, le=1e6, allow_inf_nan=False, description="Largest size of that file, MB."
    )
    rate: float = Field(
        default=200,
        ge=1,
        le=5000,
        allow_inf_nan=False,
        description="Most late poses a second, Hz, beside the live ones.",
    )


def _checked_address(address: str) -> str:
    host, _, port = address.rpartition(":")
    is_port = port.isascii() and port.isdigit() and 0 < int(port) < 1 << 16
    if not is_port or not host or set(host) & set("/: \t\n"):
        raise ValueError("HOST:PORT is wanted, such as broker2:1883")
    return address


BrokerAddress = Annotated[str, AfterValidator(_checked_address)]


def _checked_host(host: str) -> str:
    if "@" in host:
        raise ValueError("a host takes no user name or password: leave out what stands before the @")
    is_address = not set(host) & set("/:") or _is_address(host)
    if not (is_address and host.isprintable()) or " " in host:
        raise ValueError("the name or the address of a host alone is wanted, such as 127.0.0.1, without port")
    return host


def _is_address(host: str) -> bool:
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return False
    return True


HostName = Annotated[str, Field(min_length=1), AfterValidator(_checked_host)]


class MqttSettings(Strict):
    """Connection to the broker, topics and payload. The password is never part of it."""

    broker: Literal["embedded", "external"] = Field(
        default="external",
        description="'external': a broker that runs already, such as mosquitto. 'embedded': the gateway "
        "starts its own on this machine, for a first run: MQTT 3.1.1, loopback only, no passwords.",
    )
    host: HostName = Field(default="127.0.0.1", description="Host name or address of the broker.")
    port: int = Field(
        default=1883,
        ge=0,
        le=65535,
        description="TCP port of the broker. 0 with the embedded broker: any free port.",
    )
    failover: tuple[BrokerAddress, ...] = Field(
        default=(),
        description="Further addresses of the same cluster of brokers, HOST:PORT: tried in turn when the one "
        "in use is away or silent, with the same user and TLS files.",
    )
    answer_within: float = Field(
        default=1.0,
        ge=0.2,
        le=60,
        allow_inf_nan=False,
        description="With failover or late: a broker that leaves a question unanswered for so long is given "
        "up, s.",
    )
    late: LateSettings | None = Field(
        default=None,
        description="Keeps poses while no broker takes them, and publishes them later on topic pose/late. "
        "None: they are dropped and counted.",
    )
    websocket_port: int | None = Field(
        default=None,
        ge=1,
        le=65535,
        description="Port on which the embedded broker takes WebSocket clients (browsers) too; none: closed.",
    )
    websocket_origins: tuple[str, ...] = Field(
        default=(),
        description="Origins of web pages that may connect there beside those served by this machine, such "
        "as https://lab.example; null: pages opened as files.",
    )
    websocket_token_file: Path | None = Field(
        default=None,
        description="File whose first line is the token that a WebSocket client gives as its password to "
        f"publish, requests among others. Without it the environment variable {WEBSOCKET_TOKEN_VARIABLE} is "
        "taken; with neither they can only listen.",
    )
    username: str | None = Field(default=None, min_length=1, description="User name at the broker.")
    password_file: Path | None = Field(
        default=None,
        description="File whose first line is the password. Without it the environment variable "
        f"{PASSWORD_VARIABLE} is taken.",
    )
    tls: TlsSettings | None = Field(default=None, description="TLS files; none: an unencrypted connection.")
    protocol: Literal["3.1.1", "5"] = Field(
        default="3.1.1",
        description="MQTT version. The embedded broker speaks 3.1.1 only, whatever stands here.",
    )
    client_id: str | None = Field(
        default=None,
        min_length=1,
        description="MQTT client identifier, unique at the broker; none: made from the gateway's name and "
        "a random part, so that two gateways never push each other out.",
    )
    keepalive: int = Field(
        default=5,
        ge=1,
        le=65535,
        description="Keep-alive interval, s. A broker silent for twice as long counts as lost; "
        "the broker announces the gateway's death after one and a half of it.",
    )
    same_name: Literal["warn", "refuse", "ignore"] = Field(
        default="warn",
        description="Where another gateway of the same name publishes. warn: both say so; refuse: the one "
        "that comes later ends with an error; ignore: own topics are not read, which some brokers forbid.",
    )
    base_topic: str = Field(
        default="mocap", min_length=1, description="First part of every topic: <base_topic>/<gateway>/…"
    )
    queue_length: int = Field(
        default=8,
        ge=1,
        le=10_000,
        description="Poses kept while the broker is slow or away: then the oldest is dropped and counted. A "
        "burst after the machine paused is published whole.",
    )
    decimals: int | None = Field(
        default=6,
        ge=0,
        le=15,
        description="Decimals of the numbers in a pose (6: 0.0001° of orientation); none: full precision.",
    )
    pose_rate: float | None = Field(
        default=None,
        gt=0,
        allow_inf_nan=False,
        description="Most poses published a second, Hz; none: every one.",
    )
    pose_formats: frozenset[PoseFormat] = Field(
        default=frozenset({PoseFormat.JSON}),
        min_length=1,
        description="json: on topic pose; msgpack: the same fields as MessagePack on topic pose/msgpack.",
    )
    predict_ms: Horizon | Literal["publishing"] | None = Field(
        default=None,
        description="Publishes each pose on topic pose/predicted too, extrapolated so far ahead, ms: by how "
        "much later a consumer shows it. publishing: to the instant at which it is published. None: no such "
        "topic.",
    )
    segment_rate: float | None = Field(
        default=None,
        gt=0,
        le=1000,
        allow_inf_nan=False,
        description="Most messages a second on each segment/<name>, Hz; none: no such topics. A message of "
        "its own for every segment costs far more than one for all.",
    )
    marker_rate: float | None = Field(
        default=30,
        gt=0,
        le=1000,
        allow_inf_nan=False,
        description="Most messages a second on topic markers, Hz, where poses are made from markers; "
        "none: no such topic.",
    )
    response_topics: tuple[ResponsePrefix, ...] = Field(
        default=(),
        description="With MQTT 5: below which topics a request may have its answer published, beside "
        "<base_topic>/<gateway>/bridge/response; the gateway may publish more than those who ask.",
    )
    pose_expiry_s: int = Field(
        default=2,
        ge=1,
        le=3600,
        description="With MQTT 5: how long a broker may keep a pose that it cannot deliver, s.",
    )
    home_assistant: str | None = Field(
        default=None,
        min_length=1,
        pattern=r"^[^+#\s/][^+#\s]*[^+#\s/]$",
        description="Discovery prefix of Home Assistant, usually homeassistant: modules appear there with "
        "battery, loss and clock rate; never poses. None: off.",
    )
    include: frozenset[PoseMap] = Field(
        default=frozenset(), description="What a pose carries beside orientations and status."
    )
    health_interval: float = Field(
        default=5.0, gt=0, allow_inf_nan=False, description="Time between two bridge/health messages, s."
    )

    @model_validator(mode="before")
    @classmethod
    def _password_stays_outside(cls, given: Any) -> Any:
        if isinstance(given, dict) and "password" in given:
            # Raised without the value: pydantic would quote it in the message otherwise.
            del given["password"]
            raise ValueError(
                f"a password does not belong in the settings: set {PASSWORD_VARIABLE} or password_file"
            )
        return given

    @model_validator(mode="after")
    def _combination_makes_sense(self) -> Self:
        if self.late is not None and PoseFormat.JSON not in self.pose_formats:
            raise ValueError("late poses are JSON: pose_formats must hold json (found: msgpack alone)")
        if self.broker == "embedded":
            if self.failover:
                raise ValueError("failover is for a cluster of brokers: it needs broker: external")
            if self.host not in LOOPBACK_HOSTS:
                raise ValueError(
                    f"the embedded broker serves this machine only: host '{self.host}' needs "
                    "broker: external (found: embedded)"
                )
            if self.tls is not None:
                raise ValueError("the embedded broker has no TLS: remove tls, or use broker: external")
        elif self.port == 0:
            raise ValueError("port 0 (any free port) works with broker: embedded only; mosquitto's is 1883")
        if set(self.base_topic) & set("+#\0") or self.base_topic.strip("/") != self.base_topic:
            raise ValueError(
                f"base_topic '{self.base_topic}' must not hold + or #, nor begin or end with a slash"
            )
        return self

    def read_password(self) -> str | None:
        """Return the password: first line of ``password_file``, else the environment.

        Raises ``CredentialError``.
        """
        return read_secret(self.password_file, PASSWORD_VARIABLE, "password_file")

    def read_websocket_token(self) -> AccessToken | None:
        """Return what a WebSocket client of the embedded broker must show to publish; None: none can. Raises
        ``CredentialError``."""
        text = read_secret(self.websocket_token_file, WEBSOCKET_TOKEN_VARIABLE, "websocket_token_file")
        return None if text is None else AccessToken(text)

    def at(self, address: str) -> MqttSettings:
        """Return the same at another address, HOST:PORT."""
        host, _, port = address.rpartition(":")
        return self.model_copy(update={"host": host, "port": int(port)})

    @property
    def is_watched(self) -> bool:
        """Whether the broker is asked for answers, so that a silent one is noticed soon."""
        return bool(self.failover) or self.late is not None

    @property
    def door(self) -> dict[str, object]:
        """Those that decide which broker it is, and whether it lets us in."""
        names = {"broker", "host", "port", "failover", "username", "password_file", "tls", "protocol"}
        return self.model_dump(include=names)

    @property
    def protocol_in_use(self) -> Literal["3.1.1", "5"]:
        """The MQTT version that the chosen broker understands."""
        return "3.1.1" if self.broker == "embedded" else self.protocol


class _Output(Strict):
    rate: float = Field(default=60, gt=0, le=1000, allow_inf_nan=False, description="most poses a second, Hz")


class _Datagrams(_Output):
    host: HostName = Field(
        default="127.0.0.1",
        description="where they are sent: loopback, unless another machine listens",
    )


class VmcSettings(_Datagrams):
    """VMC protocol (OSC over UDP), for Unity, Blender and VR apps: bodies of people only."""

    port: int = Field(default=39539, ge=1, le=65535, description="UDP port of the app")


class UdpJsonSettings(_Datagrams):
    """The messages of topic ``pose``, each a datagram."""

    port: int = Field(default=39600, ge=1, le=65535, description="UDP port of the app")
    include: frozenset[PoseMap] = Field(
        default=frozenset(), description="what a pose carries beside orientations and status, as in mqtt"
    )
    body: bool = Field(
        default=False, description="once a second the message of topic body too, for who builds the body"
    )


class SlimevrSettings(_Datagrams):
    """Segments as trackers of a SlimeVR server, for SteamVR and VR apps."""

    port: int = Field(default=6969, ge=1, le=65535, description="UDP port of the server")
    segments: tuple[str, ...] | None = Field(
        default=None,
        description="segments that are sent; none: all of the body that a server has a place for",
    )


class MvnSettings(_Datagrams):
    """Datagrams of the MVN network streamer, for game engines and robots: bodies of people only."""

    transport: Literal["udp", "tcp"] = Field(
        default="udp", description="tcp: the gateway connects to the app, which listens, as MVN does"
    )
    port: int = Field(default=9763, ge=1, le=65535, description="port of the app")


class LslSettings(_Output):
    """A stream of the Lab Streaming Layer (extra ``lsl``). LSL itself announces it in the whole network."""

    name: str = Field(default="mocap", min_length=1, max_length=64, description="name of the stream")


class FoxgloveSettings(_Output):
    """A server that Foxglove connects to (extra ``foxglove``), without a password."""

    host: HostName = Field(default="127.0.0.1", description="where it listens: loopback alone")
    port: int = Field(default=8765, ge=0, le=65535, description="TCP port; 0: any free one")


RouterAddress = Annotated[str, Field(pattern=r"^(tcp|udp|tls|quic)/\S+:\d+$")]
_ROUTER = "the Zenoh router that ROS 2 uses (ros2 run rmw_zenoh_cpp rmw_zenohd)"
_DOMAIN = "ROS_DOMAIN_ID of the nodes that listen"


class Ros2Settings(_Output):
    """Topics of ROS 2, by the router of rmw_zenoh (extra ``ros2``)."""

    router: RouterAddress = Field(default="tcp/127.0.0.1:7447", description=_ROUTER)
    domain: int = Field(default=0, ge=0, le=232, description=_DOMAIN)
    body: str = Field(
        default="mocap", pattern=r"^[A-Za-z][A-Za-z0-9]*$", description="id of the person, by REP 155"
    )


class RobotUdpSettings(Strict):
    """The messages of topic ``robot/joint_states``, each a datagram."""

    host: HostName = Field(default="127.0.0.1", description="where they are sent")
    port: int = Field(default=39700, ge=1, le=65535, description="UDP port of the robot's program")


class RobotRos2Settings(Strict):
    """Joint states of the robot by the router of rmw_zenoh (extra ``ros2``)."""

    router: RouterAddress = Field(default="tcp/127.0.0.1:7447", description=_ROUTER)
    domain: int = Field(default=0, ge=0, le=232, description=_DOMAIN)
    topic: str = Field(
        default="/robot/joint_states",
        pattern=r"^(/[A-Za-z][A-Za-z0-9_]*)+$",
        description="of sensor_msgs/JointState; the base link's place is on /tf",
    )


class RetargetSettings(_Output):
    """A robot that follows the person within its joints' limits and rates (extra ``robot``)."""

    rate: float = Field(default=100, gt=0, le=1000, allow_inf_nan=False, description="most poses a second")
    robot: str = Field(
        min_length=1, description="which link follows which segment: a shipped file, such as icub, or a path"
    )
    urdf: Path | None = Field(default=None, description="the robot's URDF; none: the robot file names it")
    mqtt: bool = Field(default=True, description="on topic robot/joint_states")
    udp: RobotUdpSettings | None = Field(default=None, description="the same as datagrams; {}: defaults")
    ros2: RobotRos2Settings | None = Field(default=None, description="sensor_msgs/JointState; {}: defaults")


class OpenSimSettings(_Datagrams):
    """Coordinates of an OpenSim model as JSON, each pose a datagram."""

    port: int = Field(default=39800, ge=1, le=65535, description="UDP port of the program with the model")
    model: Path | None = Field(
        default=None,
        description="the .osim: coordinates that it does not have are left out; none: all, under the names "
        "of the full-body model of Rajagopal et al. (2016)",
    )


class OutputsSettings(Strict):
    """Outputs beside MQTT; none: off."""

    vmc: VmcSettings | None = Field(default=None, description="avatars, by the VMC protocol; {}: defaults")
    udp_json: UdpJsonSettings | None = Field(default=None, description="poses as JSON over UDP")
    slimevr: SlimevrSettings | None = Field(
        default=None, description="trackers of a SlimeVR server; {}: defaults"
    )
    mvn: MvnSettings | None = Field(
        default=None, description="what Xsens MVN streams (MXTP02, 12, 13, 20, 25); {}: defaults"
    )
    lsl: LslSettings | None = Field(default=None, description="orientations as an LSL stream")
    foxglove: FoxgloveSettings | None = Field(
        default=None, description="the body and its joint angles, live in Foxglove; {}: defaults"
    )
    ros2: Ros2Settings | None = Field(
        default=None, description="/tf and joint states for nodes of ROS 2; {}: defaults"
    )
    retarget: RetargetSettings | None = Field(default=None, description="a robot that follows the person")
    opensim: OpenSimSettings | None = Field(
        default=None, description="coordinates of an OpenSim model; {}: defaults"
    )
