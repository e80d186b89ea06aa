"""More samples than the machine can handle: what gives way, in which order, and how it comes back.

The measure is the lag: how long ago the bytes arrived that have just been handled. A machine that keeps up
has some milliseconds; one that does not falls behind by more and more. Stage by stage, ``SHED`` takes away
what can best be spared, until the lag stops growing. Decoding, clocks, and the recording of all that arrives
are never touched. Time is an argument of ``LoadWatch``, which decides; ``Shedding`` reads the clock.
"""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from devices.link import gateway_time_ns
from devices.links.link_counts import LinkCounts
from gateway.outputs.mqtt import MqttOutput
from gateway.outputs.side_outputs import SideOutputs
from gateway.pipeline import LOAD_EVENT

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class LoadStage:
    """One step of the order."""

    name: str
    meaning: str
    poses_hz: float | None = None
    """Most poses published a second from here on; None: as configured."""
    solve_every: int = 1
    """Of the frames, how many are reconstructed: 1: every one, 2: every second, …"""


SHED: tuple[LoadStage, ...] = (
    LoadStage("nothing", "everything is done"),
    LoadStage("side_outputs", "no poses for avatars, UDP and LSL"),
    LoadStage("segment_topics", "and no messages of single segments"),
    LoadStage("published_poses", "and at most 25 poses a second over MQTT, and so on the live page", 25.0),
    LoadStage("half_the_frames", "and every second frame is reconstructed", 25.0, 2),
    LoadStage("most_frames", "and every fifth frame is reconstructed", 10.0, 5),
)
"""In this order; each with all that the ones before it have taken away."""
SIDE_OUTPUTS, SEGMENT_TOPICS = 1, 2
"""Places in ``SHED`` from which on these are given up."""

TICK_S = 0.1
LATE_S = 0.05
"""A lag that never falls below this within a tick is too much for one."""
CALM_S = 0.02
"""A lag that falls below this in every tick is none: what waits is worked off again and again."""
DRAINED_S = 0.005
"""A lag that is so much less than a tick before is being worked off: no reason to give up more."""
LATE_TICKS = 5
"""So many in a row, and the next stage is taken: a hiccup of the machine passes by itself."""
CAUGHT_UP_S = 0.5
"""So long calm, and all stages are given back: it was a burst, as after the process was stopped or a link
was stalled. If they must be taken again within ``CALM_S_FIRST``, the load lasts."""
CALM_S_FIRST = 5.0
"""Under a load that lasts: so long calm, and one stage is given back."""
CALM_S_LONGEST = 80.0
"""The wait doubles whenever a stage that was given back had to be taken again, up to this."""


class LoadWatch:
    """Takes note of every chunk that was handled; decides which stage of ``SHED`` holds."""

    def __init__(self) -> None:
        self.stage = 0
        """Index into ``SHED``."""
        self.changes = 0
        """How often a stage was taken or given back."""
        self.lag_s = 0.0
        """Worst link, least within the last tick."""
        self.worst_s = 0.0
        """Greatest since the start."""
        self._tick_ends_s = -math.inf
        self._least_s: dict[str, float] = {}  # by link, within this tick
        self._late_ticks = 0
        self._before_s = 0.0
        self._calm_since_s: float | None = None
        self._patience_s = CALM_S_FIRST
        self._given_back_s = -math.inf
        self._given_back_from = 0
        self._lasts = False  # what was given back in one had to be taken again

    def observe(self, link: str, lag_s: float, now_s: float) -> bool:
        """Note how old a chunk was when it was handled, s; return whether the stage has changed."""
        self._least_s[link] = min(self._least_s.get(link, math.inf), lag_s)
        self.worst_s = max(self.worst_s, lag_s)
        return self.look(now_s)

    def look(self, now_s: float) -> bool:
        """Let time go on, also when nothing comes; return whether the stage has changed."""
        if now_s < self._tick_ends_s:
            return False
        is_first = self._tick_ends_s == -math.inf
        self._tick_ends_s = now_s + TICK_S
        self.lag_s = max(self._least_s.values(), default=0.0)
        self._least_s.clear()
        return not is_first and self._decide(self.lag_s, now_s)

    @property
    def holds(self) -> LoadStage:
        """What is given up now."""
        return SHED[self.stage]

    def statistics(self) -> Mapping[str, object]:
        """Return stage, what is shed, and how far the gateway is behind, for the health message."""
        return {
            "stage": self.stage,
            "shed": [stage.name for stage in SHED[1 : self.stage + 1]],
            "lag_ms": round(self.lag_s * 1e3, 1),
            "worst_lag_ms": round(self.worst_s * 1e3, 1),
            "changes": self.changes,
        }

    def _decide(self, least: float, now_s: float) -> bool:
        # A backlog that shrinks asks for nothing more, however long it is.
        is_draining = least < self._before_s - DRAINED_S
        self._before_s = least
        self._late_ticks = self._late_ticks + 1 if least > LATE_S and not is_draining else 0
        if least > CALM_S:
            self._calm_since_s = None
        elif self._calm_since_s is None:
            self._calm_since_s = now_s
        if self._late_ticks >= LATE_TICKS and self.stage < len(SHED) - 1:
            return self._take(now_s)
        calm_s = 0.0 if self._calm_since_s is None else now_s - self._calm_since_s
        if self.stage > 0 and calm_s >= (self._patience_s if self._lasts else CAUGHT_UP_S):
            return self._give_back(now_s)
        # Calm for so long that the next overload counts as the first.
        if self.stage == 0 and calm_s >= self._patience_s:
            self._patience_s, self._lasts = CALM_S_FIRST, False
        return False

    def _take(self, now_s: float) -> bool:
        """Take the next stage, or all at once that were given back just now."""
        stage = self.stage + 1
        if now_s - self._given_back_s < self._patience_s:
            if self._lasts:
                self._patience_s = min(2.0 * self._patience_s, CALM_S_LONGEST)
            stage = max(stage, self._given_back_from)
            self._lasts = True
        return self._change(stage, now_s)

    def _give_back(self, now_s: float) -> bool:
        """Give back one stage, or all of them after what may have been a burst."""
        self._given_back_s, self._given_back_from = now_s, self.stage
        return self._change(self.stage - 1 if self._lasts else 0, now_s)

    def _change(self, stage: int, now_s: float) -> bool:
        self._calm_since_s = now_s if stage < self.stage else None
        self.stage = stage
        self.changes += 1
        self._late_ticks = 0
        return True


class Shedding:
    """Does less of a running gateway while the load asks for it. Belongs to one event loop."""

    def __init__(
        self,
        load: LoadWatch,
        mqtt: MqttOutput,
        side: SideOutputs,
        apply_event: Callable[[str, Mapping[str, Any]], object],
        link_counts: Callable[[], Mapping[str, LinkCounts]],
    ) -> None:
        """apply_event: to the pipeline, and recorded. link_counts: of the links that are opened again, by
        name."""
        self._load, self._mqtt, self._side = load, mqtt, side
        self._apply_event = apply_event
        self._link_counts = link_counts

    def shed(self) -> None:
        """Do what the stage of the load asks for, and publish it."""
        holds = self._load.holds
        self._side.pause(self._load.stage >= SIDE_OUTPUTS)
        self._mqtt.relieve(holds.poses_hz, has_segments=self._load.stage < SEGMENT_TOPICS)
        self._apply_event(LOAD_EVENT, {"stage": holds.name, "solve_every": holds.solve_every})
        log.warning(
            "load stage %d of %d: %s (%.0f ms behind)",
            self._load.stage,
            len(SHED) - 1,
            holds.meaning,
            self._load.lag_s * 1e3,
        )

    def note_lag(self, link: str, counts: LinkCounts, arrived_ns: int) -> None:
        """Give the load watch the time by which a link is behind, with what still waits in the system."""
        now_ns = gateway_time_ns()
        if counts.backlog_since_ns is not None:
            arrived_ns = min(arrived_ns, counts.backlog_since_ns)
        if self._load.observe(link, (now_ns - arrived_ns) * 1e-9, now_ns * 1e-9):
            self.shed()

    async def watch(self) -> None:
        """Look also where nothing arrives any more, or nothing of it is let through by its link."""
        while True:
            await asyncio.sleep(TICK_S)
            for name, counts in self._link_counts().items():
                if counts.backlog_since_ns is not None:
                    self.note_lag(name, counts, gateway_time_ns())
            if self._load.look(gateway_time_ns() * 1e-9):
                self.shed()
