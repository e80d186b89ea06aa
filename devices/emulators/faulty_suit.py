"""An emulated suit with faults: what ``FaultPlan`` says befalls its modules, its sensors and its link.

suit = EmulatedSuit(FaultySuit(traffic, plan), PtyTransport("/tmp/suit"))
cable = asyncio.create_task(pull_cable(plan, suit))
"""

from __future__ import annotations

import asyncio
import math
from collections import Counter
from dataclasses import replace

from devices.emulators.delivery import Transmission
from devices.emulators.device.emulated_device import EmulatedDevice
from devices.emulators.emulated_suit import EmulatedSuit
from devices.emulators.fault_plan import ClockJump, FaultPlan, IdConflict, Reset, Stall, Unplug
from devices.emulators.fault_windows import FaultWindows
from devices.emulators.link_faults import LinkFaults
from devices.emulators.sensor_faults import SensorFaults
from devices.emulators.suit_traffic import SuitTraffic
from devices.link import gateway_time_ns

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
