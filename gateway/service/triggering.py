"""Unified control at run time: broadcasts the sampling trigger over every link.

The I/O shell of ``clocks.trigger``. What becomes of the answers is the stream's to find out.
"""

from __future__ import annotations

import asyncio
import logging
import queue
import threading
import time
from collections.abc import Callable, Sequence

from devices.link import Link, gateway_time_ns
from firmware_protocol import BROADCAST, SamplingTrigger, wire_frame
from gateway.clocks import Trigger, TriggerAnswers, TriggerTimer
from gateway.service.host_sender import HostSender

log = logging.getLogger(__name__)

_PROMPT_NS = 2_000_000
"""A write that takes longer leaves open when the trigger left: its answers are worth nothing."""
_LOOK_INTERVAL_NS = 1_000_000_000
_LONGEST_NAP_S = 0.25
"""So that the thread notices that it is no longer wanted."""


class Triggerer:
    """Tells modules when to sample; belongs to one event loop."""

    name = "triggerer"

    def __init__(
        self,
        links: Sequence[Link],
        sender: HostSender,
        answers: TriggerAnswers,
        rate_hz: float,
    ) -> None:
        """Trigger over ``links`` at ``rate_hz``; the list may grow while this runs."""
        self.timer = TriggerTimer(1e9 / rate_hz)
        self._links = links
        self._sender = sender
        self._answers = answers
        self._sending: dict[str, asyncio.Task[None]] = {}
        self._warned: set[int] = set()
        self._looked_ns = 0

    async def run(self) -> None:
        """Trigger for ever."""
        alarm = PreciseAlarm(gateway_time_ns)
        self.timer.start(gateway_time_ns())
        try:
            while True:
                next_ns = self.timer.next_ns
                assert next_ns is not None
                await alarm.wait_until(next_ns)
                trigger = self.timer.due(gateway_time_ns())
                if trigger is not None:
                    self._broadcast(trigger)
                    self._warn_of_stragglers()
        finally:
            alarm.close()
            for sending in self._sending.values():
                sending.cancel()

    def statistics(self) -> dict[str, object]:
        """Return the timer's figures, for the health message."""
        return {"trigger_timer": self.timer.figures.summary()}

    def _broadcast(self, trigger: Trigger) -> None:
        """Send a trigger over all links at once, except those whose previous write has not returned."""
        for link in self._links:
            before = self._sending.get(link.name)
            # Waiting for a blocked link would delay the trigger on every other link.
            if before is not None and not before.done():
                self.timer.figures.unsent += 1
                continue
            self._sending[link.name] = asyncio.create_task(self._send(link, trigger))

    async def _send(self, link: Link, trigger: Trigger) -> None:
        time_us = trigger.planned_ns // 1000 % 2**32
        frame = wire_frame(SamplingTrigger(trigger.number), BROADCAST, trigger.number, time_us)
        sent = await self._sender.send(link, frame, within_ns=_PROMPT_NS)
        if sent is None:
            self.timer.figures.unsent += 1
        else:
            self.timer.sent(trigger, sent.sent_ns)

    def _warn_of_stragglers(self) -> None:
        """Warn once of each module that does not follow the triggers."""
        now_ns = gateway_time_ns()
        if now_ns - self._looked_ns < _LOOK_INTERVAL_NS:
            return
        self._looked_ns = now_ns
        for module in sorted(set(self._answers.figures.untriggered) - self._warned):
            self._warned.add(module)
            log.warning(
                "module %d samples on its own timer, not on the gateway's trigger: its instants are "
                "estimated from arrival times; set it with: mocap-gateway modules set %d mode=3",
                module,
                module,
            )


class PreciseAlarm:
    """Wakes one event loop at an instant, far more precisely than its own timers do; ``close`` it in the end.

    The timers of the default event loop are as coarse as a millisecond. A thread that sleeps is woken within
    some tens of microseconds, and hands over at once; what the loop is busy with comes on top.
    """

    def __init__(self, clock_ns: Callable[[], int] = gateway_time_ns) -> None:
        self._clock_ns = clock_ns
        self._loop = asyncio.get_running_loop()
        self._wanted: queue.SimpleQueue[tuple[int, asyncio.Event] | None] = queue.SimpleQueue()
        self._is_closed = False
        threading.Thread(target=self._wait_for_alarms, name="precise alarm", daemon=True).start()

    async def wait_until(self, instant_ns: int) -> None:
        """Sleep until a gateway time; one that has passed only gives way to other tasks."""
        if instant_ns <= self._clock_ns():
            await asyncio.sleep(0)
            return
        reached = asyncio.Event()
        self._wanted.put((instant_ns, reached))
        await reached.wait()

    def close(self) -> None:
        """End the thread; who still waits is not woken."""
        self._is_closed = True
        self._wanted.put(None)

    def _wait_for_alarms(self) -> None:
        while (wanted := self._wanted.get()) is not None:
            instant_ns, reached = wanted
            while not self._is_closed and (left_ns := instant_ns - self._clock_ns()) > 0:
                time.sleep(min(left_ns * 1e-9, _LONGEST_NAP_S))
            if self._is_closed or self._loop.is_closed():
                return
            self._loop.call_soon_threadsafe(reached.set)
