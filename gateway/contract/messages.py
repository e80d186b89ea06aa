"""Every payload that is published, as a model.

World axes are ENU (east, north, up), SI units, quaternions Hamilton ``[w, x, y, z]`` segment to
world with ``w >= 0``, instants integer nanoseconds since the Unix epoch.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal, Self

import numpy as np
import orjson
from pydantic import BaseModel, ConfigDict, Field, JsonValue, field_validator, model_validator

from gateway.body.joints import WORLD, Joint
from gateway.body.skeleton import Skeleton
from gateway.contract import topics
from gateway.contract.properties import JSON, MSGPACK
from gateway.frames import Status

_LONGEST_SEGMENT = 1e4
"""Metres, of a robot or a crane; beyond, coordinates of a picture overflow."""

Number = Annotated[float, Field(allow_inf_nan=False)]
Vector = tuple[Number, Number, Number]
Quaternion = tuple[Number, Number, Number, Number]
StatusName = Literal[
    "measured", "interpolated", "held", "predicted", "warming_up", "missing", "unaided", "doubtful"
]

STATUS_NAMES: tuple[str, ...] = tuple(status.name.lower() for status in Status)
"""Name of a status in messages, by its number."""


class Message(BaseModel):
    """Anything published as JSON: unknown keys, NaN and infinity are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    def payload(self) -> bytes:
        """Return the message as JSON bytes."""
        return orjson.dumps(self.model_dump(mode="json"))


class BridgeState(Message):
    """Whether the gateway runs."""

    state: Literal["online", "offline"] = Field(
        description="'offline' comes from the gateway on a clean stop and from the broker when it dies."
    )


class ModuleInfo(Message):
    """One sensor module of the rig."""

    module: int = Field(ge=0, description="Module number on the wire.")
    segment: str = Field(description="Body segment it is strapped to.")


class UtcAnchor(Message):
    """How gateway time stands to the host's UTC. Gateway time never steps; this does, when UTC is set."""

    t_ns: int = Field(description="Gateway time of the reading, ns.")
    utc_ns: int = Field(description="The host's UTC at the same moment, ns since 1970.")
    offset_ns: int = Field(description="UTC minus gateway time, ns: add it to any t_ns to get UTC.")
    steps: int = Field(ge=0, description="How often the host's UTC was set while the gateway ran.")
    last_step_ns: int | None = Field(
        default=None, description="By how much it was set last, ns (positive: forward); null: never."
    )
    last_step_t_ns: int | None = Field(
        default=None, description="Gateway time at which that was noticed, ns; null: never."
    )


class KernelsInfo(Message):
    """Where the compiled kernels of a running gateway come from."""

    target: str = Field(
        description="Processor that they are compiled for: `x86-64-v3`, `generic` (arm64), or `native`, the "
        "one that runs them."
    )
    ready: int = Field(ge=0, description="Kernels that lay compiled on the disk at the start.")
    compiled: int = Field(ge=0, description="Kernels that had to be compiled at the start.")
    awaited: str | None = Field(
        default=None,
        description="Method that is being compiled while another one makes the poses; null: none is.",
    )


class BridgeInfo(Message):
    """What the gateway is and runs."""

    version: str = Field(description="Version of the gateway software.")
    gateway: str = Field(description="Name of the gateway: second level of its topics.")
    instance: str | None = Field(
        default=None,
        description="Id of the running gateway, another one at every start: two gateways of one name differ.",
    )
    reconstructor: str = Field(description="Name of the method that makes poses from samples.")
    frame_rate: float = Field(gt=0, description="Poses reconstructed a second, Hz.")
    modules: tuple[ModuleInfo, ...] = Field(default=(), description="Modules of the rig.")
    utc: UtcAnchor | None = Field(
        default=None, description="Gateway time against UTC, as of the start or the last step of UTC."
    )
    kernels: KernelsInfo | None = Field(default=None, description="Where compiled kernels come from.")


class OutputCounters(Message):
    """What became of the poses offered to an output: every one is in exactly one of these counts."""

    published: int = Field(ge=0, description="Poses handed to the broker connection, or sent.")
    dropped: int = Field(
        ge=0, description="Poses dropped because the receiver was away, too slow, or refused them."
    )
    thinned: int = Field(ge=0, description="Poses left out on purpose, to keep to the rate asked for.")
    queued: int = Field(ge=0, description="Poses waiting now.")
    late: int = Field(default=0, ge=0, description="Poses kept while the broker was away, to be sent later.")
    connections: int = Field(
        default=0, ge=0, description="Connections made to the broker since the start; 0: has none."
    )


class AccountBalance(Message):
    """A total and what became of it."""

    total: int = Field(description="How many there were.")
    parts: dict[str, int] = Field(description="What became of them, by reason.")
    unaccounted: int = Field(description="Total less all parts: anything but 0 is a defect of the gateway.")


class BridgeHealth(Message):
    """Counters of the running gateway."""

    t_ns: int = Field(description="Gateway time of this message, ns.")
    instance: str | None = Field(default=None, description="Id of the running gateway: see bridge/info.")
    uptime_s: float = Field(ge=0, description="Time since the output was started, s.")
    mqtt: OutputCounters = Field(description="Poses sent to the broker.")
    publishing: Literal["allowed", "refused", "unknown"] = Field(
        default="unknown",
        description="Whether the broker's access list lets messages through. 'unknown' with MQTT 3.1.1, "
        "which has no answer for it.",
    )
    refused_topics: tuple[str, ...] = Field(default=(), description="Topics that the broker refuses.")
    same_name: str | None = Field(
        default=None, description="Instance of another gateway of this name that was heard lately."
    )
    outputs: dict[str, OutputCounters] = Field(
        default_factory=dict, description="Poses sent by other outputs: vmc, udp_json, slimevr, retarget …"
    )
    utc: UtcAnchor | None = Field(default=None, description="Gateway time against UTC, as read last.")
    accounting: dict[str, AccountBalance] = Field(
        default_factory=dict, description="Where every sample, pose and chunk went: balances by name."
    )
    statistics: dict[str, JsonValue] = Field(
        default_factory=dict, description="Counters of links, modules, clock and reconstruction."
    )


class ModuleAvailability(Message):
    """Whether a module is heard. Holds while ``bridge/state`` is online: a gateway that died says nothing."""

    state: Literal["online", "offline"] = Field(
        description="'offline': silent for longer than modules.silent_after, or the gateway has stopped."
    )


class ModuleClockState(Message):
    """What is known of a module's clock."""

    state: Literal["measuring", "settled"] = Field(
        description="'measuring': the rate is not known to 5 ppm yet; ppm is null meanwhile."
    )
    offset_ns: int = Field(description="Gateway time minus module time, ns.")
    ppm: Number | None = Field(description="How much faster than the gateway's the clock runs, ppm.")
    residual_us: Number = Field(description="Mean delay of arrivals above the least one, µs.")
    sigma_us: Number = Field(description="Standard deviation of the offset, as estimated, µs.")
    bound_us: Number | None = Field(
        description="How far the offset can be off at most, µs; null: it answers no time requests."
    )
    steps: int = Field(ge=0, description="Jumps of its instants that were too large to slew.")


class ModuleState(Message):
    """One module: who it is, whether it is heard, what was lost, how its clock stands."""

    t_ns: int = Field(description="Gateway time of this message, ns.")
    module: int = Field(ge=0, le=255, description="Module number on the wire; 254 is the relay.")
    segment: str | None = Field(description="What it is strapped to; null: the rig does not name it.")
    availability: Literal["online", "offline"] = Field(description="As on its availability topic.")
    doubt: str | None = Field(
        default=None,
        description="Why its segment is `doubtful`, or its magnetometer is left out, and what to do; null: "
        "nothing speaks against it.",
    )
    silent_since_ns: int | None = Field(
        description="Gateway time of its last packet while it is offline, ns; null: online, or never heard."
    )
    last_arrival_ns: int | None = Field(description="Gateway time of its last packet, ns; null: never.")
    rate_hz: Number | None = Field(description="Samples a second, measured; null: not measured yet.")
    received: int = Field(ge=0, description="Packets received.")
    lost: int = Field(ge=0, description="Packets lost on the way, found by their numbers.")
    duplicates: int = Field(ge=0, description="Packets received before.")
    late: int = Field(ge=0, description="Samples that came after their frame was made.")
    gaps: dict[str, int] = Field(
        description='How often so many packets were lost in a row, such as {"1": 12, "3-4": 1}.'
    )
    resets: int = Field(ge=0, description="How often it was found to count its time from anew.")
    clock: ModuleClockState | None = Field(description="Its clock; null: never heard.")
    battery_percent: int | None = Field(description="Charge, %; null: not told.")
    temperature_celsius: Number | None = Field(description="Temperature, °C; null: not told.")
    rssi_dbm: int | None = Field(description="Strength of its radio signal, dBm; null: not told.")
    unique_id: str | None = Field(description="Identity burnt in, hexadecimal; null: not told.")
    firmware: str | None = Field(description="Firmware version; null: not told.")


class BodySegment(Message):
    """One rigid segment."""

    name: str = Field(description="Segment name.")
    parent: str | None = Field(description="Segment it hangs from; null for the root.")
    offset: Vector = Field(description="Its proximal joint in the axes of the parent, m.")
    tip: Vector = Field(description="Its distal joint or end in its own axes, m.")


class BodyJoint(Message):
    """What joint angles describe."""

    name: str = Field(description="Joint name.")
    proximal: str | None = Field(description="Segment that counts as standing still; null: the world.")
    distal: str = Field(description="Segment that turns.")
    kind: str = Field(description="hinge, universal or spherical, by its free angles.")
    sequence: str = Field(description="Order of rotations: zxy, yxy, …; swing_twist; hinge.")
    angles: dict[str, tuple[Number | None, Number | None]] = Field(
        description="Angles in the order of the rotations, with their limits, degrees; null: unlimited."
    )


class BodyMessage(Message):
    """The skeleton that the poses belong to."""

    name: str = Field(description="Name of the skeleton.")
    frame: Literal["ENU"] = Field(default="ENU", description="World axes: east, north, up.")
    order: Literal["wxyz"] = Field(default="wxyz", description="Order of quaternion components.")
    length_unit: Literal["m"] = Field(default="m", description="Unit of offsets and tips.")
    segments: tuple[BodySegment, ...] = Field(description="Segments, parents first.")
    joints: tuple[BodyJoint, ...] = Field(default=(), description="Joints, for joint angles.")
    neutral: Quaternion = Field(
        default=(1.0, 0.0, 0.0, 0.0),
        description="Orientation of every segment in the neutral posture, facing east.",
    )

    @model_validator(mode="after")
    def _is_a_tree(self) -> Self:
        """Raise ``ValueError`` unless parents come before children: readers build segment by segment."""
        names: set[str] = set()
        for segment in self.segments:
            if segment.name in names:
                raise ValueError(f"segment '{segment.name}' stands there twice")
            if segment.parent not in names and (segment.parent is not None or names):
                raise ValueError(f"segment '{segment.name}' does not hang from one before it")
            # Anybody may publish a body, and a viewer that believes in kilometres shows nothing.
            if max(map(abs, (*segment.offset, *segment.tip))) > _LONGEST_SEGMENT:
                raise ValueError(f"segment '{segment.name}' is longer than {_LONGEST_SEGMENT:g} m")
            names.add(segment.name)
        if not names:
            raise ValueError("a body has one segment at least")
        return self


class PoseMessage(Message):
    """The whole body at one instant. Maps are keyed by segment name; null is a value not defined."""

    t_ns: int = Field(description="Gateway time of the pose, ns.")
    seq: int = Field(description="Frame number; a gap means that poses were dropped or thinned.")
    frame: Literal["ENU"] = Field(description="World axes: east, north, up.")
    order: Literal["wxyz"] = Field(description="Order of quaternion components.")
    root: str = Field(description="Segment that the reconstruction starts from.")
    segments: dict[str, Quaternion | None] = Field(description="Orientation, segment to world.")
    status: dict[str, StatusName] = Field(description="Where each orientation came from.")
    position: dict[str, Vector | None] | None = Field(
        default=None, description="Proximal joint in the world, m."
    )
    acceleration: dict[str, Vector | None] | None = Field(
        default=None, description="Acceleration of the proximal joint in the world, without gravity, m/s²."
    )
    angular_rate: dict[str, Vector | None] | None = Field(
        default=None, description="Angular rate in segment axes, rad/s."
    )
    sigma: dict[str, Number | None] | None = Field(
        default=None, description="Standard deviation of the orientation, rad."
    )
    joint_angles: dict[str, dict[str, Number] | None] | None = Field(
        default=None, description="By joint: each of its angles, degrees, growing in the movement it names."
    )
    joint_warnings: dict[str, tuple[Literal["near_gimbal_lock", "beyond_limits"], ...]] | None = Field(
        default=None,
        description="With joint_angles: joints whose single angles need care, because their decomposition is "
        "near its singularity or an angle is beyond what the joint can do.",
    )

    @field_validator("t_ns", "seq")
    @classmethod
    def _fits(cls, value: int) -> int:
        """Raise ``ValueError`` beyond 64 bits: JSON has integers of any length, readers of poses have not."""
        if not -(2**63) <= value < 2**63:
            raise ValueError("an integer of 64 bits is wanted")
        return value


class PredictedPoseMessage(PoseMessage):
    """A pose extrapolated from the one of the same ``seq``: nothing was measured at its ``t_ns`` yet.

    Orientations turn on with their angular rates and the recent change of these. ``status`` is ``predicted``
    where a measured orientation was extrapolated; any other says what it says of the pose. ``sigma`` is that
    of the pose and how far such predictions were off lately; ``acceleration`` is that of the pose."""

    t_ns: int = Field(description="Gateway time that the pose is predicted for, ns.")
    predicted_from_ns: int = Field(description="Gateway time of the pose that it was extrapolated from, ns.")


class EchoMessage(Message):
    """A message that its sender listens for at another broker of the cluster: whether the brokers hear each
    other. Of no use to anybody else; those who only listen send it below a name of their own."""

    number: int = Field(ge=0, description="One more each time.")


class LatePoseMessage(PoseMessage):
    """A pose from while no broker took any, published after the fact: never for a live display.

    It has the ``seq`` that the live one had. A few may have arrived live as well: of two with the same
    ``instance`` and ``seq`` one is left out."""

    instance: str = Field(description="Id of the running gateway that made it: see bridge/info.")
    sent_ns: int = Field(description="Gateway time at which it was published, ns.")


class RobotBase(Message):
    """Where the base link of a robot is that is not bolted down."""

    orientation: Quaternion = Field(description="Base link to world.")
    position: Vector = Field(description="In the world, m, in the robot's size.")


class RobotMessage(Message):
    """Joints of a robot that follows the person, within limits and rates of its joints."""

    t_ns: int = Field(description="Gateway time of the pose, ns.")
    seq: int = Field(description="Frame number, that of the pose.")
    robot: str = Field(description="Its name in the URDF.")
    joints: dict[str, Number] = Field(description="Angle by the URDF's joint names, rad.")
    rates: dict[str, Number] = Field(description="How fast each turned since the message before, rad/s.")
    base: RobotBase | None = Field(default=None, description="Not there for one that is bolted down.")
    error_deg: Number | None = Field(
        description="How far its links are turned from how the person's segments are, mean; null: none known."
    )


class SegmentMessage(Message):
    """One segment at one instant: a row of the pose for clients that want no more."""

    t_ns: int = Field(description="Gateway time of the pose, ns.")
    seq: int = Field(description="Frame number, that of the pose.")
    frame: Literal["ENU"] = Field(description="World axes: east, north, up.")
    order: Literal["wxyz"] = Field(description="Order of quaternion components.")
    orientation: Quaternion | None = Field(description="Segment to world; null: not defined.")
    status: StatusName = Field(description="Where the orientation came from.")
    position: Vector | None = Field(default=None, description="Proximal joint in the world, m.")
    acceleration: Vector | None = Field(
        default=None, description="Of the proximal joint in the world, without gravity, m/s²."
    )
    angular_rate: Vector | None = Field(default=None, description="In segment axes, rad/s.")
    sigma: Number | None = Field(default=None, description="Standard deviation of the orientation, rad.")


class PublishedMarker(Message):
    """One marker of an optical source at one instant."""

    position: Vector | None = Field(
        description="Where it was seen, m, after names were put right; null: not seen."
    )
    expected: Vector = Field(description="Where the body of the pose has it, m.")
    residual: Number | None = Field(description="Between the two, m; null: not seen.")
    used: bool = Field(description="Whether it had a say in the pose; false also when it was not seen.")
    taken_from: str | None = Field(
        default=None,
        description="Whose point it was given when names were put right: another marker's, or '' for a "
        "nameless one; null: its own.",
    )


class MarkersMessage(Message):
    """What became of the markers of one pose; from an optical source."""

    t_ns: int = Field(description="Gateway time of the pose, ns.")
    seq: int = Field(description="Frame number, that of the pose.")
    frame: Literal["ENU"] = Field(description="World axes: east, north, up.")
    markers: dict[str, PublishedMarker] = Field(description="By name, all that the body has.")
    unlabelled: tuple[Vector, ...] = Field(description="Points that the optical system could not name, m.")


class ComparedSegment(Message):
    """How far two gateways agree on one segment; null: no instant in common."""

    frames: int = Field(ge=0, description="Instants at which both know it.")
    rms_deg: Number | None = Field(description="Angle between the orientations, RMS, degrees.")
    inclination_rms_deg: Number | None = Field(description="Of it against the vertical, RMS, degrees.")
    heading_rms_deg: Number | None = Field(description="Of it about the vertical, RMS, degrees.")
    axes_apart_deg: Number | None = Field(
        description="Constant difference of the two's segment axes, taken off before, degrees."
    )
    position_rms_m: Number | None = Field(description="Between the proximal joints, RMS, m.")
    own_heading_deg: Number = Field(
        default=0.0,
        description="Heading of the segment beside the common one, taken off too, degrees; 0: it has none.",
    )


class ComparisonMessage(Message):
    """How far this gateway and another agree on one motion; from `mocap-gateway compare --live`."""

    t_ns: int = Field(description="Gateway time of this gateway's newest pose, ns.")
    second: str = Field(description="The other gateway.")
    window_s: Number = Field(description="So many seconds of both are compared.")
    lag_s: Number = Field(description="The other's gateway time minus this one's, s.")
    correlation: Number = Field(description="Of how fast the segments turn in the two, −1 to 1.")
    heading_deg: Number = Field(description="From this world to the other's, about the vertical, degrees.")
    segments: dict[str, ComparedSegment] = Field(description="By this gateway's segment names.")


@dataclass(frozen=True)
class Publication:
    """How a message is published."""

    topic: str
    """Below ``<base_topic>/<gateway>/``."""
    model: type[Message]
    qos: Literal[0, 1]
    retain: bool
    content_type: str = JSON


PUBLICATIONS: tuple[Publication, ...] = (
    Publication(topics.BRIDGE_STATE, BridgeState, qos=1, retain=True),
    Publication(topics.BRIDGE_INFO, BridgeInfo, qos=1, retain=True),
    Publication(topics.BRIDGE_HEALTH, BridgeHealth, qos=0, retain=False),
    Publication(topics.BRIDGE_ECHO, EchoMessage, qos=0, retain=False),
    Publication(topics.BODY, BodyMessage, qos=1, retain=True),
    Publication(topics.POSE, PoseMessage, qos=0, retain=False),
    Publication(topics.POSE_MSGPACK, PoseMessage, qos=0, retain=False, content_type=MSGPACK),
    Publication(topics.PREDICTED_POSE, PredictedPoseMessage, qos=0, retain=False),
    Publication(
        topics.PREDICTED_POSE_MSGPACK, PredictedPoseMessage, qos=0, retain=False, content_type=MSGPACK
    ),
    Publication(topics.LATE_POSE, LatePoseMessage, qos=1, retain=False),
    Publication(topics.ROBOT, RobotMessage, qos=0, retain=False),
    Publication(topics.SEGMENT, SegmentMessage, qos=0, retain=False),
    Publication(topics.MARKERS, MarkersMessage, qos=0, retain=False),
    Publication(topics.MODULE_STATE, ModuleState, qos=1, retain=True),
    Publication(topics.MODULE_AVAILABILITY, ModuleAvailability, qos=1, retain=True),
    Publication(topics.COMPARISON, ComparisonMessage, qos=0, retain=False),
)
"""All that a gateway publishes, and what ``compare --live`` adds below its name."""


def describe_body(skeleton: Skeleton) -> BodyMessage:
    """Return the skeleton as published."""
    names = skeleton.segment_names
    segments = tuple(
        BodySegment(
            name=name, parent=None if parent < 0 else names[parent], offset=tuple(offset), tip=tuple(tip)
        )
        for name, parent, offset, tip in zip(
            names,
            skeleton.parents.tolist(),
            skeleton.offsets.tolist(),
            skeleton.tips.tolist(),
            strict=True,
        )
    )

    joints = tuple(_describe_joint(joint, names) for joint in skeleton.joints)
    w, x, y, z = skeleton.neutral.tolist()
    return BodyMessage(name=skeleton.name, segments=segments, joints=joints, neutral=(w, x, y, z))


def _describe_joint(joint: Joint, segments: tuple[str, ...]) -> BodyJoint:
    # JSON has no infinity: an angle without a limit has null.
    def degrees(limit: float) -> float | None:
        return round(math.degrees(limit), 6) if math.isfinite(limit) else None

    return BodyJoint(
        name=joint.name,
        proximal=None if joint.proximal == WORLD else segments[joint.proximal],
        distal=segments[joint.distal],
        kind=joint.kind,
        sequence=joint.sequence,
        angles={angle.name: (degrees(angle.limits[0]), degrees(angle.limits[1])) for angle in joint.angles},
    )


def plain_json(statistics: Mapping[str, object]) -> dict[str, JsonValue]:
    """Return statistics as JSON values: NaN and infinity become null, numpy scalars numbers, the rest
    text."""
    options = orjson.OPT_NON_STR_KEYS | orjson.OPT_SERIALIZE_NUMPY
    plain: dict[str, Any] = orjson.loads(orjson.dumps(dict(statistics), default=_as_text, option=options))
    return plain


def _as_text(value: object) -> object:
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else str(value)
