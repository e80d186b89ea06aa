"""All that passes between an emulated suit and its host, in order of time. Sans-I/O, deterministic.

    traffic.receive(data, at_s=1.23)  # what the host sends
    for transmission in traffic.advance(to_s=2.0): ...  # what the suit sends

Time may be cut into steps of any length: the same bytes at the same times give the same answers. Short
steps make a suit that answers promptly; the motion is evaluated ahead in blocks all the same.
"""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from operator import attrgetter

import numpy as np

from devices.emulators.bodies import FloatArray
from devices.emulators.delivery import (
    Broadcaster,
    Delivery,
    FromHost,
    PacketFaults,
    RadioToDevice,
    Transmission,
)
from devices.emulators.device.emulated_device import EmulatedDevice
from devices.emulators.device.emulated_flash import OFF_S
from devices.emulators.device.relay_device import RelayDevice
from devices.emulators.device.sampling import Sampling
from devices.emulators.device.sender import Sender, Timed
from devices.emulators.imperfections import IDEAL, Imperfections
from devices.emulators.makers.vendor_emulator import VendorEmulator
from devices.emulators.motion.motions import BodyMotion
from devices.emulators.sensing.disturbances import Shake, Tap
from devices.emulators.sensing.local_sampler import LocalSampler
from devices.emulators.suit_settings import AIR, HOST, RADIO, UPLINK, SuitParts, SuitSettings
from devices.link import Framing
from firmware_protocol import RELAY, SamplingTrigger

__all__ = ["SuitSettings", "SuitTraffic"]

BUTTON, TAP, DOUBLE_TAP, SHAKE = 1, 2, 3, 4
"""Events that a device reports."""

# Much longer than the steps of a prompt suit, short enough to be evaluated between two of them.
_LOOK_AHEAD_S = 0.1
_TAP_INTERVAL_S = 0.25
_TAP_DETECTION_S = 0.03
_SHAKE_DETECTION_S = 0.5
_ANSWERS_AFTER_S = 0.002


class SuitTraffic:
    """A whole suit on one link."""

    def __init__(
        self,
        motion: BodyMotion,
        settings: SuitSettings | None = None,
        imperfections: Imperfections = IDEAL,
        seed: int = 0,
    ) -> None:
        """Build the suit. Raises ``ValueError`` when a relay is asked for on a CAN bus."""
        self.settings = settings = settings or SuitSettings()
        if settings.has_relay and settings.encoding.framing is Framing.CAN:
            raise ValueError("a relay on a CAN bus: CAN cannot carry its batches; use a byte stream")
        self.motion = motion
        self.counts: Counter[str] = Counter()
        """Packets sent, lost and duplicated, wire frames corrupted, by those words."""
        self.on_sent: Callable[[int, list[Timed]], list[Timed]] | None = None
        """May change what a device (by number) is about to send."""
        self._now_s = 0.0
        self._pending: list[tuple[float, int, bytes, int]] = []
        self._order = 0
        self._host_absences: list[tuple[float, float]] = []
        self._build(SuitParts(motion, settings, imperfections, seed), imperfections, seed)

    @property
    def framing(self) -> Framing:
        """What the host's bytes are."""
        return self.settings.encoding.framing

    @property
    def senders(self) -> dict[int, Sender]:
        """The sender of every module by number; ``sender.clock`` is the truth for clock estimation."""
        return {number: device.sender for number, device in self.devices.items() if number != RELAY}

    def transmissions(self, duration_s: float | None = None) -> Iterator[Transmission]:
        """Yield everything sent until ``duration_s`` of motion time (None: without end), as it is taken.

        At the end, what is still under way comes too.
        """
        while duration_s is None or self._now_s < duration_s:
            to_s = self._now_s + self.settings.block_s
            yield from self.advance(to_s if duration_s is None else min(to_s, duration_s))
        yield from self.rest()

    def receive(self, data: bytes, at_s: float, device: int | None = None) -> None:
        """Take bytes, or CAN records, from the host, in order of time (motion time, s).

        device: number of the one that they come to, where each has an address of its own; the relay
        passes on to all what comes to it. What should have come before the time that ``advance`` has
        reached comes then.
        """
        # Whatever the host says while it is out of range is lost.
        if any(start_s <= at_s < end_s for start_s, end_s in self._host_absences):
            return
        if not self.emulators:
            self.from_host.receive(data, at_s, None if device == RELAY else device)
        for number in self.emulators if device is None else {device} & self.emulators.keys():
            self.devices[number].happen(at_s, partial(self._answer, number, data, at_s))

    def advance(self, to_s: float) -> list[Transmission]:
        """Return all that arrives between the last call's time and ``to_s`` (motion time, s), in order."""
        for at_s, received, addressee in self.from_host.before(to_s):
            # A trigger is sent once over the air, so all modules hear it at nearly one time.
            on_air_s = self._broadcaster.on_air(at_s) if received.kind == SamplingTrigger.KIND else None
            for number, device in self.devices.items():
                if addressee not in (None, number):
                    continue
                radio = self._to_devices[number]
                arrivals = radio.arrivals(at_s) if on_air_s is None else radio.receptions(on_air_s)
                for arrival_s in arrivals:
                    device.receive(arrival_s, received)

        on_air = [
            (number, self._faults[number].apply(sorted(sent, key=attrgetter("time_s"))))
            for number, sent in self._sent_by_module(to_s).items()
        ]
        if self._relay is not None:
            packets = [timed for _, sent in on_air for timed in sent]
            on_air = [(RELAY, self._relay.forward(packets, to_s))]

        for number, sent in on_air:
            # Numbered, so that transmissions of one instant keep their order in the heap.
            for transmission in self._deliveries[number].deliver(self._in_reach(sent)):
                heapq.heappush(self._pending, (transmission.time_s, self._order, transmission.data, number))
                self._order += 1
        self._now_s = to_s
        return list(self._arrived_before(to_s))

    def rest(self) -> list[Transmission]:
        """Return what is still under way."""
        return list(self._arrived_before(np.inf))

    def device(self, which: int | str | bytes) -> EmulatedDevice:
        """Return a device by number (the relay's is 0xFE), name of its segment or unique id.

        Raises ``KeyError``, naming what there is, when there is none.
        """
        body = self.motion.body
        by_segment: dict[int | str | bytes, int] = dict(
            zip(body.segment_names, body.module_ids.tolist(), strict=True)
        )
        for number, device in self.devices.items():
            if which in (number, device.unique_id) or by_segment.get(which) == number:
                return device
        raise KeyError(f"no device {which!r}; there are {list(self.devices)} on {list(by_segment)}")

    def tap(self, which: int | str | bytes, at_s: float, times: int = 1) -> None:
        """Tap a module once or twice: a burst in its samples, and the event."""
        device, event = self.device(which), TAP if times == 1 else DOUBLE_TAP
        device.disturbances += [Tap(at_s + k * _TAP_INTERVAL_S) for k in range(times)]
        noticed_s = at_s + (times - 1) * _TAP_INTERVAL_S + _TAP_DETECTION_S
        device.happen(noticed_s, lambda: device.report_event(event, times))

    def shake(self, which: int | str | bytes, at_s: float, duration_s: float) -> None:
        """Shake a single module; it says so once it has noticed."""
        device = self.device(which)
        device.disturbances.append(Shake(at_s, duration_s))
        if duration_s > _SHAKE_DETECTION_S:
            device.happen(at_s + _SHAKE_DETECTION_S, lambda: device.report_event(SHAKE))

    def press_button(self, which: int | str | bytes, at_s: float) -> None:
        """Press a device's button: it sends the event."""
        device = self.device(which)
        device.happen(at_s, lambda: device.report_event(BUTTON))

    def cut_power(self, which: int | str | bytes, at_s: float, off_s: float = OFF_S) -> None:
        """Take a device's power away for a while."""
        device = self.device(which)
        device.happen(at_s, lambda: device.lose_power(off_s))

    def lose_host(self, from_s: float, to_s: float) -> None:
        """Put the host out of range for a while: nothing passes, either way."""
        self._host_absences.append((from_s, to_s))

    def _answer(self, number: int, data: bytes, at_s: float) -> None:
        """Have a device of another maker obey, in its own words."""
        device = self.devices[number]
        answer = self.emulators[number].receive(data, device) if device.is_on else b""
        if answer:
            arrives_s = self._deliveries[number].follow(max(at_s, self._now_s) + _ANSWERS_AFTER_S)
            heapq.heappush(self._pending, (arrives_s, self._order, answer, number))
            self._order += 1

    def _arrived_before(self, to_s: float) -> Iterator[Transmission]:
        while self._pending and self._pending[0][0] < to_s:
            time_s, _, data, number = heapq.heappop(self._pending)
            yield Transmission(time_s, data, number)

    def _sent_by_module(self, to_s: float) -> dict[int, list[Timed]]:
        sent, inertial = {}, []
        for number, device in self.devices.items():
            if number == RELAY:
                continue
            sent[number], samplings = device.advance(to_s)
            if number in self._locals:
                for sampling in samplings:
                    planned = device.planned(to_s + _LOOK_AHEAD_S)
                    sent[number] += self._locals[number].sample(sampling, planned)
            else:
                inertial += samplings
        # All modules at once: evaluating the motion for many instants costs little more than for one.
        self._look_ahead(inertial, to_s)
        for sampling, frames in zip(inertial, self._sampler.sample(inertial), strict=True):
            sent[sampling.device] += frames
        if self.on_sent is not None:
            sent = {number: self.on_sent(number, frames) for number, frames in sent.items()}
        return sent

    def _look_ahead(self, samplings: list[Sampling], to_s: float) -> None:
        """Evaluate the motion for the next block, when the last one is used up or plans have changed."""
        timed = [sampling for sampling in samplings if sampling.trigger is None]
        if all(map(self._sampler.is_prepared, timed)):
            return
        planned: dict[int, list[FloatArray]] = {number: [] for number in self._inertial}
        for sampling in timed:
            planned[sampling.device].append(sampling.times)
        # The motion is evaluated for many samples at once, which takes far less time than one by one.
        until_s = max(to_s, self._now_s + _LOOK_AHEAD_S)
        for number, times in planned.items():
            times.append(self.devices[number].planned(until_s))
        self._sampler.prepare({number: np.concatenate(times) for number, times in planned.items()})

    def _in_reach(self, sent: list[Timed]) -> list[Timed]:
        if not self._host_absences:
            return sent
        return [
            timed
            for timed in sent
            if not any(start_s <= timed.time_s < end_s for start_s, end_s in self._host_absences)
        ]

    def _build(self, parts: SuitParts, imperfections: Imperfections, seed: int) -> None:
        settings = self.settings
        modules = parts.modules()
        self._inertial = parts.inertial
        self._sampler = parts.sampler(modules)
        self._locals = {d.module: LocalSampler(self.motion, d, seed) for d in self.motion.body.local_devices}
        self._relay: RelayDevice | None = parts.relay(modules) if settings.has_relay else None
        self.devices: dict[int, EmulatedDevice] = {**modules}
        """All devices by number, the relay as 0xFE."""
        if self._relay is not None:
            self.devices[RELAY] = self._relay
        self.from_host = FromHost(self.framing)
        """What the host has said; its decoder counts what came damaged."""
        self._faults = {i: PacketFaults(imperfections, parts.random(i, RADIO), self.counts) for i in modules}
        make = settings.emulator
        self.emulators: dict[int, VendorEmulator] = (
            {} if make is None else {i: make(i) for i in self._inertial}
        )
        """Of modules that speak as another maker's."""
        self._deliveries = {
            i: Delivery(
                imperfections, self.emulators.get(i, settings.encoding), parts.random(i, HOST), self.counts
            )
            for i in (*modules, RELAY)
        }
        self._broadcaster = Broadcaster(imperfections, parts.random(RELAY, AIR))
        self._to_devices = {i: RadioToDevice(imperfections, parts.random(i, UPLINK)) for i in self.devices}
