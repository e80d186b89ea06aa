"""Lets an emulated suit speak as the network streamer of MVN: its trackers, or its segments."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from devices.emulators.makers.vendor_emulator import Fused, Sensed, Together, VendorEmulator, shares
from devices.vendor_protocols.mvn import QUATERNIONS, TRACKERS, Item, SegmentPose, Tracker, encode

_NOWHERE = (0.0, 0.0, 0.0)
_UNTURNED = (1.0, 0.0, 0.0, 0.0)


class MvnEmulator(VendorEmulator):
    """One tracker or segment: the number of its module is its own."""

    sends_as_one = True

    def __init__(self, module: int, field_ut: float, together: Together[Item]) -> None:
        super().__init__(module, field_ut)
        self._together = together

    def encode_sample(self, sensed: Sensed) -> bytes:
        """Return the datagram of the trackers, with the last of them."""
        field = _NOWHERE if sensed.field is None else shares(sensed.field, self.field_ut)
        item = Tracker(self.module, _UNTURNED, _NOWHERE, sensed.force, sensed.rate, field)
        return self._datagram(TRACKERS, sensed.sequence, sensed.time_us, item)

    def encode_fused(self, fused: Fused) -> bytes:
        """Return the datagram of the segments, with the last of them."""
        item = SegmentPose(self.module, _NOWHERE, fused.orientation)
        return self._datagram(QUATERNIONS, fused.sequence, fused.time_us, item)

    def _datagram(self, kind: bytes, sequence: int, time_us: int, item: Item) -> bytes:
        done = self._together.add(self.module, sequence, time_us, item)
        return b"".join(encode(kind, number, at_us // 1000, items) for number, at_us, items in done)


def mvn_emulators(modules: Sequence[int], field_ut: float) -> Mapping[int, VendorEmulator]:
    """Return the emulators of all of one suit. Raises ``ValueError`` for numbers that no segment has."""
    if not all(0 < module < 256 for module in modules):
        raise ValueError("MVN numbers its segments from 1: take the rig mvn_17 or mvn_fused_23")
    together: Together[Item] = Together(modules)
    return {module: MvnEmulator(module, field_ut, together) for module in modules}
