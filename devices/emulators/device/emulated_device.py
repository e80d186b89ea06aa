"""A device of the suit as its firmware runs it: boots, reports, listens, obeys, loses power. Sans-I/O.

All that happens to a device happens at a true time, in order: packets that it receives, its own answers
falling due, its power going and coming. Between two such moments it samples and reports on its own.
"""

from __future__ import annotations

import contextlib
import heapq
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from devices.emulators.bodies import FloatArray
from devices.emulators.device.command_responder import CommandResponder
from devices.emulators.device.emulated_card import EmulatedCard
from devices.emulators.device.emulated_flash import (
    KEYS,
    OFF_S,
    EmulatedFlash,
    Moment,
    PowerCut,
    PowerLost,
    StoredSettings,
)
from devices.emulators.device.sampling import TRIGGERED, SampleSettings, Sampling, SamplingTimer, Trigger
from devices.emulators.device.sender import Sender, Timed
from devices.emulators.device.status_reports import StatusReports, device_info
from devices.emulators.imperfections import ModuleClock
from devices.emulators.sensing.disturbances import Disturbance
from firmware_protocol import (
    BROADCAST,
    Command,
    DeviceInfo,
    Event,
    Packet,
    ReceivedPacket,
    SamplingTrigger,
    SyncRequest,
    SyncResponse,
)
from firmware_protocol.commands import BROADCAST_ANSWER_DELAY_US
from firmware_protocol.messages import ANYONE, DEVICE_INFO_INTERVAL_S

STARTED_FROM_FACTORY_SETTINGS = 8
"""Event of a device that found no settings in its flash."""

FROM_OUTSIDE = 0
"""In the place of a boot: happens whatever became of the firmware since."""

_SYNC_TURNAROUND_S = 0.0002
_ANSWER_S = 0.0005
_FOLLOW_S = 0.0005
_FIRST_EVENT_S = 0.001


@dataclass(order=True, frozen=True, slots=True)
class Happening:
    """Something to be done at a true time; at one moment, in the order in which it was foreseen."""

    at_s: float
    order: int
    act: Callable[[], None] = field(compare=False)
    boot: int = field(compare=False)
    """Which run of the firmware means to do it; void when the device has started again since."""


class Timeline:
    """What is to happen to one device, taken in order of time."""

    def __init__(self) -> None:
        self._waiting: list[Happening] = []
        self._order = 0

    def add(self, at_s: float, act: Callable[[], None], boot: int = FROM_OUTSIDE) -> None:
        """Add something that is to happen."""
        heapq.heappush(self._waiting, Happening(at_s, self._order, act, boot))
        self._order += 1

    def next_before(self, to_s: float) -> Happening | None:
        """Take the next one that lies before a true time, s."""
        if not self._waiting or self._waiting[0].at_s >= to_s:
            return None
        return heapq.heappop(self._waiting)


@dataclass(frozen=True)
class Equipment:
    """What a device is made of."""

    number: int
    """Which device of the suit this is, whatever id it sends under."""
    unique_id: bytes
    """12 bytes."""
    sensors: tuple[str, ...] = ()
    fixed_id: int | None = None
    """Id that no setting changes (a relay's)."""
    info_interval_s: float = DEVICE_INFO_INTERVAL_S
    health_interval_s: float = 1.0


class EmulatedDevice:
    """One device: commands, clock, settings, power. What it senses is found out elsewhere."""

    fixed_settings: frozenset[int] = frozenset()

    settings: StoredSettings
    sender: Sender
    _responder: CommandResponder
    _reports: StatusReports
    _timer: SamplingTimer
    _sample_settings: SampleSettings
    _is_sampling: bool
    _blinks_until_s: float
    _newest_trigger: int | None
    """Since it samples on triggers."""

    def __init__(self, equipment: Equipment, clock: ModuleClock, flash: EmulatedFlash) -> None:
        """Switched on at true time 0, with what the flash holds."""
        self.equipment = equipment
        self.unique_id = equipment.unique_id
        self.flash = flash
        self.is_locked = False
        """Commands that change the device are refused."""
        self.card: EmulatedCard | None = None
        self.power_cut: PowerCut | None = None
        """The command at which it will lose power."""
        self.disturbances: list[Disturbance] = []
        """What its sensors feel besides the body's motion."""
        self.is_on = True
        self.boots = 0
        """How often it was switched on."""
        self.outages: list[tuple[float, float]] = []
        """True times from which and until which it was without power, s."""
        self._timeline = Timeline()
        self._now_s = 0.0
        self._frames: list[Timed] = []
        self._samplings: list[Sampling] = []
        self._stream = 0
        self._boot(clock)

    @property
    def number(self) -> int:
        """Which device of the suit this is."""
        return self.equipment.number

    @property
    def module_id(self) -> int:
        """The id it sends under."""
        return self.sender.module

    def is_blinking(self, at_s: float) -> bool:
        """Return whether its light blinks at a true time not before the last ``advance``, s."""
        return self.is_on and at_s < self._blinks_until_s

    def receive(self, at_s: float, received: ReceivedPacket) -> None:
        """Let a packet from the host reach the device at a true time, s.

        When that time has passed already, it is obeyed late, but clocks are reported, and samples triggered,
        as of then.
        """
        self.happen(at_s, lambda: self._take(received, at_s))

    def happen(self, at_s: float, act: Callable[[], None]) -> None:
        """Do something to the device at a true time (s), or now if that has passed."""
        self._timeline.add(max(at_s, self._now_s), act, FROM_OUTSIDE)

    def lose_power(self, off_s: float = OFF_S) -> None:
        """Switch off now, and on after ``off_s``: the clock begins anew, the settings are the flash's."""
        if self.is_on:
            self.is_on = False
            back_s = self._now_s + off_s
            self.outages.append((self._now_s, back_s))
            clock = self.sender.clock.restarted(back_s)
            self.happen(back_s, lambda: self._boot(clock))

    def report_event(self, event: int, value: int = 0) -> None:
        """Send an Event now, if it is on."""
        if self.is_on:
            self._send(Event(event, value))

    def advance(self, to_s: float) -> tuple[list[Timed], list[Sampling]]:
        """Return what it sends and what it samples from the last call's time until ``to_s``, true time, s."""
        while (happening := self._timeline.next_before(to_s)) is not None:
            self._pass_time(happening.at_s)
            # What was planned before a loss of power must not happen after it: the device has forgotten it.
            if happening.boot == FROM_OUTSIDE or (self.is_on and happening.boot == self.boots):
                try:
                    happening.act()
                except PowerLost:
                    self.lose_power()
        self._pass_time(to_s)
        sent, sampled = self._frames, self._samplings
        self._frames, self._samplings = [], []
        return sent, sampled

    def planned(self, to_s: float) -> FloatArray:
        """Return the true times (n,) at which it will sample before ``to_s`` if nothing is changed."""
        return self.sender.clock.true_time(self._timer.ahead(to_s)) if self.is_on else np.empty(0)

    # What commands act on.

    def start(self) -> None:
        """Sample, by the timer or on triggers as the mode says."""
        if not self._is_sampling:
            self._is_sampling = True
            self._restart_timer()

    def stop(self) -> None:
        """Sample no more."""
        self._is_sampling = False
        self._restart_timer()

    def blink(self, seconds: int) -> None:
        """Blink from now on; 0 stops it."""
        self._blinks_until_s = self._now_s + seconds

    def adopt(self, values: Mapping[str, Any]) -> None:
        """Keep settings by name and act by them, as a command of another maker has it."""
        for name, value in values.items():
            self.settings.stage(KEYS[name], value)
        self.settings.commit()
        self.act_by_settings()

    def introduction(self) -> tuple[Packet, ...]:
        """Return the packets that say who the device is and how it fares."""
        return self._reports.info, self._reports.health(self._elapsed)

    def act_by_settings(self) -> None:
        """Take on the id, the rate, the mode and all else of the settings, which have changed."""
        before, self._sample_settings = self._sample_settings, SampleSettings.of(self.settings)
        self.sender = Sender(self._stored_id(), self.sender.clock, self.sender.sequences)
        self._reports.sender, self._reports.info = self.sender, self._info()
        if before[:2] != self._sample_settings[:2]:  # mode and rate
            self._stream += before.mode != self._sample_settings.mode
            self._newest_trigger = None
            self._restart_timer()

    # The firmware.

    @property
    def _elapsed(self) -> float:
        return self.sender.clock.elapsed(self._now_s)

    def _boot(self, clock: ModuleClock) -> None:
        self.is_on = True
        self.boots += 1
        self.settings = StoredSettings(self.flash)
        self.sender = Sender(self._stored_id(), clock)
        self._responder = CommandResponder(self)
        self._sample_settings = SampleSettings.of(self.settings)
        self._is_sampling = True
        # Samples planned before a boot belong to another stream.
        self._stream += 1
        self._newest_trigger = None
        self._blinks_until_s = -np.inf
        self._timer = SamplingTimer(clock)
        if self._sample_settings.mode != TRIGGERED:
            self._timer.run(self._sample_settings.rate_hz, clock.phase_s)
        self._reports = StatusReports(
            self.sender,
            self._timer,
            self._info(),
            self.equipment.info_interval_s,
            self.equipment.health_interval_s,
            # The first start is no reset.
            resets=self.boots - 1,
        )
        if self.settings.is_factory:
            self._send(Event(STARTED_FROM_FACTORY_SETTINGS), _FIRST_EVENT_S)

    def _pass_time(self, to_s: float) -> None:
        if self.is_on:
            self._work_until(to_s)
        self._now_s = to_s

    def _work_until(self, to_s: float) -> None:
        """Do what it does on its own until a true time, s."""
        self._frames += self._reports.until(to_s)
        if len(instants := self._timer.until(to_s)):
            self._sample(instants)

    def _sample(self, instants: FloatArray, trigger: Trigger | None = None) -> None:
        self._samplings.append(
            Sampling(self.number, self.sender, instants, self._sample_settings, self._stream, trigger)
        )

    def _restart_timer(self) -> None:
        self._timer.stop(self._elapsed)
        if self._is_sampling and self._sample_settings.mode != TRIGGERED:
            rate_hz = self._sample_settings.rate_hz
            self._timer.run(rate_hz, self._elapsed + 1.0 / rate_hz)

    def _stored_id(self) -> int:
        fixed = self.equipment.fixed_id
        return int(self.settings["module_id"]) if fixed is None else fixed

    def _info(self) -> DeviceInfo:
        samples = self._sample_settings
        return device_info(self.unique_id, samples.rate_hz, self.equipment.sensors, samples.ranges)

    def _take(self, received: ReceivedPacket, came_s: float) -> None:
        packet, is_for_all = received.packet, received.module == BROADCAST
        is_addressed = is_for_all or received.module == self.module_id
        if not self.is_on:
            return
        if isinstance(packet, Command):
            # A unique id decides alone: two devices may share the module id.
            is_meant = is_addressed if packet.unique_id == ANYONE else packet.unique_id == self.unique_id
            if is_meant:
                self._obey(packet, is_for_all and packet.unique_id == ANYONE)
        elif is_addressed and isinstance(packet, SyncRequest):
            self._report_clock(packet.token, came_s, is_for_all)
        elif is_addressed and isinstance(packet, SamplingTrigger):
            self._follow_trigger(packet.number, came_s)

    def _obey(self, command: Command, is_for_all: bool) -> None:
        cut = self.power_cut
        if cut is not None and cut.strikes(command.verb):
            self._obey_and_die(command, cut)
            return
        answers = self._responder.answer(command)
        delay_s = _ANSWER_S + self._turn_s(is_for_all)
        for place, packet in enumerate(answers):
            self._send(packet, delay_s + place * _FOLLOW_S)

    def _obey_and_die(self, command: Command, cut: PowerCut) -> None:
        self.power_cut = None
        if cut.moment is Moment.IN_FLASH:
            self.flash.cut_power_after(cut.flash_step)
        if cut.moment is not Moment.BEFORE:
            with contextlib.suppress(PowerLost):
                self._responder.answer(command)
        self.flash.cut_power_after(None)
        self.lose_power(cut.off_s)

    def _report_clock(self, token: int, came_s: float, is_for_all: bool) -> None:
        clock = self.sender.clock
        received_us = clock.count_us(clock.elapsed(came_s))

        def respond() -> None:
            sent_us = clock.count_us(self._elapsed)
            self._frames.append(self.sender.packet(SyncResponse(token, received_us, sent_us), self._elapsed))

        self._timeline.add(self._now_s + _SYNC_TURNAROUND_S + self._turn_s(is_for_all), respond, self.boots)

    def _follow_trigger(self, number: int, came_s: float) -> None:
        is_new = number != self._newest_trigger  # a radio may repeat it
        if self._is_sampling and self._sample_settings.mode == TRIGGERED and is_new:
            self._newest_trigger = number
            self._timer.count_one()
            self._sample(np.array([self.sender.clock.elapsed(came_s)]), Trigger(number, self._now_s))

    def _turn_s(self, is_for_all: bool) -> float:
        """Return how long to wait so that the answers of all devices do not collide, s."""
        return self.module_id * BROADCAST_ANSWER_DELAY_US * 1e-6 if is_for_all else 0.0

    def _send(self, packet: Packet, delay_s: float = 0.0) -> None:
        """Send a packet after a while, if the power lasts."""
        self._timeline.add(
            self._now_s + delay_s,
            lambda: self._frames.append(self.sender.packet(packet, self._elapsed)),
            self.boots,
        )
