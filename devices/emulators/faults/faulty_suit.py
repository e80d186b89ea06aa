"""An emulated suit with faults: what ``FaultPlan`` says befalls its modules, its sensors and its link.

    suit = EmulatedSuit(FaultySuit(traffic, plan), PtyTransport("/tmp/suit"))
    cable = asyncio.create_task(pull_cable(plan, suit))

``LinkFaults`` (what becomes of transmissions) and ``SensorFaults`` (samples that are stuck, saturated, near a
magnet, not a number) are sans-I/O, seeded, whatever the steps of time.
"""

from __future__ import annotations

import asyncio
import heapq
import math
import struct
from collections import Counter, defaultdict
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np

from devices.emulators.delivery import Transmission
from devices.emulators.device.emulated_device import EmulatedDevice
from devices.emulators.device.sender import Timed
from devices.emulators.emulated_suit import EmulatedSuit
from devices.emulators.faults.fault_plan import (
    BitErrors,
    Burst,
    ClockJump,
    Duplication,
    Fault,
    FaultPlan,
    FaultWindows,
    IdConflict,
    Loss,
    Magnet,
    Noise,
    NotFinite,
    Reordering,
    Reset,
    Saturated,
    SlowDrip,
    Stall,
    Stuck,
    Unplug,
)
from devices.emulators.suit_traffic import SuitTraffic
from devices.link import Framing, gateway_time_ns
from firmware_protocol import (
    CanFrame,
    InertialSample,
    InertialSampleFine,
    LocalMeasurement,
    Vector3,
    WireFrame,
    decode_body,
    encode_packet,
    pack_can_records,
    unpack_can_records,
)

_NOISE_STEP_S = 0.05
_FOREIGN_IDENTIFIER = 0x001
_OnLink = BitErrors | Loss | Duplication | Reordering | Burst | Stall | SlowDrip
_PURPOSE = 11  # random streams of their own, whatever else the seed serves


class LinkFaults:
    """Transmissions in, transmissions out, in order of arrival."""

    def __init__(self, plan: FaultPlan, framing: Framing) -> None:
        self.counts: Counter[str] = Counter()
        """Transmissions that befell something, by kind of fault; ``noise`` in bytes."""
        self._faults = FaultWindows(fault for fault in plan.faults if isinstance(fault, _OnLink))
        noise = [fault for fault in plan.faults if isinstance(fault, Noise)]
        self._noise = FaultWindows(noise)
        self._has_noise = bool(noise)
        self._framing = framing
        self._rng = np.random.default_rng([plan.seed, _PURPOSE])
        self._noise_rng = np.random.default_rng([plan.seed, _PURPOSE, 1])
        self._under_way: list[tuple[float, int, Transmission]] = []
        self._order = 0
        self._drip_free_s = 0.0
        self._noise_due_s = 0.0

    def pass_on(self, sent: Iterable[Transmission], to_s: float) -> list[Transmission]:
        """Return what arrives before ``to_s``, of this and of what was held back."""
        for transmission in sent:
            self._take(transmission)
        while self._has_noise and self._noise_due_s < to_s:
            self._babble(self._noise_due_s)
            self._noise_due_s += _NOISE_STEP_S
        return self._arrived(to_s)

    def rest(self, sent: Iterable[Transmission]) -> list[Transmission]:
        """Return all that is still under way, and this."""
        for transmission in sent:
            self._take(transmission)
        return self._arrived(float("inf"))

    def _take(self, sent: Transmission) -> None:
        arrivals = [sent]
        for fault in self._faults.on(sent.time_s):
            arrivals = [after for one in arrivals for after in self._befall(fault, one)]
        for one in arrivals:
            self._put(one)

    def _befall(self, fault: _OnLink, sent: Transmission) -> list[Transmission]:
        match fault:
            case Stall():
                arrivals = []
            case Burst():
                arrivals = [sent._replace(time_s=self._end(fault, sent.time_s))]
            case SlowDrip():
                arrivals = self._drip(fault, sent)
            case Loss() if self._strikes(fault.share):
                arrivals = []
            case Duplication() if self._strikes(fault.share):
                arrivals = [sent, sent]
            case Reordering() if self._strikes(fault.share):
                arrivals = [sent._replace(time_s=sent.time_s + fault.delay)]
            case BitErrors() if self._strikes(fault.share):
                arrivals = [sent._replace(data=self._turned(sent.data))]
            # Chance spared this transmission, so it is not counted.
            case _:
                return [sent]
        self.counts[fault.kind] += 1
        return arrivals

    def _strikes(self, share: float) -> bool:
        return bool(self._rng.random() < share)

    def _end(self, fault: Fault, at_s: float) -> float:
        since = at_s - fault.at
        if fault.every is not None:
            since %= fault.every
        return at_s - since + fault.lasts

    def _drip(self, fault: SlowDrip, sent: Transmission) -> list[Transmission]:
        """Byte by byte on a byte stream, CAN frames whole; the rest comes in one piece as the fault ends."""
        end_s = max(self._end(fault, sent.time_s), sent.time_s)
        length = 1 if self._framing is Framing.BYTE_STREAM else len(sent.data)
        at_s = max(self._drip_free_s, sent.time_s)
        dripping, done = [], 0
        while done < len(sent.data):
            at_s += length / fault.bytes_per_s
            if at_s >= end_s:
                at_s, length = end_s, len(sent.data) - done
            dripping.append(Transmission(at_s, sent.data[done : done + length], sent.device))
            done += length
        self._drip_free_s = at_s
        return dripping

    def _turned(self, data: bytes) -> bytes:
        """Flip one bit: of the data of a CAN frame, not of the record around it."""
        if self._framing is Framing.CAN:
            frames = unpack_can_records(data)
            place = int(self._rng.integers(len(frames)))
            frame = frames[place]
            if frame.data:
                changed = self._turned_bit(frame.data)
                frames[place] = replace(frame, data=changed)
            return pack_can_records(frames)
        return self._turned_bit(data)

    def _turned_bit(self, data: bytes) -> bytes:
        bit = int(self._rng.integers(8 * len(data)))
        changed = bytearray(data)
        changed[bit // 8] ^= 1 << bit % 8
        return bytes(changed)

    def _babble(self, at_s: float) -> None:
        for fault in self._noise.on(at_s):
            data = self._noise_rng.bytes(max(1, round(fault.bytes_per_s * _NOISE_STEP_S)))
            self.counts["noise"] += len(data)
            if self._framing is Framing.CAN:
                data = pack_can_records(
                    CanFrame(_FOREIGN_IDENTIFIER, data[i : i + 8], False) for i in range(0, len(data), 8)
                )
            self._put(Transmission(at_s, data))

    def _put(self, sent: Transmission) -> None:
        heapq.heappush(self._under_way, (sent.time_s, self._order, sent))
        self._order += 1

    def _arrived(self, to_s: float) -> list[Transmission]:
        arrived = []
        while self._under_way and self._under_way[0][0] < to_s:
            arrived.append(heapq.heappop(self._under_way)[2])
        return arrived


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


_LOOK_S = 0.002


class FaultySuit:
    """A ``Conversation``: the traffic of a suit, as its faults leave it."""

    def __init__(self, traffic: SuitTraffic, plan: FaultPlan) -> None:
        """Join suit and faults.

        Raises ``KeyError``, naming what there is, for a module that the suit lacks.
        """
        self.traffic = traffic
        self.plan = plan
        self.link = LinkFaults(plan, traffic.framing)
        self.sensors = SensorFaults(plan)
        traffic.on_sent = self.sensors.spoil
        self._counts: Counter[str] = Counter()
        self._module_faults = FaultWindows(
            fault for fault in plan.faults if isinstance(fault, Reset | ClockJump | IdConflict)
        )
        self._deafening = FaultWindows(plan.windows(Stall, Unplug))
        """What the host says then does not arrive."""
        # Asked for now: a module that is not there is a mistake in the plan, to be reported at once.
        for fault in plan.faults:
            if (module := getattr(fault, "module", None)) is not None:
                traffic.device(module)
        self._now_s = 0.0

    @property
    def counts(self) -> Counter[str]:
        """What befell the suit, by kind of fault."""
        return self._counts + self.link.counts + self.sensors.counts

    @property
    def reached_s(self) -> float:
        """Motion time up to which it has been asked; behind the clock where the machine is too busy."""
        return self._now_s

    def receive(self, data: bytes, at_s: float, device: int | None = None) -> None:
        """Take bytes as ``SuitTraffic.receive`` does, unless a fault keeps the suit from hearing."""
        if not self._deafening.on(at_s):
            self.traffic.receive(data, at_s, device)

    def advance(self, to_s: float) -> list[Transmission]:
        """Begin the faults that are due, and return what arrives until ``to_s``, s."""
        for start_s, fault in self._module_faults.starting(self._now_s, to_s):
            self._begin(fault, start_s)
        self._now_s = to_s
        return self.link.pass_on(self.traffic.advance(to_s), to_s)

    def rest(self) -> list[Transmission]:
        """Return what is still under way, as ``SuitTraffic.rest`` does."""
        return self.link.rest(self.traffic.rest())

    def _begin(self, fault: Reset | ClockJump | IdConflict, at_s: float) -> None:
        self._counts[fault.kind] += 1
        device = self.traffic.device(fault.module)
        match fault:
            case Reset():
                self.traffic.cut_power(fault.module, at_s, fault.lasts)
            case ClockJump():
                device.happen(at_s, lambda: _jump(device, fault.by))
            case IdConflict():
                own = device.module_id
                device.happen(at_s, lambda: _call(device, fault.takes))
                device.happen(at_s + fault.lasts, lambda: _call(device, own))


def _jump(device: EmulatedDevice, by_s: float) -> None:
    clock = device.sender.clock
    device.sender.clock = replace(clock, start_us=(clock.start_us + round(by_s * 1e6)) % 2**32)


def _call(device: EmulatedDevice, module: int) -> None:
    device.sender.module = module


async def pull_cable(plan: FaultPlan, suit: EmulatedSuit) -> None:
    """Pull and plug in the cable of a running suit as the plan says; ends after the last time."""
    pulls = plan.windows(Unplug)
    windows = FaultWindows(pulls)
    last_s = max((math.inf if pull.every else pull.at for pull in pulls), default=-1.0)
    looked_s = 0.0
    while looked_s <= last_s:
        now_s = 0.0 if suit.start_ns is None else suit.motion_time_s(gateway_time_ns())
        for start_s, pull in windows.starting(looked_s, max(now_s, looked_s)):
            await suit.transport.close()
            away_s = start_s + pull.lasts - suit.motion_time_s(gateway_time_ns())
            await asyncio.sleep(max(0.0, away_s))
            await suit.transport.open()
        looked_s = max(now_s, looked_s)
        await asyncio.sleep(_LOOK_S)
