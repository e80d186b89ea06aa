"""Two sensor chips as their data sheets describe them: registers, and what they do when these are written.

Written from the register maps (ICM-42688-P: DS-000347; MMC5983MA: revision A), and not from the drivers.
"""

from __future__ import annotations

from typing import ClassVar, NamedTuple


class Felt(NamedTuple):
    """What the chips are exposed to."""

    acceleration_g: tuple[float, float, float] = (0.0, 0.0, 1.0)
    rate_dps: tuple[float, float, float] = (0.0, 0.0, 0.0)
    field_ut: tuple[float, float, float] = (0.0, 0.0, 0.0)
    temperature_celsius: float = 25.0


class Icm42688:
    """Six-axis chip; bank 0 only."""

    GYROSCOPE_DPS = (2000.0, 1000.0, 500.0, 250.0, 125.0, 62.5, 31.25, 15.625)
    ACCELEROMETER_G = (16.0, 8.0, 4.0, 2.0)
    RATES_HZ: ClassVar = {
        3: 8000,
        4: 4000,
        5: 2000,
        6: 1000,
        7: 200,
        8: 100,
        9: 50,
        10: 25,
        11: 12.5,
        15: 500,
    }
    RESET_US, GYROSCOPE_STARTS_US = 1000, 30000

    def __init__(self) -> None:
        self.felt = Felt()
        self.now_us = 0
        self.reset()

    def reset(self) -> None:
        self.registers = {0x4F: 0x06, 0x50: 0x06, 0x75: 0x47, 0x4E: 0x00}
        self.ready_us = self.now_us + self.RESET_US
        self.gyroscope_from_us: int | None = None

    def write(self, address: int, value: int) -> None:
        if self.now_us < self.ready_us and address != 0x11:
            return  # not before the reset is over
        if address == 0x11 and value & 1:
            self.reset()
            return
        if address == 0x4E and value & 0x0C == 0x0C and self.gyroscope_from_us is None:
            self.gyroscope_from_us = self.now_us + self.GYROSCOPE_STARTS_US
        self.registers[address] = value

    @property
    def rate_hz(self) -> float:
        assert self.registers[0x4F] & 15 == self.registers[0x50] & 15, "two rates"
        return self.RATES_HZ[self.registers[0x4F] & 15]

    def read(self, first: int, size: int) -> bytes:
        return bytes(self._one(first + i) for i in range(size))

    def _one(self, address: int) -> int:
        if 0x1D <= address <= 0x2A:
            place = address - 0x1D
            return self._words()[place // 2].to_bytes(2, "big", signed=True)[place % 2]
        return self.registers.get(address, 0)

    def _words(self) -> list[int]:
        mode = self.registers[0x4E]
        acceleration, rate = [-32768] * 3, [-32768] * 3
        if mode & 3:
            full = self.ACCELEROMETER_G[self.registers[0x50] >> 5]
            acceleration = [limited(each / full * 32768) for each in self.felt.acceleration_g]
        if self.gyroscope_from_us is not None and self.now_us >= self.gyroscope_from_us:
            full = self.GYROSCOPE_DPS[self.registers[0x4F] >> 5]
            rate = [limited(each / full * 32768) for each in self.felt.rate_dps]
        return [round((self.felt.temperature_celsius - 25) * 132.48), *acceleration, *rate]


class Mmc5983:
    """Magnetometer of 18 bits."""

    RESET_US = 10_000
    COUNTS_A_UT = 163.84

    def __init__(self) -> None:
        self.felt = Felt()
        self.now_us = 0
        self.reset()

    def reset(self) -> None:
        self.control = [0, 0, 0]
        self.ready_us = self.now_us + self.RESET_US
        self.is_measured = False

    def write(self, address: int, value: int) -> None:
        if self.now_us < self.ready_us and not (address == 0x0A and value & 0x80):
            return
        if address == 0x0A and value & 0x80:
            self.reset()
        elif address == 0x08 and value & 1:
            self.is_measured = False
        elif 0x09 <= address <= 0x0B:
            self.control[address - 0x09] = value

    @property
    def rate_hz(self) -> int:
        """Of continuous measurement; 0: none."""
        if not self.control[2] & 8:
            return 0
        return (0, 1, 10, 20, 50, 100, 200, 1000)[self.control[2] & 7]

    def measure(self) -> None:
        """The next measurement is done, if it measures at all."""
        self.is_measured = self.rate_hz > 0

    def read(self, first: int, size: int) -> bytes:
        counts = [
            max(0, min(2**18 - 1, round(each * self.COUNTS_A_UT) + 131072)) for each in self.felt.field_ut
        ]
        data = b"".join((each >> 2).to_bytes(2, "big") for each in counts)
        data += bytes([(counts[0] & 3) << 6 | (counts[1] & 3) << 4 | (counts[2] & 3) << 2, 0])
        data += bytes([int(self.is_measured)])
        registers = {**dict(enumerate(data)), 0x2F: 0x30}
        return bytes(registers.get(first + i, 0) for i in range(size))


def limited(value: float) -> int:
    return max(-32767, min(32767, round(value)))
