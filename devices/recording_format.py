"""What stands in a recording: an MCAP file (https://mcap.dev) with what is named here.

A file begins with one metadata record, ``SESSION``, and the attachments; messages follow in MCAP chunks,
in the order in which the gateway handled them. That order, not the time of the messages, is what a
replay follows. A session that was rotated is several files, ``NAME.mcap``, ``NAME_part2.mcap``, …, each
whole in itself.

==================  ========================================================================================
``/chunks/<link>``  what a link gave, as it came and before anything was parsed; log time: arrival
``/sent/<link>``    what the gateway wrote to a link; log time: the instant it calls the time of sending
``/skeleton``       skeleton frames, float64 bit for bit; log time: arrival of the data that completed it
``/markers``        of poses made from markers: where each was, where the body has it, whether it had a say
``/events``         what happened: links up and down, restarts of modules, resets, calibrations, gaps
``/statistics``     counters and clock models of all modules, every so often and at the end
==================  ========================================================================================
"""

from __future__ import annotations

from typing import NamedTuple

PROFILE = "mocap-gateway"
FORMAT_VERSION = 1
SUFFIX = ".mcap"

SESSION = "mocap.session"
"""Name of the metadata record at the beginning of every file; its keys, all of them texts:

``format`` (this version), ``session`` (the same for all parts), ``part`` (from 1), ``links`` (JSON:
framing by link), ``software`` (version of the gateway), ``begun_ns`` (gateway time), ``begun_utc_ns``
(wall clock at the same instant), ``from_start`` (1: from the gateway's first chunk on, so that a replay is
bit-identical), ``name``.
"""

CHUNKS = "/chunks/"
SENT = "/sent/"
SKELETON = "/skeleton"
MARKERS = "/markers"
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
(firmware_protocol/README.md).
log_time = publish_time = gateway time, ns.
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
KINDS: dict[str, ChannelKind] = {
    SKELETON: ChannelKind("mocap.SkeletonFrame", "text", "mocap.SkeletonFrame", _SKELETON_TEXT),
    MARKERS: ChannelKind("mocap.MarkerFit", "text", "mocap.MarkerFit", _MARKERS_TEXT),
    EVENTS: ChannelKind("mocap.Event", "jsonschema", "json", _EVENT_SCHEMA),
    STATISTICS: ChannelKind("mocap.Statistics", "jsonschema", "json", _STATISTICS_SCHEMA),
}
"""By topic; topics of links are of ``CHUNK_KIND``."""


def kind_of(topic: str) -> ChannelKind:
    """How messages of a topic are encoded. Raises KeyError for a topic that no recording has."""
    return CHUNK_KIND if topic.startswith((CHUNKS, SENT)) else KINDS[topic]
