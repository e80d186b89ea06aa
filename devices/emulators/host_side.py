"""From the host's bytes to packets that reach the devices: decoding, and the radio's faults. Sans-I/O."""

from __future__ import annotations

from numpy.random import Generator

from devices.emulators.imperfections import Imperfections
from devices.link import Framing
from firmware_protocol import CanFrameDecoder, FrameDecoder, PacketDecoder, ReceivedPacket
from firmware_protocol.kinds import FROM_HOST


class FromHost:
    """What the host has said, until it is due."""

    def __init__(self, framing: Framing) -> None:
        self.decoder = _decoder(framing)
        """Of what goes to all on the link. Its ``dropped`` counts what came damaged."""
        self._framing = framing
        self._decoders: dict[int | None, PacketDecoder] = {None: self.decoder}
        self._waiting: list[tuple[float, bytes, int | None]] = []

    def receive(self, data: bytes, at_s: float, device: int | None = None) -> None:
        """Take bytes, or CAN records, that arrive at a true time, s; not before those given last.

        device: number of the one that they come to; None: to all.
        """
        self._waiting.append((at_s, data, device))

    def before(self, to_s: float) -> list[tuple[float, ReceivedPacket, int | None]]:
        """Take and return the packets that arrive before a true time, s.

        Each has the time of its arrival, and the device that it comes to.
        """
        n_due = sum(at_s < to_s for at_s, *_ in self._waiting)
        due, self._waiting = self._waiting[:n_due], self._waiting[n_due:]
        return [
            (at_s, received, device)
            for at_s, data, device in due
            for received in self._decoders.setdefault(device, _decoder(self._framing)).feed(data)
            if received.kind in FROM_HOST
        ]


def _decoder(framing: Framing) -> PacketDecoder:
    return PacketDecoder(CanFrameDecoder() if framing is Framing.CAN else FrameDecoder())


class RadioToDevice:
    """The last step of the way to one device: delay, loss, repetition."""

    def __init__(self, settings: Imperfections, rng: Generator) -> None:
        self._settings = settings
        self._rng = rng
        self._last_s = 0.0

    def arrivals(self, at_s: float) -> list[float]:
        """Return when a packet from the host, sent at a true time, reaches the device, s: at most twice."""
        settings, rng = self._settings, self._rng
        copies = self._copies()
        delay_s = settings.latency + (rng.exponential(settings.jitter) if settings.jitter else 0.0)
        self._last_s = max(self._last_s, at_s + delay_s)
        return [self._last_s] * copies

    def receptions(self, on_air_s: float) -> list[float]:
        """Return when the device acts on a trigger that is on the air at a true time, s: at most twice."""
        copies, mean_s = self._copies(), self._settings.reception
        return [on_air_s + (self._rng.exponential(mean_s) if mean_s else 0.0)] * copies

    def _copies(self) -> int:
        settings = self._settings
        if not (settings.loss or settings.duplication):
            return 1
        lost, repeated = self._rng.random(2).tolist()
        return int((lost >= settings.loss) * (1 + (repeated < settings.duplication)))


class Broadcaster:
    """From the host to the air: a delay that is the same for all devices. Order is kept."""

    def __init__(self, settings: Imperfections, rng: Generator) -> None:
        self._settings = settings
        self._rng = rng
        self._last_s = 0.0

    def on_air(self, at_s: float) -> float:
        """Return when a packet that comes from the host at a true time goes on the air, s."""
        settings = self._settings
        delay_s = settings.latency + (self._rng.exponential(settings.jitter) if settings.jitter else 0.0)
        self._last_s = max(self._last_s, at_s + delay_s)
        return self._last_s
