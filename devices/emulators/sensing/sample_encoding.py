"""Bodies of inertial samples, many at once.

The layout is read from the packet's declaration, so this stays equal to ``encode_packet`` (a test
holds it) at a small part of its cost for thousands of samples each second.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from devices.emulators.bodies import FloatArray
from firmware_protocol import InertialSample, InertialSampleFine
from firmware_protocol.fields import BYTE_ORDER, INTEGER_RANGE, WireField, layout_of
from firmware_protocol.samples import SENSORS

BoolArray = NDArray[np.bool_]


class SampleEncoder:
    """Encodes the samples of a module that reads the given sensors."""

    def __init__(
        self, packet: type[InertialSample] | type[InertialSampleFine], sensors: tuple[str, ...] = SENSORS
    ) -> None:
        """Prepare to encode. Raises ``ValueError`` for a sensor that the packet does not have."""
        layout = layout_of(packet)
        unknown = set(sensors) - {f.name for f in layout.fields}
        if unknown:
            raise ValueError(f"no sensor is called {sorted(unknown)}; there are {list(SENSORS)}")
        self.kind = packet.KIND
        self._fields: tuple[WireField, ...] = tuple(f for f in layout.fields if f.name in sensors)
        self._clipped_bit = {f.clips: f.bit for f in layout.flags if f.clips}
        self._triggered_bit = next(f.bit for f in layout.flags if f.name == "triggered")
        self._mask = sum(1 << f.presence_bit for f in self._fields if f.presence_bit is not None)
        columns = [(f.name, BYTE_ORDER + f.code, (3,)) for f in self._fields]
        self._dtype = np.dtype([("mask", "u1"), *columns])

    def encode(
        self,
        readings: Mapping[str, FloatArray],
        ranges: Mapping[str, FloatArray] | None = None,
        is_triggered: BoolArray | None = None,
    ) -> list[bytes]:
        """Return one body a sample; what is beyond the range is sent as its end and marked as clipped.

        readings: sensor to (n, 3), SI and µT.
        ranges: sensor to (n, 1), largest reading of an axis; default: the largest that the wire can carry.
        is_triggered: (n,); default: none is.
        """
        n = len(readings[self._fields[0].name])
        rows = np.empty(n, self._dtype)
        rows["mask"] = self._mask
        if is_triggered is not None:
            rows["mask"] |= is_triggered.astype(np.uint8) << self._triggered_bit
        for declared in self._fields:
            scale = declared.scale or 1.0
            limit: float | FloatArray = INTEGER_RANGE[declared.code][1]
            if ranges is not None:
                limit = np.minimum(limit, np.rint(ranges[declared.name] / scale))
            elements = np.rint(readings[declared.name] / scale)
            # As a real module does: one flag for the sensor, whichever axis is at its end.
            is_clipped = (np.abs(elements) > limit).any(axis=1)
            rows["mask"] |= is_clipped.astype(np.uint8) << self._clipped_bit[declared.name]
            rows[declared.name] = np.clip(elements, -limit, limit)
        packed, size = rows.tobytes(), self._dtype.itemsize
        return [packed[start : start + size] for start in range(0, n * size, size)]
