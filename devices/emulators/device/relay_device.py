"""The relay unit as a device: it forwards, keeps what it gathers on its card, and obeys. Sans-I/O.

``EmulatedRelay`` gathers what the modules send and forwards it as one.
"""

from __future__ import annotations

from collections import deque
from operator import attrgetter

from devices.emulators.device.emulated_card import EmulatedCard
from devices.emulators.device.emulated_device import EmulatedDevice, Equipment
from devices.emulators.device.emulated_flash import EmulatedFlash
from devices.emulators.device.sampling import Schedule
from devices.emulators.device.sender import Sender, Timed
from devices.emulators.imperfections import ModuleClock
from firmware_protocol import LogLine, WireFrame, encode_frame, relay_batch
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


_MODULE_ID_KEY = 1
_URGENT = frozenset({Kind.SYNC_RESPONSE, Kind.ACKNOWLEDGEMENT})
_WARNING = 2
_CARD_FULL = LogLine(_WARNING, "the card is full: nothing more is recorded")


class RelayDevice(EmulatedDevice):
    """Forwards packets in batches, answers to the host at once; START and STOP are about its card.

    It does not send DeviceInfo and Health of its own accord.
    """

    fixed_settings = frozenset({_MODULE_ID_KEY})

    def __init__(
        self,
        equipment: Equipment,
        clock: ModuleClock,
        flash: EmulatedFlash,
        tick_s: float,
        card: EmulatedCard | None,
    ) -> None:
        self._tick_s = tick_s
        self._gathered: deque[Timed] = deque()
        super().__init__(equipment, clock, flash)
        self.card = card

    def forward(self, packets: list[Timed], to_s: float) -> list[Timed]:
        """Take what the modules sent before the true time ``to_s``; give what the relay sends before it."""
        self._gathered = deque(sorted(packets, key=attrgetter("time_s")))
        own, _ = self.advance(to_s)
        received = [timed for timed in packets if not self._was_off(timed.time_s)]
        urgent = [timed for timed in received if timed.frame.kind in _URGENT]
        batches = self._batches.gather([t for t in received if t.frame.kind not in _URGENT], to_s)
        return sorted(own + urgent + batches, key=attrgetter("time_s"))

    def start(self) -> None:
        """Begin another file."""
        if self.card is not None and not self.card.begin(self.sender.clock.count_us(self._elapsed)):
            self._send(_CARD_FULL)

    def stop(self) -> None:
        """End the file."""
        if self.card is not None:
            self.card.end()

    def _boot(self, clock: ModuleClock) -> None:
        super()._boot(clock)
        self._batches = EmulatedRelay(self.sender, self._tick_s)
        self.stop()

    def _pass_time(self, to_s: float) -> None:
        while self._gathered and self._gathered[0].time_s < to_s:
            timed = self._gathered.popleft()
            if self.is_on:
                self._record(timed)
        super()._pass_time(to_s)

    def _work_until(self, to_s: float) -> None:
        """Do nothing: a relay has no sensors."""

    def _record(self, timed: Timed) -> None:
        if self.card is None or self.card.recording is None:
            return
        if not self.card.write(encode_frame(timed.frame)):
            self._send(_CARD_FULL)

    def _was_off(self, at_s: float) -> bool:
        return any(start_s <= at_s < end_s for start_s, end_s in self.outages)
