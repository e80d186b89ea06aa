"""What becomes of transmissions on a faulty link. Sans-I/O, seeded, whatever the steps of time."""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from devices.emulators.delivery import Transmission
from devices.emulators.fault_plan import (
    BitErrors,
    Burst,
    Duplication,
    Fault,
    FaultPlan,
    Loss,
    Noise,
    Reordering,
    SlowDrip,
    Stall,
)
from devices.emulators.fault_windows import FaultWindows
from devices.link import Framing
from firmware_protocol import CanFrame, pack_can_records, unpack_can_records

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
