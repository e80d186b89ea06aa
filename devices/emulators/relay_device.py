"""The relay unit as a device: it forwards, keeps what it gathers on its card, and obeys. Sans-I/O."""

from __future__ import annotations

from collections import deque
from operator import attrgetter

from devices.emulators.emulated_card import EmulatedCard
from devices.emulators.emulated_device import EmulatedDevice, Equipment
from devices.emulators.emulated_flash import EmulatedFlash
from devices.emulators.emulated_relay import EmulatedRelay
from devices.emulators.imperfections import ModuleClock
from devices.emulators.sender import Timed
from firmware_protocol import LogLine, encode_frame
from firmware_protocol.kinds import Kind

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
