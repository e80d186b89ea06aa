"""From the moment a wire frame is sent to the moment its bytes arrive: loss, delay, corruption. Sans-I/O."""

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
    WireFrame,
    encode_frame,
    fragment,
    pack_can_records,
    unpack_can_records,
)


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
