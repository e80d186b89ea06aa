"""Lets one module of an emulated suit speak as an x-IMU3, over a link of its own."""

from __future__ import annotations

import numpy as np

from devices.vendor_protocols.ximu3 import encode_binary, encode_text
from firmware_protocol import FrameDecoder, InertialSample, WireFrame, encode_frame
from firmware_protocol.packets import decode_body

GRAVITY = 9.80665
_FIELD_EVERY, _TEXT_EVERY = 5, 7
_FIELD_LATER_US = 800


class Ximu3Voice:
    """What a suit sends, in two: without the module, and what an x-IMU3 in its place sends."""

    def __init__(self, module: int, field_ut: float) -> None:
        """module: its number; field_ut: strength of the field that it was calibrated in, µT."""
        self._module, self._field_ut = module, field_ut
        self._frames = FrameDecoder()
        self._samples = 0

    def feed(self, data: bytes) -> tuple[bytes, bytes]:
        """Return wire frames of the other modules, and messages of the device: a sample of its magnetometer
        with every fifth one, and every seventh as text."""
        ours, theirs = b"", b""
        for frame in self._frames.feed(data):
            if frame.module != self._module:
                ours += encode_frame(frame)
            else:
                theirs += self._spoken(frame)
        return ours, theirs

    def _spoken(self, frame: WireFrame) -> bytes:
        sample = decode_body(frame.kind, frame.body)
        if not isinstance(sample, InertialSample) or not sample.specific_force or not sample.angular_rate:
            return b""
        self._samples += 1
        encode = encode_text if self._samples % _TEXT_EVERY == 0 else encode_binary
        rate, force = np.degrees(sample.angular_rate), np.divide(sample.specific_force, GRAVITY)
        said = encode(b"I", frame.module_time_us, (*rate.tolist(), *force.tolist()))
        if self._samples % _FIELD_EVERY == 0 and sample.magnetic_field is not None:
            field = np.divide(sample.magnetic_field, self._field_ut)
            # its magnetometer runs by itself: a sample of an instant before, said after
            said += encode_binary(b"M", max(frame.module_time_us - _FIELD_LATER_US, 0), field.tolist())
        return said
