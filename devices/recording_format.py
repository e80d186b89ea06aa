"""What stands in a recording: an MCAP file (https://mcap.dev) with what is named here.

A file begins with one metadata record, ``SESSION``, and the attachments; messages follow in MCAP chunks,
in the order in which the gateway handled them. That order, not the time of the messages, is what a
replay follows. A session that was rotated is several files, ``NAME.mcap``, ``NAME_part2.mcap``, …, each
whole in itself.

==================  ========================================================================================
``/chunks/<link>``  what a link gave, as it came and before anything was parsed; log time: arrival
``/datagrams/<link>``  the same of a link with several senders, each datagram with its sender's address
``/sent/<link>``    what the gateway wrote to a link; log time: the instant it calls the time of sending
``/skeleton``       skeleton frames, float64 bit for bit; log time: arrival of the data that completed it
``/markers``        of poses made from markers: where each was, where the body has it, whether it had a say
``/tf``             the same poses as transforms between segments, for viewers: nothing here reads them
``/events``         what happened: links up and down, restarts of modules, resets, calibrations, gaps
``/statistics``     counters and clock models of all modules, every so often and at the end
==================  ========================================================================================
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from devices.link import Chunk
from devices.ros_definitions import TF, TF_MESSAGE, definition

PROFILE = "mocap-gateway"
FORMAT_VERSION = 1
_LONGEST_SENDER = 255
SUFFIX = ".mcap"
EXPORTED = (".ros2.mcap", ".foxglove.mcap")
"""Ends of files that were made of recordings, for other programs."""

SESSION = "mocap.session"
"""Name of the metadata record at the beginning of every file; its keys, all of them texts:

``format`` (this version), ``session`` (the same for all parts), ``part`` (from 1), ``links`` (JSON:
what each link carries: byte_stream, can, or another word of the configuration), ``software`` (version of the
gateway), ``begun_ns`` (gateway time), ``begun_utc_ns`` (wall clock at the same instant), ``from_start`` (1:
from the gateway's first chunk on, so that a replay is bit-identical), ``name``.
"""

CHUNKS = "/chunks/"
DATAGRAMS = "/datagrams/"
SENT = "/sent/"
OF_LINKS = (CHUNKS, DATAGRAMS, SENT)
"""What topics of links begin with."""
SKELETON = "/skeleton"
MARKERS = "/markers"
TRANSFORMS = TF
EVENTS = "/events"
STATISTICS = "/statistics"

SUIT = "suit.json"
"""The worn suit exactly as used: skeleton, rig, calibration, local devices, field; numbers bit for bit."""
BODY = "body.yaml"
RIG = "rig.yaml"
"""Body and rig again, as files for people and for ``replay --with``."""
SETTINGS = "gateway.yaml"
"""The configuration, without secrets."""
CLOCK_TABLE = "clock_table.yaml"
HOST = "host.json"
"""Software and library versions, kernel, processor."""


class ChannelKind(NamedTuple):
    """How the messages of a channel are encoded."""

    schema: str
    schema_encoding: str
    message_encoding: str
    schema_text: str


_CHUNK_TEXT = """The bytes themselves, nothing else. Channel metadata: link, framing.
framing byte_stream: COBS wire frames, cut anywhere; framing can: CAN frame records
(firmware_protocol/README.md); any other word: what the configuration says that the link carries.
log_time = publish_time = gateway time, ns.
"""

_DATAGRAM_TEXT = """offset 0  u8    N
       1  u8[N] address of the sender, HOST:PORT in UTF-8
then the bytes of the datagram, nothing else. Channel metadata and times as of mocap.Bytes.
"""

_SKELETON_TEXT = """All numbers little-endian; S segments in the order of suit.json.
offset 0   i64  sequence of the frame
       8   i64  gateway time of the measurement, ns
       16  i32  index of the root segment
       20  u16  S
       22  u8   which arrays follow: bit 0 q_wb, 1 angular_rate, 2 joint_acceleration, 3 p_w, 4 sigma
                (one left out is NaN throughout)
       23  u8   reserved, 0
       24  u8[S] status: 0 measured 1 interpolated 2 held 3 predicted 4 warming up 5 missing
then, each if its bit is set:
       f64[S,4] q_wb, unit quaternion w x y z, segment axes to world
       f64[S,3] angular_rate, rad/s, segment axes
       f64[S,3] joint_acceleration, m/s^2, world axes, without gravity, of the proximal joint
       f64[S,3] p_w, m, world, of the proximal joint
       f64[S]   sigma, rad, standard deviation of the orientation
"""

_MARKERS_TEXT = """All numbers little-endian; M markers in the order of suit.json, U points without a name.
Places in world axes, m.
offset 0   i64  sequence of the frame, that of its skeleton frame
       8   i64  gateway time of the measurement, ns
       16  u16  M
       18  u16  U
       20  i16[M] whose point the marker was given: its own number, another's, or -1 for a nameless one
then   u8[M]    1: it had a say in the pose
       f32[M,3] where it was seen, after names were put right; NaN: not seen
       f32[M,3] where the body has it
       f32[U,3] the points without a name
"""

_EVENT_SCHEMA = """{"type": "object", "required": ["time_ns", "name", "data"], "properties": {
"time_ns": {"type": "integer", "description": "gateway time, ns"},
"name": {"type": "string"}, "data": {"type": "object"}}}"""

_STATISTICS_SCHEMA = (
    '{"type": "object", "description": "as in bridge/health: links, assembly, modules, clocks"}'
)

CHUNK_KIND = ChannelKind("mocap.Bytes", "text", "bytes", _CHUNK_TEXT)
DATAGRAM_KIND = ChannelKind("mocap.Datagram", "text", "mocap.Datagram", _DATAGRAM_TEXT)
KINDS: dict[str, ChannelKind] = {
    SKELETON: ChannelKind("mocap.SkeletonFrame", "text", "mocap.SkeletonFrame", _SKELETON_TEXT),
    MARKERS: ChannelKind("mocap.MarkerFit", "text", "mocap.MarkerFit", _MARKERS_TEXT),
    TRANSFORMS: ChannelKind(TF_MESSAGE, "ros2msg", "cdr", definition(TF_MESSAGE)),
    EVENTS: ChannelKind("mocap.Event", "jsonschema", "json", _EVENT_SCHEMA),
    STATISTICS: ChannelKind("mocap.Statistics", "jsonschema", "json", _STATISTICS_SCHEMA),
}
"""By topic; topics of links are of ``CHUNK_KIND`` or ``DATAGRAM_KIND``."""


def kind_of(topic: str) -> ChannelKind:
    """Return how messages of a topic are encoded. Raises ``KeyError`` for a topic that no recording has."""
    if topic.startswith(DATAGRAMS):
        return DATAGRAM_KIND
    return CHUNK_KIND if topic.startswith((CHUNKS, SENT)) else KINDS[topic]


def is_recording(path: Path) -> bool:
    """Return whether a file is a recording by its name."""
    return path.suffix == SUFFIX and not path.name.endswith(EXPORTED)


def is_known(topic: str) -> bool:
    """Return whether this version knows what stands under a topic."""
    return topic.startswith(OF_LINKS) or topic in KINDS


def link_of(topic: str) -> str | None:
    """Return the link whose topic it is; None for a topic of no link."""
    return topic.split("/", 2)[2] if topic.startswith(OF_LINKS) else None


def message_of(chunk: Chunk) -> tuple[str, bytes]:
    """Return the topic and message of what a link gave."""
    if not chunk.sender:
        return CHUNKS + chunk.link, chunk.data
    sender = chunk.sender.encode()[:_LONGEST_SENDER]
    return DATAGRAMS + chunk.link, bytes((len(sender),)) + sender + chunk.data


def chunk_of(topic: str, time_ns: int, data: bytes) -> Chunk | None:
    """Return what a link gave, from its topic and message; None for another topic or a damaged message."""
    if topic.startswith(CHUNKS):
        return Chunk(data, time_ns, topic.removeprefix(CHUNKS))
    if not (topic.startswith(DATAGRAMS) and data and len(data) > data[0]):
        return None
    end = 1 + data[0]
    sender = data[1:end].decode(errors="replace")
    return Chunk(data[end:], time_ns, topic.removeprefix(DATAGRAMS), sender)
