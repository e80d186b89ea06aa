"""BNO080/BNO085 in UART-RVC mode as a source: orientations fused on board, one device a serial line."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, Literal

from devices.link import Chunk
from devices.vendor_protocols.bno08x import COUNT_BITS, RATE_HZ, Bno08xDecoder, Report
from devices.vendor_protocols.rotations import in_turn
from firmware_protocol import FusedSample
from gateway.frames import FusedReading
from gateway.sources.arrival_counter import ArrivalCounter
from gateway.sources.makers import MakersDevice, MakersLinkSettings, MakersSource

if TYPE_CHECKING:
    from gateway.sources.module_table import ModuleTable


class Bno08xLinkSettings(MakersLinkSettings):
    """One BNO08x in UART-RVC mode on a serial line."""

    carries: Literal["bno08x_rvc"] = "bno08x_rvc"


class Bno08xDevice(MakersDevice):
    """A device counts its reports in 8 bits, at 100 a second, and stamps none."""

    new_decoder = Bno08xDecoder

    def __init__(self, settings: Any) -> None:
        super().__init__(settings)
        self._times = ArrivalCounter(rate_hz=RATE_HZ, counter_bits=COUNT_BITS)

    def readings(self, message: Report, modules: ModuleTable, chunk: Chunk) -> Iterator[FusedReading]:
        """Yield the orientation of a report."""
        stamped = self._times.stamp(chunk.arrived_ns, message.index)
        assert stamped is not None  # its rate is known
        number, stamp_us = stamped
        record, time_ns = modules.timed(self.module, stamp_us, chunk)
        counted = record.counter(FusedSample.KIND).count_unwrapped(number, modules.losses(chunk.link))
        if counted is not None:
            yaw, pitch, roll = map(math.radians, message.angles)
            q_ws = in_turn(("z", yaw), ("y", pitch), ("x", roll))
            yield FusedReading(self.module, counted, time_ns, q_ws)


class Bno08xSource(MakersSource):
    """All BNO08x."""

    carries = "bno08x_rvc"
    settings = Bno08xLinkSettings
    device = Bno08xDevice
