"""Lets the modules of an emulated suit speak as Xsens MTi, on serial lines or CAN, and obey as they do."""

from __future__ import annotations

from collections.abc import Mapping

from devices.emulators.device.emulated_device import EmulatedDevice
from devices.emulators.makers.vendor_emulator import Sensed, VendorEmulator, shares
from devices.link import Framing
from devices.vendor_protocols.mti import (
    CLIPPED,
    EVERY_PACKET,
    ITEMS,
    TICK_US,
    Mid,
    MtiDecoder,
    Reply,
    encode,
    encode_can,
    encode_item,
    encode_output_configuration,
    read_output_configuration,
)
from firmware_protocol.samples import STANDARD_GRAVITY

_FIRMWARE = bytes((1, 8, 2))
_FILTER_RUNS = 0b11
_NUMBER = 0
"""Place of the format of its numbers in ``NUMBERS``."""
_MOST_FORCE, _MOST_RATE = 10 * STANDARD_GRAVITY, 34.9
"""m/s² and rad/s: ends of its ranges."""


class MtiEmulator(VendorEmulator):
    """``MTData2`` with counter, time, status, acceleration, rate of turn and magnetic field."""

    def __init__(self, module: int, field_ut: float = 49.0) -> None:
        super().__init__(module, field_ut)
        self.outputs: dict[str, int] = {
            "packet_counter": EVERY_PACKET,
            "sample_time_fine": EVERY_PACKET,
            "status_word": EVERY_PACKET,
            "acceleration": 100,
            "rate_of_turn": 100,
            "magnetic_field": 100,
        }
        self.is_measuring = True
        self._device_id = (0x077001A0 + module).to_bytes(4, "big")
        self._count = 0
        self._host = MtiDecoder()

    def encode_sample(self, sensed: Sensed) -> bytes:
        """Return the message of one sample; none in configuration mode."""
        if not self.is_measuring:
            return b""
        values = self._measured(sensed)
        items = [encode_item(name, values[name], _NUMBER) for name in self.outputs if name in values]
        return encode(Mid.MT_DATA_2, b"".join(items))

    def receive(self, data: bytes, device: EmulatedDevice) -> bytes:
        """Obey Xbus messages of the host."""
        replies = [each for each in self._host.feed(data) if isinstance(each, Reply)]
        return b"".join(self._obeyed(each, device) for each in replies)

    def _measured(self, sensed: Sensed) -> Mapping[str, tuple[float, ...]]:
        # counted as sent, so that what is lost on the way is missed
        count = self._counted(sensed)
        clipped = CLIPPED["acceleration"] * (max(map(abs, sensed.force)) >= _MOST_FORCE)
        clipped |= CLIPPED["rate_of_turn"] * (max(map(abs, sensed.rate)) >= _MOST_RATE)
        values: dict[str, tuple[float, ...]] = {
            "packet_counter": (count % 2**16,),
            "sample_time_fine": (sensed.time_us // TICK_US % 2**32,),
            "status_word": (_FILTER_RUNS | clipped,),
            "acceleration": sensed.force,
            "rate_of_turn": sensed.rate,
        }
        if sensed.field is not None:
            values["magnetic_field"] = shares(sensed.field, self.field_ut)
        return values

    def _counted(self, sensed: Sensed) -> int:
        self._count += (sensed.sequence - self._count) % 2**16
        return self._count

    def _obeyed(self, asked: Reply, device: EmulatedDevice) -> bytes:
        answer = b""
        match asked.mid:
            case Mid.GO_TO_CONFIG | Mid.GO_TO_MEASUREMENT:
                self.is_measuring = asked.mid == Mid.GO_TO_MEASUREMENT
            # While it measures, an MTi obeys nothing but the order to stop.
            case _ if self.is_measuring:
                return b""
            case Mid.REQUEST_DEVICE_ID:
                answer = self._device_id
            case Mid.REQUEST_FIRMWARE:
                answer = _FIRMWARE
            case Mid.OUTPUT_CONFIGURATION:
                if asked.data:
                    self._configure(read_output_configuration(asked.data), device)
                answer = encode_output_configuration(self.outputs, _NUMBER)
            case _:
                return encode(Mid.ERROR, b"\x04")
        return encode(asked.mid + 1, answer)

    def _configure(self, outputs: Mapping[str, int], device: EmulatedDevice) -> None:
        self.outputs = {name: rate for name, rate in outputs.items() if name in ITEMS}
        rate = self.outputs.get("acceleration")
        if rate:
            device.adopt({"sampling_rate": float(rate)})


class MtiCanEmulator(MtiEmulator):
    """The same as CAN frames; it takes no commands there."""

    framing = Framing.CAN

    def encode_sample(self, sensed: Sensed) -> bytes:
        """Return the CAN records of one sample."""
        return encode_can({**self._measured(sensed), "sample_time_us": (sensed.time_us % 2**32,)})

    def receive(self, data: bytes, device: EmulatedDevice) -> bytes:
        """Pass over what the host says."""
        return b""
