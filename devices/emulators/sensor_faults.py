"""Samples of broken or disturbed sensors: stuck, saturated, near a magnet, not a number. Sans-I/O."""

from __future__ import annotations

import math
import struct
from collections import Counter, defaultdict
from dataclasses import replace
from typing import Any

from devices.emulators.device.sender import Timed
from devices.emulators.fault_plan import FaultPlan, Magnet, NotFinite, Saturated, Stuck
from devices.emulators.fault_windows import FaultWindows
from firmware_protocol import (
    InertialSample,
    InertialSampleFine,
    LocalMeasurement,
    Vector3,
    WireFrame,
    decode_body,
    encode_packet,
)

_OfSensor = Stuck | Saturated | Magnet | NotFinite
_BEYOND = 1e6
"""More than any range, whatever the unit: sent as the end of the range, and marked clipped."""


class SensorFaults:
    """Rewrites what faulty sensors say, before it is sent."""

    def __init__(self, plan: FaultPlan) -> None:
        self.counts: Counter[str] = Counter()
        """Samples changed, by kind of fault."""
        faults: dict[int, list[_OfSensor]] = defaultdict(list)
        for fault in plan.faults:
            if isinstance(fault, _OfSensor):
                faults[fault.module].append(fault)
        self._faults = {device: FaultWindows(of_device) for device, of_device in faults.items()}
        self._held: dict[int, tuple[int, Vector3]] = {}
        """By identity of the fault: which time it is that it came, and what the stuck sensor says."""

    def spoil(self, device: int, sent: list[Timed]) -> list[Timed]:
        """Return the wire frames of a device, some of them changed."""
        windows = self._faults.get(device)
        return sent if windows is None else [self._spoil_one(windows, timed) for timed in sent]

    def _spoil_one(self, windows: FaultWindows[_OfSensor], timed: Timed) -> Timed:
        for fault in windows.on(timed.time_s):
            timed = self._befall(fault, timed)
        return timed

    def _befall(self, fault: _OfSensor, timed: Timed) -> Timed:
        packet = decode_body(timed.frame.kind, timed.frame.body)
        if isinstance(fault, NotFinite):
            return self._not_finite(timed) if isinstance(packet, LocalMeasurement) else timed
        if not isinstance(packet, InertialSample | InertialSampleFine):
            return timed
        # A magnet disturbs the magnetometer alone, whatever the plan says.
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
            value = self._held_value(fault, timed.time_s, value)
        self.counts[fault.kind] += 1
        changes: dict[str, Any] = {sensor: value}
        return _with_body(timed, encode_packet(replace(packet, **changes)))

    def _held_value(self, fault: Stuck, at_s: float, value: Vector3) -> Vector3:
        """Return what the sensor said when the fault began, this time."""
        time = 0 if fault.every is None else int((at_s - fault.at) // fault.every)
        if self._held.get(id(fault), (-1, value))[0] != time:
            self._held[id(fault)] = time, value
        return self._held[id(fault)][1]

    def _not_finite(self, timed: Timed) -> Timed:
        self.counts["not_finite"] += 1
        body = bytearray(timed.frame.body)
        struct.pack_into("<f", body, 1, math.nan)  # the first axis, after the quantity
        return _with_body(timed, bytes(body))


def _with_body(timed: Timed, body: bytes) -> Timed:
    frame = timed.frame
    changed = WireFrame(frame.kind, frame.module, frame.sequence, frame.module_time_us, body)
    return timed._replace(frame=changed)
