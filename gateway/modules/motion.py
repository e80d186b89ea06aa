"""Which module was shaken or tapped: decided sans-I/O from its samples, and listened for.

A module that says itself that it was tapped is believed. Otherwise what counts is how much its specific
force swings, against how much it swung before: a person who is shaking one module moves others too,
and somebody may be walking.
"""

from __future__ import annotations

import asyncio
import math
from collections import deque
from typing import NamedTuple

from devices.link import Chunk, gateway_time_ns
from firmware_protocol import InertialSample, InertialSampleFine, ReceivedPacket
from firmware_protocol.messages import Event
from gateway.errors import GatewayError
from gateway.sources.suit import SuitSource

EVENTS = {1: "button", 2: "tap", 3: "double tap", 4: "shake"}
"""Events of a module that mean: this one."""

WINDOW_S = 0.5
"""Swings are measured over so long."""

DECISION_S = 0.4
"""Time between the first sign and the decision, in which others may show that they moved too."""

LEAST_SWING = 3.0
"""m/s², rms: less is no shaking."""
LEAST_RATIO = 2.5
"""To the module's own swing before."""
LEAST_LEAD = 1.6
"""Of the ratio, to that of the next module."""

_SETTLED_RATIO = 0.8 * LEAST_RATIO
_STILL = 0.5  # m/s²: lower swings from before count as this
_FAMILIAR_S = 1.5  # so long a module must have been watched before anything can be unusual
_MEAN_TAU_S = 1.0
_USUAL_TAU_S = 8.0


class Motion(NamedTuple):
    """A module that was meant."""

    module: int
    sign: str
    """The sign: ``tap``, ``shake``, … of the module itself, or ``motion`` seen in its samples."""


class _Swing:
    """How much one module's specific force swings."""

    def __init__(self) -> None:
        self.peak_ratio = 0.0
        self.is_settling = False
        """Still moving from before: that does not count."""
        self._mean: list[float] | None = None
        self._first_s = self._last_s = 0.0
        self._usual = 0.0
        self._n_usual = 0
        self._window: deque[tuple[float, float]] = deque()
        self._sum = 0.0

    def add(self, force: tuple[float, float, float], now_s: float) -> None:
        """Take in one reading, m/s²."""
        if self._mean is None:
            self._mean, self._first_s, self._last_s = list(force), now_s, now_s
            return
        step_s = min(max(now_s - self._last_s, 0.0), WINDOW_S)
        self._last_s = now_s
        deviation = sum((x - m) ** 2 for x, m in zip(force, self._mean, strict=True))
        gain = -math.expm1(-step_s / _MEAN_TAU_S)
        self._mean = [m + gain * (x - m) for x, m in zip(force, self._mean, strict=True)]
        self._window.append((now_s, deviation))
        self._sum += deviation
        is_familiar = now_s > self._first_s + _FAMILIAR_S
        while self._window[0][0] < now_s - WINDOW_S:
            # Only what has left the window is "before": a shake is not measured against itself.
            leaving = self._window.popleft()[1]
            self._sum -= leaving
            self._learn(leaving, step_s, is_familiar)
        if self.is_settling:
            self.is_settling = self._ratio > _SETTLED_RATIO
        elif is_familiar:
            self.peak_ratio = max(self.peak_ratio, self._ratio)

    def begin_anew(self) -> None:
        """Forget the peak; what moves just now is first to come to rest."""
        self.peak_ratio = 0.0
        self.is_settling = self._ratio > LEAST_RATIO

    @property
    def _ratio(self) -> float:
        """Of the swing to what is usual; 0 for one that is too weak to mean anything."""
        swing = self.swing
        return swing / max(math.sqrt(self._usual), _STILL) if swing > LEAST_SWING else 0.0

    def _learn(self, deviation: float, step_s: float, is_familiar: bool) -> None:
        """Follow the usual deviation: at first the mean of all, later slowly, and hardly at all during a
        shake.
        """
        self._n_usual += 1
        gain = -math.expm1(-step_s / _USUAL_TAU_S)
        if is_familiar:
            # A shake must not become the usual, or the next one would not stand out.
            deviation = min(deviation, 4 * self._usual + _STILL**2)
        else:
            gain = max(gain, 1 / self._n_usual)
        self._usual += gain * (deviation - self._usual)

    @property
    def swing(self) -> float:
        """RMS over the window, m/s²."""
        return math.sqrt(max(self._sum, 0.0) / len(self._window)) if self._window else 0.0


class MotionDetector:
    """Fed with packets of all modules; ``decide`` names the one that was meant."""

    def __init__(self) -> None:
        self._swings: dict[int, _Swing] = {}
        self._events: dict[int, str] = {}
        self._since_s: float | None = None

    def begin_anew(self) -> None:
        """Forget what has moved so far, but not what is usual."""
        self._events.clear()
        self._since_s = None
        for swing in self._swings.values():
            swing.begin_anew()

    def take_sample(self, module: int, sample: InertialSample | InertialSampleFine, now_s: float) -> None:
        """Look at a sample that came at ``now_s``."""
        if sample.specific_force is None:
            return
        swing = self._swings.get(module)
        if swing is None:
            swing = self._swings[module] = _Swing()
        swing.add(sample.specific_force, now_s)
        if swing.peak_ratio > LEAST_RATIO and self._since_s is None:
            self._since_s = now_s

    def take_event(self, module: int, event: Event, now_s: float) -> None:
        """Look at an event that came at ``now_s``."""
        swing = self._swings.get(module)
        if event.event in EVENTS and not (swing is not None and swing.is_settling):
            self._events.setdefault(module, EVENTS[event.event])
            self._since_s = now_s if self._since_s is None else self._since_s

    def decide(self, now_s: float) -> Motion | tuple[int, ...] | None:
        """Return the module meant; or the modules that cannot be told apart; or None: nothing moved yet.

        What was decided on is forgotten.
        """
        if self._since_s is None or now_s < self._since_s + DECISION_S:
            return None
        decision = self._decision()
        self.begin_anew()
        return decision

    def _decision(self) -> Motion | tuple[int, ...]:
        if len(self._events) == 1:
            return Motion(*next(iter(self._events.items())))
        if self._events:
            return tuple(sorted(self._events))
        ranked = sorted(self._swings.items(), key=lambda item: -item[1].peak_ratio)
        first, others = ranked[0], ranked[1:]
        close = [module for module, swing in others if swing.peak_ratio * LEAST_LEAD > first[1].peak_ratio]
        return tuple(sorted([first[0], *close])) if close else Motion(first[0], "motion")


_POLL_S = 0.05
_IDLE_S = 60.0
"""Listening ends so long after it was last of use: it costs a little for each sample."""


class AmbiguousMotionError(GatewayError):
    """More than one module moved."""


class MotionWatch:
    """A ``MotionDetector`` on a stream. What is usual is learnt from the first use on."""

    def __init__(self, stream: SuitSource) -> None:
        self._stream = stream
        self._detector = MotionDetector()
        self._end: asyncio.TimerHandle | None = None
        self._turn = asyncio.Lock()

    async def next(self, seconds: float, continues: bool = False) -> Motion | None:
        """Return the next module that is shaken or tapped; None when none is within the time.

        continues: what has moved since the last look counts too.
        Others that look meanwhile wait: one motion is reported to one of them.

        Raises ``AmbiguousMotionError`` naming the modules when they cannot be told apart.
        """
        async with self._turn:
            return await self._next(seconds, continues)

    async def _next(self, seconds: float, continues: bool) -> Motion | None:
        self._listen()
        if not continues:
            self._detector.begin_anew()
        end_ns = gateway_time_ns() + round(seconds * 1e9)
        while (now_ns := gateway_time_ns()) < end_ns:
            self._listen()  # a long look must not end as an idle one
            decision = self._detector.decide(now_ns * 1e-9)
            if isinstance(decision, Motion):
                return decision
            if decision is not None:
                moved = " and ".join(map(str, decision))
                raise AmbiguousMotionError(
                    f"modules {moved} all moved: hold still, and shake or tap one alone"
                )
            await asyncio.sleep(_POLL_S)
        return None

    def _listen(self) -> None:
        if self._end is None:
            for packet_class in (InertialSample, InertialSampleFine, Event):
                self._stream.listen(packet_class, self._take)
        else:
            self._end.cancel()
        self._end = asyncio.get_running_loop().call_later(_IDLE_S, self._stop)

    def _stop(self) -> None:
        self._end = None
        self._detector = MotionDetector()
        for packet_class in (InertialSample, InertialSampleFine, Event):
            self._stream.stop_listening(packet_class, self._take)

    def _take(self, received: ReceivedPacket, chunk: Chunk) -> None:
        now_s = chunk.arrived_ns * 1e-9
        if isinstance(received.packet, Event):
            self._detector.take_event(received.module, received.packet, now_s)
        elif isinstance(received.packet, InertialSample | InertialSampleFine):
            self._detector.take_sample(received.module, received.packet, now_s)
