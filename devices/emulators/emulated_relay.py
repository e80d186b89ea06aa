"""How a relay unit on the body gathers what the modules send and forwards it as one. Sans-I/O."""

from __future__ import annotations

from operator import attrgetter

from devices.emulators.sampling_timer import Schedule
from devices.emulators.sender import Sender, Timed
from firmware_protocol import WireFrame, relay_batch
from firmware_protocol.framing import MAX_BODY_SIZE
from firmware_protocol.kinds import Kind
from firmware_protocol.relay import ENTRY_FIELDS

_TICK_PHASE = 0.1
_ENTRY_HEAD_SIZE = sum(field.size for field in ENTRY_FIELDS)


class EmulatedRelay:
    """Sends one batch a tick with all packets that came since the tick before.

    A tick's packets that do not fit one wire frame go out as several batches.
    """

    def __init__(self, sender: Sender, tick_s: float) -> None:
        self._sender = sender
        # A little after the modules' interval begins: modules that sample all at once are sent at once.
        self._ticks = Schedule(sender.clock, tick_s, _TICK_PHASE * tick_s)
        self._waiting: list[Timed] = []

    def gather(self, packets: list[Timed], to_s: float) -> list[Timed]:
        """Take packets sent before the true time ``to_s``; give the batches of the ticks before it."""
        self._waiting = sorted(self._waiting + packets, key=attrgetter("time_s"))
        batches: list[Timed] = []
        start = 0
        for elapsed in self._ticks.until(to_s).tolist():
            tick_s, end = self._sender.clock.true_time(elapsed), start
            while end < len(self._waiting) and self._waiting[end].time_s < tick_s:
                end += 1
            frames = [timed.frame for timed in self._waiting[start:end]]
            batches += [self._batch(part, elapsed) for part in _parts(frames)]
            start = end
        del self._waiting[:start]
        return batches

    def _batch(self, frames: list[WireFrame], elapsed: float) -> Timed:
        body = relay_batch(frames, 0, 0).body
        return self._sender.frame(Kind.RELAY_BATCH, elapsed, body)


def _parts(frames: list[WireFrame]) -> list[list[WireFrame]]:
    """Return the frames in runs that fit one batch each."""
    parts: list[list[WireFrame]] = []
    room = 0
    for frame in frames:
        size = _ENTRY_HEAD_SIZE + len(frame.body)
        if size > room:
            parts.append([])
            room = MAX_BODY_SIZE
        parts[-1].append(frame)
        room -= size
    return parts
