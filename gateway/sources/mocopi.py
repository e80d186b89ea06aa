"""Sony's mocopi as a source: the bones that its app has fused, as orientations of so many modules."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, Literal

from pydantic import Field

from devices.link import Chunk
from devices.vendor_protocols.mocopi import PARENTS, Frame, MocopiDecoder
from devices.vendor_protocols.rotations import Quaternion, multiply
from firmware_protocol import FusedSample
from gateway.frames import FusedReading
from gateway.sources.makers import (
    LEAP_IN_NUMBER,
    MakersDevice,
    MakersLinkSettings,
    MakersSource,
    StreamCounter,
)

if TYPE_CHECKING:
    from gateway.sources.module_table import ModuleTable

_FROM_Y_UP = (0.5, 0.5, 0.5, 0.5)
"""Takes its world (x left, y up, z forward) to one with x forward, y left, z up."""


class MocopiLinkSettings(MakersLinkSettings):
    """What Sony's mocopi app sends."""

    carries: Literal["mocopi"] = "mocopi"
    module: int = Field(
        default=0, ge=0, le=37, description="for mocopi: added to the numbers of its bones to give modules'"
    )

    @property
    def modules(self) -> tuple[int, ...]:
        """One a bone."""
        return tuple(self.module + bone for bone in range(len(PARENTS)))

    @property
    def own_numbers(self) -> tuple[int, ...]:
        """None: not every bone is worn."""
        return ()


class MocopiDevice(MakersDevice):
    """The app numbers its instants and stamps them in steps of 1 ms; all bones share both."""

    new_decoder = MocopiDecoder

    def __init__(self, settings: Any) -> None:
        super().__init__(settings)
        self._numbers = StreamCounter()

    def readings(self, message: Frame, modules: ModuleTable, chunk: Chunk) -> Iterator[FusedReading]:
        """Yield the orientation of each bone in the world."""
        found: dict[int, Quaternion] = {-1: _FROM_Y_UP}
        for bone, turned, _ in message.bones:
            if bone < len(PARENTS) and PARENTS[bone] in found:
                found[bone] = multiply(found[PARENTS[bone]], turned)
        del found[-1]
        counted = self._numbers.number(message.number, message.time_ms) if found else None
        if counted is None:
            self._strange[LEAP_IN_NUMBER] += bool(found)
            return
        ids, losses = [self.module + bone for bone in found], modules.losses(chunk.link)
        stamp_us = message.time_ms * 1000 % 2**32
        records, time_ns = modules.timed_together(ids, self.module, stamp_us, chunk)
        together = list(zip(records, found.values(), strict=True))
        for record, q_ws in reversed(together):  # the root last: it is whom fused frames wait for
            number = record.counter(FusedSample.KIND).count_unwrapped(counted, losses)
            if number is not None:
                yield FusedReading(record.module, number, time_ns, q_ws)


class MocopiSource(MakersSource):
    """All apps."""

    carries = "mocopi"
    settings = MocopiLinkSettings
    device = MocopiDevice
