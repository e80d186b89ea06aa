"""Modules of other makers: what the emulated ones sense, encoded in another protocol.

A ``VendorEmulator`` stands where ``Encoding`` does, for one module on a link of its own: losses, delays and
damage befall its bytes like any others.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import ClassVar, Generic, NamedTuple, TypeVar

import numpy as np
from numpy.random import Generator

from devices.emulators.delivery import Encoding
from devices.emulators.device.emulated_device import EmulatedDevice
from devices.link import Framing
from firmware_protocol import (
    FrameDecoder,
    FusedSample,
    Health,
    InertialSample,
    InertialSampleFine,
    WireFrame,
    encode_frame,
)
from firmware_protocol.packets import decode_body

STAMP_BITS = 32
Vector = tuple[float, float, float]


class Sensed(NamedTuple):
    """One sample of an emulated module."""

    time_us: int
    """By the module's clock, since it was switched on; never wraps."""
    sequence: int
    force: Vector  # m/s²
    rate: Vector  # rad/s
    field: Vector | None  # µT


class Fused(NamedTuple):
    """One orientation of an emulated module that fuses on board."""

    time_us: int
    sequence: int
    orientation: tuple[float, float, float, float]  # sensor to its level reference, w first


class VendorEmulator:
    """One module of another maker. A maker's own extends this."""

    framing: ClassVar[Framing] = Framing.BYTE_STREAM
    shares_link: ClassVar[bool] = False
    """Whether all devices send to one port, where each is known by its own ``link_settings``."""
    is_fused: ClassVar[bool] = False
    """Whether it sends orientations and nothing else."""
    shares_bus: ClassVar[bool] = False
    """Whether several devices can be told apart on one CAN bus."""
    sends_as_one: ClassVar[bool] = False
    """Whether all of a body send as one, over one link."""

    def __init__(self, module: int, field_ut: float = 49.0) -> None:
        """Speak as ``module``, which was calibrated in a field of ``field_ut``, µT."""
        self.module, self.field_ut = module, field_ut
        self.from_port = 0
        """UDP port that it sends from, and takes commands on; 0: any."""
        self._newest_us: int | None = None

    @property
    def link_settings(self) -> Mapping[str, object]:
        """What the configuration of its link must say besides the usual."""
        return {}

    def encode_sample(self, sensed: Sensed) -> bytes:
        """Return what the device sends for a sample."""
        raise NotImplementedError

    def encode_fused(self, fused: Fused) -> bytes:
        """Return what it sends for an orientation; nothing unless a maker's own does."""
        return b""

    def encode_health(self, time_us: int, health: Health) -> bytes:
        """Return what it sends of how it fares; nothing unless a maker's own does."""
        return b""

    def receive(self, data: bytes, device: EmulatedDevice) -> bytes:
        """Obey what the host says; return the answer."""
        return b""

    def announcement(self, port: int) -> tuple[int, bytes] | None:
        """Return port and content of the datagram in which it announces itself, if it does. port: of the
        gateway, that it sends to."""
        return None

    def encode(self, frame: WireFrame) -> bytes:
        """Return what the device sends in the place of a packet of ours; nothing where it has no word for
        it."""
        packet = decode_body(frame.kind, frame.body)
        time_us = self._unwrapped(frame.module_time_us)
        if isinstance(packet, Health):
            return self.encode_health(time_us, packet)
        if isinstance(packet, FusedSample):
            return self.encode_fused(Fused(time_us, frame.sequence, packet.orientation))
        if not isinstance(packet, InertialSample | InertialSampleFine):
            return b""
        # Its messages hold both: one alone cannot be sent.
        if not packet.specific_force or not packet.angular_rate:
            return b""
        force, rate, field = packet.specific_force, packet.angular_rate, packet.magnetic_field
        return self.encode_sample(Sensed(time_us, frame.sequence, force, rate, field))

    def corrupt(self, data: bytes, rng: Generator) -> bytes:
        """Return it with one byte changed."""
        return Encoding(self.framing).corrupt(data, rng)

    def _unwrapped(self, stamp_us: int) -> int:
        if self._newest_us is None:
            self._newest_us = stamp_us
        half = 1 << (STAMP_BITS - 1)
        ahead = (stamp_us - self._newest_us + half) % (2 * half) - half
        self._newest_us = max(self._newest_us + ahead, 0)
        return self._newest_us


_Part = TypeVar("_Part")


class Together(Generic[_Part]):
    """The parts of one instant that the modules of a body send, until all have come.

    Modules send in turns, in their order, each of one instant or a few. When the turn begins anew nothing
    more comes of the instants of the last one: what was lost is left out.
    """

    def __init__(self, modules: Iterable[int]) -> None:
        self._place = {module: place for place, module in enumerate(modules)}
        self._counts: dict[int, tuple[int, int]] = {}  # newest sequence, and samples until then
        self._waiting: dict[int, tuple[int, dict[int, _Part]]] = {}
        self._last = -1  # place of the module that sent last

    def add(
        self, module: int, sequence: int, time_us: int, part: _Part
    ) -> list[tuple[int, int, list[_Part]]]:
        """Return number, time and content of each instant that this completes. sequence: of 16 bits."""
        place = self._place[module]
        # Modules send in turn: one that comes before its predecessor has begun the next round.
        done = sorted(self._waiting) if place < self._last else []
        self._last = place
        newest, count = self._counts.get(module, (sequence, 0))
        count += (sequence - newest) % 2**16
        self._counts[module] = sequence, count
        found = [(number, *self._taken(number)) for number in done]
        self._waiting.setdefault(count, (time_us, {}))[1][module] = part
        if self._waiting[count][1].keys() == self._place.keys():
            found.append((count, *self._taken(count)))
        return found

    def _taken(self, number: int) -> tuple[int, list[_Part]]:
        time_us, parts = self._waiting.pop(number)
        return time_us, [parts[each] for each in sorted(parts)]


def shares(vector: Vector, unit: float) -> Vector:
    """Return a vector in units of a number."""
    x, y, z = (np.asarray(vector) / unit).tolist()
    return x, y, z


def degrees(vector: Vector) -> Vector:
    """Return rad/s in deg/s."""
    x, y, z = np.degrees(vector).tolist()
    return x, y, z


class MixedSuit:
    """A suit of which one module is another maker's: what it sends, in two."""

    def __init__(self, emulator: VendorEmulator) -> None:
        self._emulator = emulator
        self._frames = FrameDecoder()

    def feed(self, data: bytes) -> tuple[bytes, bytes]:
        """Return wire frames of the other modules, and what the device sends."""
        ours, theirs = b"", b""
        for frame in self._frames.feed(data):
            if frame.module != self._emulator.module:
                ours += encode_frame(frame)
            else:
                theirs += self._emulator.encode(frame)
        return ours, theirs
