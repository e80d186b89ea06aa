"""An Xsens suit as a source, through the network streamer of MVN: trackers' raw data, or its segments.

Trackers (MXTP23) give raw samples, segments (MXTP02) orientations fused by MVN, and joint angles (MXTP20)
the same where no segments are sent, with a pelvis that faces east and stands level. The method decides
which of them poses are made from.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, Literal, TypeVar

from pydantic import Field

from devices.link import Chunk
from devices.vendor_protocols.mvn import (
    SEGMENTS,
    TO_ISB,
    Datagram,
    JointRotation,
    MvnDecoder,
    SegmentPose,
    Tracker,
)
from devices.vendor_protocols.rotations import Quaternion, in_turn, multiply
from firmware_protocol import FusedSample, InertialSample
from gateway.frames import NOT_READ, FusedReading, Sample
from gateway.sources.makers import (
    LEAP_IN_NUMBER,
    MakersDevice,
    MakersLinkSettings,
    MakersSource,
    StreamCounter,
    scaled,
)

if TYPE_CHECKING:
    from gateway.sources.module_table import ModuleTable
    from gateway.sources.statistics import ModuleRecord

_UPRIGHT = (math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0)
"""Axes of the ISB to a world with z up, of a segment that stands and faces x."""
_PELVIS = 1
_Reading = TypeVar("_Reading")
ANOTHER_CHARACTER = "another_character"


class MvnLinkSettings(MakersLinkSettings):
    """What the network streamer of Xsens MVN sends."""

    carries: Literal["mvn"] = "mvn"
    module: int = Field(
        default=0,
        ge=0,
        le=40,
        description="for mvn: added to the numbers of its segments (1 pelvis … 23 left toes) to give those "
        "of modules",
    )
    character: int = Field(default=0, ge=0, le=255, description="for mvn: number of the person in the stream")

    @property
    def own_numbers(self) -> tuple[int, ...]:
        """None: not every stream has every segment."""
        return ()


class MvnDevice(MakersDevice):
    """A streamer numbers its samples and stamps them in steps of 1 ms; all segments share both."""

    new_decoder = MvnDecoder

    def __init__(self, settings: Any) -> None:
        super().__init__(settings)
        self._character: int = getattr(settings, "character", 0)
        self._reporting: set[int] = set()
        self._numbers = StreamCounter()
        self._has_poses = False
        self._leader: int | None = None
        """Module whose clock all share."""
        self._time_ns = 0

    @property
    def modules(self) -> tuple[int, ...]:
        """Those that were heard."""
        return tuple(sorted(self._reporting))

    def readings(
        self, message: Datagram, modules: ModuleTable, chunk: Chunk
    ) -> Iterator[Sample | FusedReading]:
        """Yield a sample of each tracker, or an orientation of each segment."""
        if message.character != self._character:
            self._strange[ANOTHER_CHARACTER] += 1
            return
        self._has_poses |= any(isinstance(item, SegmentPose) for item in message.items)
        counted = self._numbers.number(message.sample, message.time_ms)
        if counted is None:
            self._strange[LEAP_IN_NUMBER] += 1
            return
        losses = modules.losses(chunk.link)
        joints = [item for item in message.items if isinstance(item, JointRotation)]
        # Joint rotations beside segment poses say the same twice.
        if joints and self._has_poses:
            self.decoder.unused += 1
            return

        fused = [(item.segment, item.orientation) for item in message.items if isinstance(item, SegmentPose)]
        for record, q in self._dated([*fused, *_chained(joints).items()], message, modules, chunk):
            number = record.counter(FusedSample.KIND).count_unwrapped(counted, losses)
            if number is not None:
                yield FusedReading(record.module, number, self._time_ns, q)

        raw = [(item.segment, item) for item in message.items if isinstance(item, Tracker)]
        for record, item in self._dated(raw, message, modules, chunk):
            number = record.counter(InertialSample.KIND).count_unwrapped(counted, losses)
            if number is not None:
                field = scaled(item.field, self.settings.field_ut) if any(item.field) else NOT_READ
                measured = item.specific_force, item.angular_rate, field
                yield Sample(record.module, number, self._time_ns, measured)

    def _dated(
        self, readings: Sequence[tuple[int, _Reading]], message: Datagram, modules: ModuleTable, chunk: Chunk
    ) -> Iterable[tuple[ModuleRecord, _Reading]]:
        """Return the readings of segments with their modules' records; ``_time_ns`` is then the instant."""
        if not readings:
            return ()
        readings = sorted(
            readings, key=lambda each: -each[0]
        )  # the pelvis last: it is whom fused frames wait for
        ids = [self.settings.module + segment for segment, _ in readings]
        self._reporting.update(ids)
        self._leader = ids[0] if self._leader is None else self._leader
        stamp_us = message.time_ms * 1000 % 2**32
        records, self._time_ns = modules.timed_together(ids, self._leader, stamp_us, chunk)
        return zip(records, (each for _, each in readings), strict=True)


class MvnSource(MakersSource):
    """All streams of MVN."""

    carries = "mvn"
    settings = MvnLinkSettings
    device = MvnDevice


def _chained(joints: Sequence[JointRotation]) -> dict[int, Quaternion]:
    """Return orientations of segments by number, the pelvis level and facing east; empty without joints."""
    found = {_PELVIS: _UPRIGHT} if joints else {}  # in axes of the ISB
    for joint in joints:
        if joint.parent in found and joint.child <= len(SEGMENTS) and joint.child not in found:
            x, y, z = map(math.radians, joint.angles)
            found[joint.child] = multiply(found[joint.parent], in_turn(("z", z), ("x", x), ("y", y)))
    return {segment: multiply(q_wb, TO_ISB[segment - 1]) for segment, q_wb in found.items()}
