"""The messages that one skeleton frame becomes.

Runs for every published frame, so it goes round the models of messages: whole arrays are rounded at once, and
what seldom changes (the status of the segments) is kept. At 100 Hz each call finds the processor's caches
cold, so that the number of steps counts more than what each of them does: the usual frame, all of whose
numbers are finite, is written as text into a template.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator
from typing import Any, NamedTuple

import numpy as np
import orjson
import ormsgpack
from paho.mqtt.properties import Properties

from gateway.body.joint_angles import JointAngles
from gateway.body.skeleton import Skeleton
from gateway.contract.messages import STATUS_NAMES
from gateway.contract.properties import JSON, MSGPACK, properties_of
from gateway.contract.topics import Topics
from gateway.frames import FloatArray, MarkerFit, SkeletonFrame, StatusArray
from gateway.outputs.output import Thinning
from gateway.outputs.prediction import Prediction, predictor_of
from gateway.outputs.settings import MqttSettings, PoseFormat, PoseMap

_ATTRIBUTES: dict[PoseMap, str] = {
    PoseMap.POSITION: "p_w",
    PoseMap.ACCELERATION: "joint_acceleration",
    PoseMap.ANGULAR_RATE: "angular_rate",
    PoseMap.SIGMA: "sigma",
}
_ANGLE_DECIMALS = 3
_WARNINGS = ("near_gimbal_lock", "beyond_limits")

Plain = dict[str, Any]
"""JSON values."""


def as_json(message: Plain) -> bytes:
    """Return a message as JSON."""
    return orjson.dumps(message)


def as_msgpack(message: Plain) -> bytes:
    """Return the same fields as MessagePack."""
    return ormsgpack.packb(message)


def segment_messages(pose: Plain) -> Iterator[tuple[str, Plain]]:
    """Yield the fields of a ``SegmentMessage`` for every segment of a pose, by name."""
    head = {key: pose[key] for key in ("t_ns", "seq", "frame", "order")}
    maps: list[str] = [name.value for name in _ATTRIBUTES if name.value in pose]
    for name, orientation in pose["segments"].items():
        rest = {key: pose[key][name] for key in maps}
        yield name, {**head, "orientation": orientation, "status": pose["status"][name], **rest}


class PoseEncoder:
    """Encodes the frames of one skeleton.

    segment_names: in the order of the rows of the frames.
    decimals: numbers are rounded to so many; None: full precision.
    include: optional maps beside the orientations.
    joint_angles: of the same skeleton, for the map of that name; the angles are continuous over the frames
    that are encoded. Without it there are none.
    """

    def __init__(
        self,
        segment_names: tuple[str, ...],
        decimals: int | None = 6,
        include: Collection[PoseMap] = (),
        joint_angles: JointAngles | None = None,
    ) -> None:
        self._names = segment_names
        self._decimals = decimals
        self._maps = tuple((name.value, _ATTRIBUTES[name]) for name in _ATTRIBUTES if name in include)
        self._joint_angles = joint_angles if PoseMap.JOINT_ANGLES in include else None
        self._status_key = b""
        self._status: dict[str, str] = {}
        self._scale = 1.0 if decimals is None else 10.0**decimals
        self._template_key: tuple[int, bytes] | None = None
        self._template = b""
        self._rounded = {"q_wb": np.empty((len(segment_names), 4))}
        for _, attribute in self._maps:
            self._rounded[attribute] = np.empty(_shape_of(attribute, len(segment_names)))

    def encode(self, frame: SkeletonFrame) -> bytes:
        """Return JSON bytes of a ``PoseMessage``. Raises ``ValueError`` for a frame of another skeleton."""
        text = None if self._joint_angles is not None else self._usual_text(frame)
        return as_json(self.message(frame)) if text is None else text

    def _usual_text(self, frame: SkeletonFrame) -> bytes | None:
        """Write what ``message`` says as JSON.

        None for a frame of another size, or with numbers that are not finite, whose rows are null as a whole.
        """
        rows: list[bytes] = []
        for attribute, rounded in self._rounded.items():
            values: FloatArray = getattr(frame, attribute)
            if values.shape != rounded.shape:
                return None
            if self._decimals is None:
                np.copyto(rounded, values)
            else:  # as np.round does; adding zero makes -0.0 a plain 0.0
                np.multiply(values, self._scale, rounded)
                np.rint(rounded, rounded)
                np.divide(rounded, self._scale, rounded)
                np.add(rounded, 0.0, rounded)
            text = orjson.dumps(rounded, option=orjson.OPT_SERIALIZE_NUMPY)
            # What is not finite is null in JSON: then the message is made the slow way, row by row.
            if b"null" in text:
                return None
            rows += text[2:-2].split(b"],[") if rounded.ndim == 2 else text[1:-1].split(b",")
        if len(frame.status) != len(self._names):
            return None
        # Root and status hardly ever change: all but the numbers is encoded once, and kept.
        key = (frame.root, frame.status.tobytes())
        if key != self._template_key:
            self._template_key, self._template = key, self._template_of(frame)
        return self._template % (frame.time_ns, frame.sequence, *rows)

    def _template_of(self, frame: SkeletonFrame) -> bytes:
        """Return the JSON of a frame of this root and status, with places for the numbers."""
        names = [_key_in_template(name) for name in self._names]
        start = orjson.dumps({"frame": "ENU", "order": "wxyz", "root": self._names[frame.root]})[1:-1]
        status = orjson.dumps(self._status_names(frame.status))
        parts = [b'"t_ns":%d,"seq":%d', start.replace(b"%", b"%%")]
        parts += [_places_for("segments", names, b"[%b]"), b'"status":' + status.replace(b"%", b"%%")]
        for key, attribute in self._maps:
            parts.append(_places_for(key, names, b"[%b]" if self._rounded[attribute].ndim == 2 else b"%b"))
        return b"{" + b",".join(parts) + b"}"

    def message(self, frame: SkeletonFrame) -> Plain:
        """Return the fields of a ``PoseMessage``. Raises ``ValueError`` for a frame of another skeleton."""
        message: Plain = {
            "t_ns": frame.time_ns,
            "seq": frame.sequence,
            "frame": "ENU",
            "order": "wxyz",
            "root": self._names[frame.root],
            "segments": dict(zip(self._names, self._rows(frame.q_wb), strict=True)),
            "status": self._status_names(frame.status),
        }
        for key, attribute in self._maps:
            values = self._rows(getattr(frame, attribute))
            message[key] = dict(zip(self._names, values, strict=True))
        if self._joint_angles is not None:
            message |= self._joints(self._joint_angles, frame.q_wb)
        return message

    def _rows(self, values: FloatArray) -> list[object]:
        """Return rows as JSON values; a row that is not finite throughout is None."""
        # Adding zero makes -0.0 a plain 0.0.
        rounded = values if self._decimals is None else np.round(values, self._decimals) + 0.0
        rows: list[object] = rounded.tolist()
        is_finite = np.isfinite(rounded)
        if is_finite.all():
            return rows
        is_defined = np.logical_and.reduce(is_finite.reshape(len(rows), -1), axis=1)
        return [row if defined else None for row, defined in zip(rows, is_defined, strict=True)]

    def _joints(self, joint_angles: JointAngles, q_wb: FloatArray) -> dict[str, object]:
        """Return angles in degrees by joint and name, and the joints whose angles need care."""
        found = joint_angles.update(q_wb)
        rows = np.degrees(found.angles)
        rounded = (
            rows if self._decimals is None else np.round(rows, min(self._decimals, _ANGLE_DECIMALS)) + 0.0
        )
        joints = joint_angles.joints
        return {
            "joint_angles": {
                joint.name: None
                if np.isnan(row[0])
                else dict(zip((angle.name for angle in joint.angles), row.tolist(), strict=False))
                for joint, row in zip(joints, rounded, strict=True)
            },
            "joint_warnings": {
                joint.name: [word for word, applies in zip(_WARNINGS, flags, strict=True) if applies]
                for joint, *flags in zip(joints, found.near_gimbal, found.beyond_limits, strict=True)
                if any(flags)
            },
        }

    def _status_names(self, status: StatusArray) -> dict[str, str]:
        key = status.tobytes()
        if key != self._status_key:
            names = (STATUS_NAMES[value] for value in key)
            self._status_key, self._status = key, dict(zip(self._names, names, strict=True))
        return self._status


def _key_in_template(name: str) -> bytes:
    """Return a name as JSON, for a template of bytes."""
    return orjson.dumps(name).replace(b"%", b"%%")


def _places_for(key: str, names: list[bytes], place: bytes) -> bytes:
    return b'"%b":{' % key.encode() + b",".join(name + b":" + place for name in names) + b"}"


def _shape_of(attribute: str, n_segments: int) -> tuple[int, ...]:
    return (n_segments,) if attribute == "sigma" else (n_segments, 3)


_DECIMALS = 6  # a micrometre: less than any optical system resolves


def markers_message(labels: tuple[str, ...], frame: SkeletonFrame) -> dict[str, Any] | None:
    """Return the fields of a ``MarkersMessage``; None for a pose made of something else, or of no marker.

    labels: of the fitted body, in the order of the fit. Raises ``ValueError`` for another number of them.
    """
    fit = frame.markers
    if fit is None or not np.isfinite(fit.virtual).all():
        return None
    rows = zip(
        labels, _places(fit.positions), _places(fit.virtual), _residuals(fit), fit.used.tolist(), strict=True
    )
    markers = {
        label: {"position": seen, "expected": expected, "residual": residual, "used": used}
        for label, seen, expected, residual, used in rows
    }
    for marker, whose in fit.renamed:
        markers[labels[marker]]["taken_from"] = "" if whose < 0 else labels[whose]
    return {
        "t_ns": frame.time_ns,
        "seq": frame.sequence,
        "frame": "ENU",
        "markers": markers,
        "unlabelled": [place for place in _places(fit.unlabelled) if place is not None],
    }


def _places(places: FloatArray) -> list[list[float] | None]:
    """Return rows as JSON values; None for one that is not known."""
    rounded = np.round(places, _DECIMALS) + 0.0
    rows: list[list[float]] = rounded.tolist()
    known: list[bool] = np.logical_and.reduce(np.isfinite(rounded), axis=1).tolist()
    return [row if is_known else None for row, is_known in zip(rows, known, strict=True)]


def _residuals(fit: MarkerFit) -> list[float | None]:
    rounded: list[float] = np.round(fit.residuals, _DECIMALS).tolist()
    return [residual if math.isfinite(residual) else None for residual in rounded]


class Outgoing(NamedTuple):
    """One message as it is published, with QoS 0."""

    topic: str
    payload: bytes
    properties: Properties | None


class _PoseTopics(NamedTuple):
    """Spelt out once, not for every pose."""

    pose: str
    pose_msgpack: str
    predicted: str
    predicted_msgpack: str
    markers: str


class PosePublications:
    """Frames of one skeleton to messages."""

    def __init__(
        self, settings: MqttSettings, skeleton: Skeleton, topics: Topics, markers: tuple[str, ...] = ()
    ) -> None:
        """markers: names of those that the body has, for poses made from them."""
        angles = JointAngles(skeleton) if PoseMap.JOINT_ANGLES in settings.include else None
        self._encoder = PoseEncoder(skeleton.segment_names, settings.decimals, settings.include, angles)
        self._formats = tuple(settings.pose_formats)
        self._topics = _PoseTopics(
            topics.pose,
            topics.pose_msgpack,
            topics.predicted_pose,
            topics.predicted_pose_msgpack,
            topics.markers,
        )
        self._predictor = predictor_of(settings, skeleton)
        if self._predictor is not None:  # its angles are continuous by themselves
            angles = JointAngles(skeleton) if PoseMap.JOINT_ANGLES in settings.include else None
            self._of_predicted = PoseEncoder(
                skeleton.segment_names, settings.decimals, settings.include, angles
            )
        self._segment_topics = {name: topics.segment(name) for name in skeleton.segment_names}
        self._segments_due = None if settings.segment_rate is None else Thinning(settings.segment_rate)
        self._markers = markers
        self._markers_due = None if settings.marker_rate is None else Thinning(settings.marker_rate)
        self.has_segments = True
        """Whether messages of single segments and of markers are made, where they are configured."""
        protocol, expiry_s = settings.protocol_in_use, settings.pose_expiry_s
        self._json = properties_of(protocol, JSON, expiry_s)
        self._msgpack = properties_of(protocol, MSGPACK, expiry_s)

    def of(self, frame: SkeletonFrame) -> list[Outgoing]:
        """Return the messages of a frame. Raises ``ValueError`` for one of another skeleton."""
        due = self._segments_due if self.has_segments else None
        has_segments = due is not None and due.admits(frame.time_ns)
        if not has_segments and self._formats == (PoseFormat.JSON,):
            made = [Outgoing(self._topics.pose, self._encoder.encode(frame), self._json)]
        else:
            made = self._of_message(self._encoder.message(frame), has_segments=has_segments)
        if self._predictor is not None:
            made += self._predicted(self._predictor.predict(frame))
        if self._markers_due is not None and frame.markers is not None and self.has_segments:
            made += self._of_markers(frame, self._markers_due)
        return made

    def _of_message(self, message: Plain, *, has_segments: bool) -> list[Outgoing]:
        """Return a pose in all formats that are wanted, and its segments."""
        made = []
        if PoseFormat.JSON in self._formats:
            made.append(Outgoing(self._topics.pose, as_json(message), self._json))
        if PoseFormat.MSGPACK in self._formats:
            made.append(Outgoing(self._topics.pose_msgpack, as_msgpack(message), self._msgpack))
        if has_segments:
            made += [
                Outgoing(self._segment_topics[name], as_json(segment), self._json)
                for name, segment in segment_messages(message)
            ]
        return made

    def _predicted(self, prediction: Prediction) -> list[Outgoing]:
        """Return a prediction in all formats that are wanted."""
        if self._formats == (PoseFormat.JSON,):
            text = self._of_predicted.encode(prediction.frame)[:-1]
            payload = b'%b,"predicted_from_ns":%d}' % (text, prediction.measured_ns)
            return [Outgoing(self._topics.predicted, payload, self._json)]
        message = self._of_predicted.message(prediction.frame)
        message["predicted_from_ns"] = prediction.measured_ns
        made = []
        if PoseFormat.JSON in self._formats:
            made.append(Outgoing(self._topics.predicted, as_json(message), self._json))
        made.append(Outgoing(self._topics.predicted_msgpack, as_msgpack(message), self._msgpack))
        return made

    def _of_markers(self, frame: SkeletonFrame, due: Thinning) -> list[Outgoing]:
        message = markers_message(self._markers, frame) if due.admits(frame.time_ns) else None
        return [] if message is None else [Outgoing(self._topics.markers, as_json(message), self._json)]
