"""Between devices and host, both ways: losses, delays and corruption of links and of the radio. Sans-I/O.

``Delivery``: from the moment a wire frame is sent to the moment its bytes arrive. ``FromHost``: from the
host's bytes to packets that reach the devices.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np
from numpy.random import Generator

from devices.emulators.device.sender import Timed
from devices.emulators.imperfections import Imperfections
from devices.link import Framing
from firmware_protocol import (
    CanFrameDecoder,
    FrameDecoder,
    PacketDecoder,
    ReceivedPacket,
    WireFrame,
    encode_frame,
    fragment,
    pack_can_records,
    unpack_can_records,
)
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


class Transmission(NamedTuple):
    """Bytes that come out of the suit at one moment."""

    time_s: float
    """Motion time, s."""
    data: bytes
    """A stuffed wire frame, or the CAN records of one, as the framing says."""
    device: int | None = None
    """Number of the device that it comes from; None: not known, or of none."""


class WireEncoding(Protocol):
    """How a device's wire frames become the bytes of its link."""

    @property
    def framing(self) -> Framing:
        """How its bytes are divided into messages."""
        ...

    def encode(self, frame: WireFrame) -> bytes:
        """Return its bytes; none at all for what a language has no word for."""
        ...

    def corrupt(self, data: bytes, rng: Generator) -> bytes:
        """Return it damaged."""
        ...


class Encoding(NamedTuple):
    """How wire frames become the bytes of a link."""

    framing: Framing = Framing.BYTE_STREAM
    is_fd: bool = False
    """CAN FD instead of classic CAN."""

    def encode(self, frame: WireFrame) -> bytes:
        """Return a frame as bytes of the link. Raises ``ValueError`` for a body too long for it."""
        if self.framing is Framing.CAN:
            return pack_can_records(fragment(frame, fd=self.is_fd))
        return encode_frame(frame)

    def corrupt(self, data: bytes, rng: Generator) -> bytes:
        """Change one byte: anywhere before the delimiter, or in the data of one CAN frame."""
        if self.framing is Framing.CAN:
            frames = unpack_can_records(data)
            length = len(pack_can_records(frames[:1]))
            return _flip(data, length - int(rng.integers(1, len(frames[0].data) + 1)), rng)
        return _flip(data, int(rng.integers(len(data) - 1)), rng)


class PacketFaults:
    """Loses and repeats the packets of one module, as a radio does."""

    def __init__(self, settings: Imperfections, rng: Generator, counts: Counter[str]) -> None:
        self._loss = settings.loss
        self._duplication = settings.duplication
        self._rng = rng
        self._counts = counts

    def apply(self, sent: list[Timed]) -> list[Timed]:
        """Return what is left of the packets, in order."""
        self._counts["sent"] += len(sent)
        if not sent or not (self._loss or self._duplication):
            return sent
        draws = self._rng.random((len(sent), 2))
        copies = (draws[:, 0] >= self._loss) * (1 + (draws[:, 1] < self._duplication))
        self._counts["lost"] += int((copies == 0).sum())
        self._counts["duplicated"] += int((copies == 2).sum())
        return [timed for timed, n in zip(sent, copies.tolist(), strict=True) for _ in range(n)]


class Delivery:
    """The way of one sender's wire frames into the host: first in, first out."""

    def __init__(
        self, settings: Imperfections, encoding: WireEncoding, rng: Generator, counts: Counter[str]
    ) -> None:
        self._settings = settings
        self._encoding = encoding
        self._rng = rng
        self._counts = counts
        self._last_s = -np.inf

    def deliver(self, sent: Sequence[Timed]) -> list[Transmission]:
        """Encode and delay wire frames that were sent in order of time."""
        if not sent:
            return []
        settings, rng = self._settings, self._rng
        times = np.array([timed.time_s for timed in sent]) + settings.latency
        if settings.jitter:
            times += rng.exponential(settings.jitter, len(sent))
        # A stream keeps its order: whatever is delayed delays all that follows.
        times = np.maximum.accumulate(np.maximum(times, self._last_s))
        self._last_s = times[-1]
        if settings.batching:
            times = np.ceil(times / settings.batching) * settings.batching
        encode = self._encoding.encode
        transmissions = [
            Transmission(time, data)
            for time, timed in zip(times.tolist(), sent, strict=True)
            if (data := encode(timed.frame))
        ]
        return self._corrupted(transmissions) if settings.corruption else transmissions

    def follow(self, at_s: float) -> float:
        """Return when what is said at a time (s) comes in: behind all that was sent before it."""
        self._last_s = max(self._last_s, at_s)
        return float(self._last_s)

    def _corrupted(self, transmissions: list[Transmission]) -> list[Transmission]:
        is_hit = self._rng.random(len(transmissions)) < self._settings.corruption
        self._counts["corrupted"] += int(is_hit.sum())
        return [
            t._replace(data=self._encoding.corrupt(t.data, self._rng)) if hit else t
            for t, hit in zip(transmissions, is_hit.tolist(), strict=True)
        ]


def _flip(data: bytes, position: int, rng: Generator) -> bytes:
    changed = bytearray(data)
    changed[position] ^= int(rng.integers(1, 256))
    return bytes(changed)
