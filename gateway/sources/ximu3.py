"""x-IMU3 modules of x-io Technologies as a source: one device a link, over serial, TCP or UDP."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Iterator, Mapping
from typing import Literal

from pydantic import Field

from devices.link import Chunk
from devices.vendor_protocols.ximu3 import Inertial, Magnetic, Message, Ximu3Decoder
from firmware_protocol import InertialSample
from gateway.contract.balances import Balance
from gateway.frames import NOT_READ, Clipped, InertialBatch, Sample, Vector3
from gateway.sources.link_settings import LinkSettings
from gateway.sources.source import ListeningSource, SourceContext

GRAVITY = 9.80665
"""m/s² in the g of the device."""
RANGE_DEG_S, RANGE_G = 1999.0, 23.99
"""At or beyond these a sensor of the device is at the end of its range."""
_MAGNETIC = 1 << 9
"""Added to the kind: its magnetometer runs by itself, and is counted by itself."""


_INTERVALS, _FEWEST_INTERVALS = 31, 8
"""Between stamps: of so many the lower quartile is the interval of the samples, once there are some."""


class Ximu3LinkSettings(LinkSettings):
    """One x-IMU3."""

    carries: Literal["ximu3"] = "ximu3"
    module: int = Field(ge=0, le=254, description="for ximu3: number under which the rig knows the device")
    field_ut: float = Field(
        default=49,
        gt=0,
        le=100,
        description="for ximu3: the earth's field where it was calibrated, µT; it sends its share of that",
    )


class Ximu3Source(ListeningSource):
    """Devices number nothing: the link says which module it is, and stamps tell what is lost."""

    observes = InertialBatch

    def __init__(self, context: SourceContext) -> None:
        self._modules = context.modules
        self._links = context.links
        self._devices: dict[str, _Device] = {}
        self._accepted = 0

    def add_link(self, name: str, content: str) -> None:
        """Announce a device."""
        told = self._links.get(name)
        self._devices[name] = _Device(told) if isinstance(told, Ximu3LinkSettings) else _Device(None)
        self._modules.add_link(name)

    def receive(self, chunk: Chunk) -> list[InertialBatch]:
        """Return the samples that a chunk completes."""
        device = self._devices[chunk.link]
        messages = device.feed(chunk)
        self._modules.begin_chunk(chunk, is_damaged=device.is_damaged)
        rows = [self._row(device, message, chunk) for message in messages]
        self._accepted += len(rows)
        return [InertialBatch.of(rows)] if rows else []

    def dropped(self) -> Mapping[str, Mapping[str, int]]:
        """Return what could not be read, by link and reason."""
        return {name: device.dropped for name, device in self._devices.items()}

    def statistics(self) -> Mapping[str, object]:
        """Return how many messages no reading is made from, by link."""
        return {"ximu3": {name: {"unused": device.decoder.unused} for name, device in self._devices.items()}}

    def balances(self) -> Iterator[Balance]:
        """Yield the messages read, each of which is a sample."""
        yield Balance("packets_decoded", self._accepted, {})
        yield Balance("readings", self._accepted, {})

    def _row(self, device: _Device, message: Message, chunk: Chunk) -> Sample:
        record, time_ns = self._modules.timed(device.module, message.time_us % 2**32, chunk)
        losses = self._modules.losses(chunk.link)
        if isinstance(message, Magnetic):
            number = device.magnetic.number(message.time_us)
            record.counter(InertialSample.KIND | _MAGNETIC).count_unwrapped(number, losses)
            field = _scaled(message.field, device.field_ut)
            return device.module, device.inertial.newest, time_ns, (NOT_READ, NOT_READ, field), 0
        number = device.inertial.number(message.time_us)
        record.counter(InertialSample.KIND).count_unwrapped(number, losses)
        force, rate = _scaled(message.specific_force, GRAVITY), _scaled(message.angular_rate, math.pi / 180.0)
        return device.module, number, time_ns, (force, rate, NOT_READ), _clipped(message)


class StampCounter:
    """Numbers samples that have stamps and no numbers, by their interval: so that lost ones leave a gap."""

    def __init__(self) -> None:
        self.newest = -1
        """Number of the newest sample."""
        self._stamp_us = 0
        self._intervals: deque[int] = deque(maxlen=_INTERVALS)

    def number(self, stamp_us: int) -> int:
        """Return the number of the next sample; of one that is no later than the one before, the next."""
        interval = stamp_us - self._stamp_us
        self._stamp_us = stamp_us
        if interval <= 0:
            self._intervals.clear()
        step = 1
        if len(self._intervals) >= _FEWEST_INTERVALS:
            usual = sorted(self._intervals)[len(self._intervals) // 4]
            step = max(1, round(interval / usual))
        if interval > 0 and self.newest >= 0:
            self._intervals.append(interval)
        self.newest += step
        return self.newest


class _Device:
    """What is known of the device on one link."""

    def __init__(self, told: Ximu3LinkSettings | None) -> None:
        self.module = 0 if told is None else told.module
        self.field_ut = 49.0 if told is None else told.field_ut
        self.decoder = Ximu3Decoder()
        self.inertial, self.magnetic = StampCounter(), StampCounter()
        self.is_damaged = False
        self._sender: str | None = None
        self._strange: Counter[str] = Counter()

    @property
    def dropped(self) -> Counter[str]:
        return self.decoder.dropped + self._strange

    def feed(self, chunk: Chunk) -> list[Message]:
        """Return the messages of the device; those of another sender are counted, since it has the number."""
        if self._sender not in (None, chunk.sender):
            self._strange["another_sender"] += 1
            return []
        before = self.decoder.dropped.total()
        messages = self.decoder.feed(chunk.data)
        self.is_damaged = self.decoder.dropped.total() != before
        if messages:
            self._sender = chunk.sender
        return messages


def _scaled(vector: Vector3, factor: float) -> Vector3:
    x, y, z = vector
    return factor * x, factor * y, factor * z


def _clipped(message: Inertial) -> int:
    force = max(map(abs, message.specific_force)) >= RANGE_G
    rate = max(map(abs, message.angular_rate)) >= RANGE_DEG_S
    return Clipped.SPECIFIC_FORCE * force | Clipped.ANGULAR_RATE * rate
