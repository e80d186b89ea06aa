"""Poses of all gateways from the brokers into an archive: live ones, and those that come late, none twice."""

from __future__ import annotations

import itertools
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import aiomqtt
import numpy as np
import orjson
from numpy.typing import NDArray

from gateway.contract import topics
from gateway.contract.messages import BridgeInfo
from gateway.contract.topics import ANY_GATEWAY, Topics
from gateway.fleet.archive import (
    Archive,
    ArchiveError,
    Partition,
    checked_name,
    day_of,
    orientation_columns,
)

MOST_ROWS = 20_000
"""Of one file, more or less; then what waits is to be written."""
MOST_WAITING = 500_000
"""Rows that wait to be written while a disk is full: less than a gigabyte of memory."""
_NAMES = itertools.count()
_NO_POSE = (ArchiveError, ValueError, OverflowError, TypeError, KeyError, AttributeError)
"""Raised by messages that are not what their topic promises; ``ValidationError`` is a ``ValueError``."""


@dataclass
class _Rows:
    """Poses that wait to be written, of one gateway, day and body."""

    utc_ns: list[int] = field(default_factory=list)
    seq: list[int] = field(default_factory=list)
    late: list[bool] = field(default_factory=list)
    instance: list[str] = field(default_factory=list)
    q_wb: list[NDArray[np.float32]] = field(default_factory=list)
    angles: list[dict[str, float]] = field(default_factory=list)


class Collector:
    """Takes messages, and writes files of rows. No network.

    wearers: by gateway; one that is not named wears the gateway's own name.
    """

    def __init__(self, archive: Archive, site: str, base_topic: str, wearers: Mapping[str, str]) -> None:
        """Collect for a site. wearers: who wears the suit of a gateway, by its name.

        Raises ``ArchiveError`` for a site that cannot stand in a path.
        """
        self.rows = 0
        """Taken so far."""
        self.repeated = 0
        """Poses left out because they were there already."""
        self.undecodable = 0
        self.missed = 0
        """Poses that came faster than they were taken, or for which there was no room."""
        self.waiting = 0
        """Rows that are not written yet."""
        self.is_full = False
        """Whether what waits is to be written soon."""
        self.archive = archive
        self._site = checked_name("site", site)
        self._wearers = dict(wearers)
        self._topics = Topics(base_topic, ANY_GATEWAY)
        self._infos: dict[str, BridgeInfo] = {}
        self._seen: dict[tuple[str, str], set[int]] = {}
        self._waiting: dict[tuple[str, str, tuple[str, ...]], _Rows] = {}

    def take(self, message: aiomqtt.Message) -> None:
        """Take a message of any topic."""
        address = self._topics.split(message.topic.value)
        if address is None or not isinstance(message.payload, bytes):
            return
        gateway, below = address
        try:
            if below == topics.BRIDGE_INFO and message.payload:
                info = BridgeInfo.model_validate_json(message.payload)
                checked_name("method", info.reconstructor)
                self._infos[gateway] = info
            elif below in (topics.POSE, topics.LATE_POSE) and not message.retain:
                self._take_pose(gateway, orjson.loads(message.payload), is_late=below == topics.LATE_POSE)
        except _NO_POSE:
            self.undecodable += 1

    def _take_pose(self, gateway: str, pose: dict[str, Any], *, is_late: bool) -> None:
        info = self._infos.get(gateway)
        if info is None:
            return  # it is published at once after the subscription; without it the day is not known
        instance = str(pose["instance"] if is_late else info.instance)
        seen = self._seen.get((gateway, instance))
        if seen is None:
            seen = self._seen[gateway, instance] = self.archive.seen(gateway, instance)
        seq = int(np.int64(pose["seq"]))
        if seq in seen:
            self.repeated += 1
            return
        if self.waiting >= MOST_WAITING:
            self.missed += 1
            return
        utc_ns = int(np.int64(pose["t_ns"] + (0 if info.utc is None else info.utc.offset_ns)))
        names = tuple(pose["segments"])
        q_wb = np.array([each or _UNKNOWN for each in pose["segments"].values()], np.float32)
        q_wb = q_wb.reshape(len(names), 4)
        angles = _angles(pose)
        rows = self._waiting.setdefault((gateway, day_of(utc_ns), names), _Rows())
        rows.q_wb.append(q_wb)
        rows.utc_ns.append(utc_ns)
        rows.seq.append(seq)
        rows.late.append(is_late)
        rows.instance.append(instance)
        rows.angles.append(angles)
        seen.add(seq)
        self.rows += 1
        self.waiting += 1
        self.is_full |= len(rows.seq) >= MOST_ROWS

    def flush(self) -> None:
        """Write all that waits. Raises ``OSError``; what is not written yet waits on."""
        for key in list(self._waiting):
            self._write(*key)
        self.is_full = False

    def _write(self, gateway: str, day: str, names: tuple[str, ...]) -> None:
        rows = self._waiting[gateway, day, names]
        columns: dict[str, Any] = {
            "utc_ns": np.array(rows.utc_ns, np.int64),
            "seq": np.array(rows.seq, np.int64),
            "late": np.array(rows.late, np.bool_),
            "gateway": [gateway] * len(rows.seq),
            "instance": rows.instance,
        }
        columns |= orientation_columns(names, np.stack(rows.q_wb))
        for angle in dict.fromkeys(itertools.chain.from_iterable(rows.angles)):
            columns[angle] = np.array([row.get(angle, np.nan) for row in rows.angles], np.float32)
        wearer = self.archive.pseudonym(self._wearers.get(gateway, gateway))
        partition = Partition(self._infos[gateway].reconstructor, self._site, day, wearer)
        name = f"stream_{time.time_ns()}_{next(_NAMES)}"
        provenance = {"gateway": gateway, "instances": sorted(set(rows.instance)), "solved": "live"}
        self.archive.write(self.archive.part(partition, name), columns, provenance)
        del self._waiting[gateway, day, names]
        self.waiting -= len(rows.seq)


_UNKNOWN = [np.nan] * 4


def _angles(pose: dict[str, Any]) -> dict[str, float]:
    """Return the joint angles that a pose carries, by the names of columns."""
    joints = pose.get("joint_angles") or {}
    return {
        f"{joint}_{name}_deg": np.nan if value is None else float(value)
        for joint, angles in joints.items()
        for name, value in (angles or {}).items()
    }
