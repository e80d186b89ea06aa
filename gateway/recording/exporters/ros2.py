"""A bag of ROS 2 (MCAP, CDR) of transforms, joint angles, and each module's raw readings.

``/tf`` and ``/tf_static`` by REP 103 and 105, ``/humans/bodies/<body>/joint_states`` by REP 155 (of a robot
``/joint_states``), ``/modules/<segment>/imu/data_raw`` and ``…/imu/mag`` by REP 145. Header stamps are the
instants of the measurement.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from gateway.body.skeleton import WornSuit
from gateway.contract import ros_messages as ros
from gateway.geometry import quaternion
from gateway.recording.exporters.message_file import MessageFile, poses_of, samples_of
from gateway.recording.exporters.take import Take

BODY = "mocap"
"""Id of the only body, by REP 155."""
_LATCHED = """- history: keep_last
  depth: 1
  reliability: reliable
  durability: transient_local
  deadline: {sec: 9223372036, nsec: 854775807}
  lifespan: {sec: 9223372036, nsec: 854775807}
  liveliness: automatic
  liveliness_lease_duration: {sec: 9223372036, nsec: 854775807}
  avoid_ros_namespace_conventions: false
"""
"""Quality of service of static transforms, as bags state it."""


def write(take: Take, path: Path, units_per_m: float) -> None:
    """Write a take as a bag of ROS 2: metres, z up. Raises ``OSError``."""
    with MessageFile(path, "ros2") as file:
        body = _Body(file, take)
        poses = poses_of(take)
        pose = next(poses, None)
        modules = _Modules(file, take)
        if take.recording is not None:
            for sample in samples_of(take.recording):
                # Players of bags expect messages about in order of time, so poses are merged with the
                # samples.
                while pose is not None and pose.time_ns <= sample.time_ns:
                    body.add(*pose)
                    pose = next(poses, None)
                modules.add(*sample)
        while pose is not None:
            body.add(*pose)
            pose = next(poses, None)


def _schema(message: str) -> tuple[str, str, bytes]:
    return message, "ros2msg", ros.definition(message).encode()


class _Body:
    def __init__(self, file: MessageFile, take: Take) -> None:
        skeleton = take.skeleton
        self._file = file
        self._transforms = ros.BodyTransforms(skeleton)
        self._tf = file.channel(ros.TF, _schema(ros.TF_MESSAGE), "cdr")
        self._states = ros.BodyJointStates(skeleton, BODY)
        self._joint_states = file.channel(self._states.topic, _schema(ros.JOINT_STATE), "cdr")

        statics = [(skeleton.segment_names[int(np.argmax(skeleton.parents < 0))], f"body_{BODY}")]
        places, turns = [np.zeros(3)], [np.array([1.0, 0.0, 0.0, 0.0])]
        if take.recording is not None and take.recording.meta.has_suit:
            for frame in _module_frames(take.recording.meta.suit):
                statics.append((frame.segment, frame.name))
                places.append(frame.place)
                turns.append(frame.turn)
        # Latched: a listener that joins late still gets transforms that are sent once.
        static = file.channel(
            ros.TF_STATIC, _schema(ros.TF_MESSAGE), "cdr", {"offered_qos_profiles": _LATCHED}
        )
        message = ros.TransformsEncoder(statics).encode(take.begun_ns, np.array(places), np.array(turns))
        file.add(static, take.begun_ns, message)

    def add(self, time_ns: int, q_wb: np.ndarray, p_w: np.ndarray) -> None:
        """Write the transforms and joint states of one pose: q_wb (S, 4), p_w (S, 3) in m."""
        self._file.add(self._tf, time_ns, self._transforms.encode(time_ns, q_wb, p_w))
        if self._states.names:
            self._file.add(self._joint_states, time_ns, self._states.encode(time_ns, q_wb))


class _ModuleFrame(NamedTuple):
    """Where a module sits: its axes in those of the segment's frame."""

    module: int
    segment: str
    name: str
    place: np.ndarray  # (3,) m
    turn: np.ndarray  # (4,)


def _module_frames(suit: WornSuit) -> list[_ModuleFrame]:
    frames = []
    for s, row in enumerate(suit.module_of_segment.tolist()):
        if row >= 0:
            # Frames of segments are turned by the neutral posture, so modules in them are as well.
            segment = suit.skeleton.segment_names[s]
            neutral = suit.skeleton.neutral
            frames.append(
                _ModuleFrame(
                    suit.module_ids[row],
                    segment,
                    f"{segment}_imu",
                    quaternion.rotate(neutral, suit.lever_arms[s]),
                    quaternion.multiply(neutral, suit.sensor_to_segment[s]),
                )
            )
    return frames


class _Modules:
    """Channels of the modules that the suit has; others are left out."""

    def __init__(self, file: MessageFile, take: Take) -> None:
        self._file = file
        self._frames: dict[int, _ModuleFrame] = {}
        if take.recording is not None and take.recording.meta.has_suit:
            self._frames = {frame.module: frame for frame in _module_frames(take.recording.meta.suit)}
        self._imus: dict[int, tuple[int, ros.ImuEncoder]] = {}
        self._fields: dict[int, tuple[int, ros.MagneticFieldEncoder]] = {}

    def add(self, module: int, time_ns: int, force: np.ndarray, rate: np.ndarray, field: np.ndarray) -> None:
        """Write a sample, m/s², rad/s, µT, each (3,). Modules that no segment wears are left out."""
        frame = self._frames.get(module)
        if frame is None:
            return
        topic = f"/modules/{frame.segment}/imu"
        if module not in self._imus:
            channel = self._file.channel(f"{topic}/data_raw", _schema(ros.IMU), "cdr")
            self._imus[module] = channel, ros.ImuEncoder(frame.name)
        imu, encoder = self._imus[module]
        self._file.add(imu, time_ns, encoder.encode(time_ns, rate, force))
        # A module without magnetometer gets no topic for it.
        if np.isnan(field).any():
            return
        if module not in self._fields:
            channel = self._file.channel(f"{topic}/mag", _schema(ros.MAGNETIC_FIELD), "cdr")
            self._fields[module] = channel, ros.MagneticFieldEncoder(frame.name)
        mag, of_field = self._fields[module]
        self._file.add(mag, time_ns, of_field.encode(time_ns, field))
