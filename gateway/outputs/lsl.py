"""Orientations as a stream of the Lab Streaming Layer (extra ``lsl``).

Channels ``<segment>_w, _x, _y, _z``, segment to world (ENU), NaN where not known. Time stamps are the
instants of the poses on LSL's own clock, so recorders line them up with other devices.
"""

from __future__ import annotations

import importlib
from typing import Any

from devices.extras import how_to_add
from devices.link import gateway_time_ns
from gateway.errors import OutputError
from gateway.frames import SkeletonFrame

STREAM_TYPE = "MoCap"


class LslSink:
    """A stream outlet; frame_rate: poses a second, as far as known beforehand, Hz."""

    def __init__(self, name: str, source: str, segment_names: tuple[str, ...], frame_rate: float) -> None:
        self._name = name
        self._source = source
        self._segment_names = segment_names
        self._frame_rate = frame_rate
        self._pylsl: Any = None
        self._outlet: Any = None

    async def open(self) -> None:
        """Announce the stream. Raises ``OutputError`` where LSL is not installed."""
        try:
            self._pylsl = importlib.import_module("pylsl")
        except (ImportError, RuntimeError, OSError) as error:  # the package, or its native library
            raise OutputError(f"outputs.lsl: LSL is not there ({error}): {how_to_add('lsl')}") from error
        channels = 4 * len(self._segment_names)
        info = self._pylsl.StreamInfo(
            self._name, STREAM_TYPE, channels, self._frame_rate, self._pylsl.cf_float32, self._source
        )
        described = info.desc().append_child("channels")
        for segment in self._segment_names:
            for component in "wxyz":
                channel = described.append_child("channel")
                channel.append_child_value("label", f"{segment}_{component}")
                channel.append_child_value("type", "Orientation")
                channel.append_child_value("unit", "quaternion")
        self._outlet = self._pylsl.StreamOutlet(info)

    def send(self, frame: SkeletonFrame) -> bool:
        """Send a pose: LSL buffers for whoever listens, and drops for whoever does not read."""
        age_s = (gateway_time_ns() - frame.time_ns) * 1e-9
        self._outlet.push_sample(frame.q_wb.ravel().tolist(), self._pylsl.local_clock() - age_s)
        return True

    def close(self) -> None:
        """Withdraw the stream."""
        self._outlet = None
