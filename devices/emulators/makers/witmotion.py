"""Lets the modules of an emulated suit speak as WitMotion devices, on serial lines or CAN, and obey."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from devices.emulators.device.emulated_device import EmulatedDevice
from devices.emulators.makers.vendor_emulator import Sensed, VendorEmulator, degrees, shares
from devices.link import Framing
from devices.vendor_protocols.witmotion import (
    ACCELERATION,
    ANGLE,
    ANGULAR_RATE,
    FIELD,
    IDENTIFIER,
    N_NUMBER,
    NUMBER,
    QUATERNION,
    RANGE_DEG_S,
    RANGE_G,
    RATES_HZ,
    READ_ADDRESS,
    REGISTERS,
    REGISTERS_BY_NAME,
    UNLOCK,
    counts,
    encode,
    encode_can,
    read_writes,
)
from firmware_protocol import unpack_can_records
from firmware_protocol.samples import STANDARD_GRAVITY

_ADDRESS = REGISTERS_BY_NAME["address"].address
_CELSIUS = 3125
_CAN_BAUD = 4  # 250 kbit/s
_FIELD_COUNTS_UT = 120.0
_RATE, _CONTENT = REGISTERS_BY_NAME["rate"].address, REGISTERS_BY_NAME["content"].address
_SENT = ACCELERATION, ANGULAR_RATE, ANGLE, FIELD, QUATERNION
_FACTORY = {_CONTENT: 0x16, _RATE: 9, 0x04: 6, 0x1A: IDENTIFIER, 0x1F: 2, 0x23: 0, 0x24: 0, 0x2E: 49}


class WitMotionEmulator(VendorEmulator):
    """Acceleration, angular rate and magnetic field, by the register of contents."""

    def __init__(self, module: int, field_ut: float = 49.0) -> None:
        super().__init__(module, field_ut)
        number = {NUMBER + k: int.from_bytes(b"WT", "little") for k in range(N_NUMBER - 1)}
        self.registers = {**_FACTORY, **number, NUMBER + N_NUMBER - 1: 0x3100 + module}
        """By address."""
        self._is_unlocked = False
        self._rest = b""

    def encode_sample(self, sensed: Sensed) -> bytes:
        """Return the packets of one sample."""
        return b"".join(self._encoded(kind, numbers) for kind, numbers in self._measured(sensed))

    def receive(self, data: bytes, device: EmulatedDevice) -> bytes:
        """Obey registers that are written."""
        writes, self._rest = read_writes(self._rest + data)
        return b"".join(self._obeyed(register, value, device) for register, value in writes)

    def _encoded(self, kind: int, numbers: list[int]) -> bytes:
        return encode(kind, numbers)

    def _measured(self, sensed: Sensed) -> Iterator[tuple[int, list[int]]]:
        field = [0.0] * 3 if sensed.field is None else sensed.field
        values = {
            ACCELERATION: [*counts(shares(sensed.force, STANDARD_GRAVITY), RANGE_G), _CELSIUS],
            ANGULAR_RATE: [*counts(degrees(sensed.rate), RANGE_DEG_S), 0],
            ANGLE: [0, 0, 0, self.registers[0x2E]],
            FIELD: [*(round(each * _FIELD_COUNTS_UT) for each in field), _CELSIUS],
            QUATERNION: [32767, 0, 0, 0],
        }
        for kind in _SENT:
            if self.registers[_CONTENT] >> kind - 0x50 & 1:
                yield kind, values[kind]

    def _obeyed(self, register: int, value: int, device: EmulatedDevice) -> bytes:
        if register == READ_ADDRESS:
            return self._encoded(REGISTERS, [self.registers.get(value + k, 0) for k in range(4)])
        if (register, value) == UNLOCK:
            self._is_unlocked = True
        elif self._is_unlocked and register in self.registers:
            self.registers[register] = value
            if register == _RATE and value in RATES_HZ:
                device.adopt({"sampling_rate": RATES_HZ[value]})
        return b""


class WitMotionCanEmulator(WitMotionEmulator):
    """The same as CAN frames."""

    framing = Framing.CAN
    shares_bus = True

    def __init__(self, module: int, field_ut: float = 49.0, identifier: int = IDENTIFIER) -> None:
        """Speak under the ``identifier`` of CAN frames."""
        super().__init__(module, field_ut)
        self.registers |= {REGISTERS_BY_NAME["baud"].address: _CAN_BAUD, _ADDRESS: identifier}

    @property
    def link_settings(self) -> Mapping[str, object]:
        """The identifier of its frames, if that is not the usual one."""
        identifier = self.registers[_ADDRESS]
        return {} if identifier == IDENTIFIER else {"identifier": identifier}

    def receive(self, data: bytes, device: EmulatedDevice) -> bytes:
        """Obey frames of its identifier."""
        frames = unpack_can_records(data)
        own = b"".join(each.data for each in frames if each.identifier == self.registers[_ADDRESS])
        return super().receive(own, device)

    def _encoded(self, kind: int, numbers: list[int]) -> bytes:
        return encode_can(kind, numbers, self.registers[_ADDRESS])


def witmotion_can_emulators(modules: Sequence[int], field_ut: float) -> Mapping[int, VendorEmulator]:
    """Return the emulators of devices that may share a bus: each has an identifier of its own."""
    identifiers = enumerate(modules, start=IDENTIFIER)
    return {each: WitMotionCanEmulator(each, field_ut, identifier) for identifier, each in identifiers}
