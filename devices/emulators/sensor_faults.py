"""Samples of broken or disturbed sensors: stuck, saturated, near a magnet, not a number. Sans-I/O."""

from __future__ import annotations

import math
import struct
from collections import Counter
from dataclasses import replace
from typing import Any

from devices.emulators.fault_plan import FaultPlan, Magnet, NotFinite, Saturated, Stuck
from devices.emulators.sender import Timed
from firmware_protocol import (
    InertialSample,
    InertialSampleFine,
    LocalMeasurement,
    WireFrame,
    decode_body,
    encode_packet,
)

_BEYOND = 1e6
"""More than any range, whatever the unit: sent as the end of the range, and marked clipped."""


class SensorFaults:
    """Rewrites what faulty sensors say, before it is sent."""

    def __init__(self, plan: FaultPlan) -> None:
        self.counts: Counter[str] = Counter()
        """Samples changed, by kind of fault."""
        self._faults = [
            fault for fault in plan.faults if isinstance(fault, Stuck | Saturated | Magnet | NotFinite)
        ]
        self._held: dict[int, Any] = {}  # what a stuck sensor says, by place of the fault

    def spoil(self, device: int, sent: list[Timed]) -> list[Timed]:
        """The wire frames of a device, some of them changed."""
        for place, fault in enumerate(self._faults):
            if fault.module == device:
                sent = [self._spoil_one(place, fault, timed) for timed in sent]
        return sent

    def _spoil_one(self, place: int, fault: Stuck | Saturated | Magnet | NotFinite, timed: Timed) -> Timed:
        if not fault.is_on(timed.time_s):
            self._held.pop(place, None)
            return timed
        packet = decode_body(timed.frame.kind, timed.frame.body)
        if isinstance(fault, NotFinite):
            return self._not_finite(timed) if isinstance(packet, LocalMeasurement) else timed
        if not isinstance(packet, InertialSample | InertialSampleFine):
            return timed
        sensor = "magnetic_field" if isinstance(fault, Magnet) else fault.sensor
        value = getattr(packet, sensor)
        if value is None:
            return timed
        if isinstance(fault, Magnet):
            added = fault.at_module(timed.time_s)
            value = tuple(own + more for own, more in zip(value, added, strict=True))
        elif isinstance(fault, Saturated):
            value = tuple(math.copysign(_BEYOND, axis) for axis in value)
        else:
            value = self._held.setdefault(place, value)
        self.counts[fault.kind] += 1
        changes: dict[str, Any] = {sensor: value}
        return _with_body(timed, encode_packet(replace(packet, **changes)))

    def _not_finite(self, timed: Timed) -> Timed:
        self.counts["not_finite"] += 1
        body = bytearray(timed.frame.body)
        struct.pack_into("<f", body, 1, math.nan)  # the first axis, after the quantity
        return _with_body(timed, bytes(body))


def _with_body(timed: Timed, body: bytes) -> Timed:
    frame = timed.frame
    changed = WireFrame(frame.kind, frame.module, frame.sequence, frame.module_time_us, body)
    return timed._replace(frame=changed)
