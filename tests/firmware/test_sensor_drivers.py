"""Drivers of the ICM-42688-P and the MMC5983MA against models of their registers."""

from __future__ import annotations

import ctypes

import pytest

from firmware_protocol import InertialSample
from firmware_protocol.device_settings import factory_settings
from firmware_protocol.fields import layout_of
from tests.firmware.machines import shared_library
from tests.firmware.register_models import Felt, Icm42688, Mmc5983

SOURCES = ("icm42688.c", "mmc5983.c", "imu_chips.c")
SCALE = {declared.name: declared.scale for declared in layout_of(InertialSample).fields}
HAS_FORCE, HAS_FIELD, HAS_RATE = 1, 2, 4
FORCE_CLIPPED, FIELD_CLIPPED, RATE_CLIPPED = 0x10, 0x20, 0x40
G = 9.80665


class Settings(ctypes.Structure):
    """``mocap_settings``."""

    _fields_ = [
        ("module_id", ctypes.c_uint8),
        *(
            (name, ctypes.c_uint16)
            for name in ("rate", "force_range", "rate_range", "field_range", "low", "low2")
        ),
        ("mode", ctypes.c_uint8),
        ("calibration", ctypes.c_float * 30),
        ("label", ctypes.c_uint8 * 16),
    ]


class Setup(ctypes.Structure):
    _fields_ = [
        (name, ctypes.c_uint16)
        for name in ("force_range", "rate_range", "field_range", "force_rate", "rate_rate", "field_rate")
    ]


class Reading(ctypes.Structure):
    _fields_ = [
        ("present", ctypes.c_uint8),
        ("clipped", ctypes.c_uint8),
        ("force", ctypes.c_int16 * 3),
        ("rate", ctypes.c_int16 * 3),
        ("field", ctypes.c_int16 * 3),
    ]


class Bus:
    """The drivers, compiled for this computer, and the two chips."""

    def __init__(self, library: ctypes.CDLL) -> None:
        self.library = library
        self.chips = (Icm42688(), Mmc5983())
        self.is_broken = False
        read = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_int, ctypes.c_int, ctypes.c_void_p, ctypes.c_int)
        write = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_int, ctypes.c_int, ctypes.c_int)
        delay = ctypes.CFUNCTYPE(None, ctypes.c_int)
        self._kept = (read(self._read), write(self._write), delay(self._delay))
        for name, function in zip(("on_read", "on_write", "on_delay"), self._kept, strict=True):
            ctypes.c_void_p.in_dll(library, name).value = ctypes.cast(function, ctypes.c_void_p).value

    def _read(self, chip: int, first: int, data: int, size: int) -> int:
        ctypes.memmove(data, self.chips[chip].read(first, size), size)
        return int(not self.is_broken)

    def _write(self, chip: int, address: int, value: int) -> int:
        self.chips[chip].write(address, value)
        return int(not self.is_broken)

    def _delay(self, us: int) -> None:
        for chip in self.chips:
            chip.now_us += us

    def configure(self, rate=1000, force_range=1569, rate_range=2000) -> Setup | None:
        settings = Settings(
            rate=rate, force_range=force_range, rate_range=rate_range, field_range=4900, mode=2
        )
        setup = Setup()
        self.library.imu_configure.restype = ctypes.c_bool
        return setup if self.library.imu_configure(ctypes.byref(settings), ctypes.byref(setup)) else None

    def read(self, felt: Felt) -> Reading | None:
        for chip in self.chips:
            chip.felt = felt
        reading = Reading()
        self.library.imu_read.restype = ctypes.c_bool
        return reading if self.library.imu_read(0, ctypes.byref(reading)) else None


@pytest.fixture(scope="session")
def library(tmp_path_factory) -> ctypes.CDLL:
    built = tmp_path_factory.mktemp("drivers") / "drivers.so"
    return shared_library(built, "sensors", SOURCES, "spi_shim.c")


@pytest.fixture
def bus(library) -> Bus:
    return Bus(library)


def test_factory_settings_are_what_the_structure_holds():
    assert factory_settings()[2] == pytest.approx(100.0)  # 1000 steps, as `configure` has it


@pytest.mark.parametrize(
    ("force_range", "granted_g"), [(100, 2), (196, 2), (197, 4), (700, 8), (1569, 16), (4000, 16)]
)
def test_the_nearest_range_that_holds_is_taken(bus, force_range, granted_g):
    setup = bus.configure(force_range=force_range)
    assert setup.force_range == pytest.approx(granted_g * G * 10, abs=1)
    assert Icm42688.ACCELEROMETER_G[bus.chips[0].registers[0x50] >> 5] == granted_g


@pytest.mark.parametrize(
    ("rate_dhz", "chip_hz"), [(10, 12.5), (1000, 100), (1001, 200), (4000, 500), (40000, 4000)]
)
def test_the_chip_renews_its_readings_at_least_as_often_as_they_are_taken(bus, rate_dhz, chip_hz):
    setup = bus.configure(rate=rate_dhz)
    assert bus.chips[0].rate_hz == chip_hz
    assert setup.field_rate == min(rate_dhz, 1000)
    assert bus.chips[1].rate_hz == 100


@pytest.mark.parametrize("force_range", [196, 392, 785, 1569])
@pytest.mark.parametrize("rate_range", [31, 125, 250, 500, 1000, 2000])
def test_readings_come_in_steps_of_the_wire_whatever_the_range(bus, force_range, rate_range):
    assert bus.configure(force_range=force_range, rate_range=rate_range)
    bus.chips[1].measure()
    felt = Felt((0.5, -1.0, 1.5), (10.0, -20.0, 30.0), (20.0, -40.05, 0.05), 31.0)
    reading = bus.read(felt)
    assert reading.present == HAS_FORCE | HAS_FIELD | HAS_RATE
    assert reading.clipped == 0
    for axis in range(3):
        assert reading.force[axis] * SCALE["specific_force"] == pytest.approx(
            felt.acceleration_g[axis] * G, abs=0.005
        )
        assert reading.rate[axis] * SCALE["angular_rate"] == pytest.approx(
            felt.rate_dps[axis] * 0.0174533, abs=0.0011
        )
        assert reading.field[axis] * SCALE["magnetic_field"] == pytest.approx(felt.field_ut[axis], abs=0.03)
    assert bus.library.imu_temperature() == pytest.approx(3100, abs=2)


def test_what_is_beyond_the_range_is_clipped(bus):
    bus.configure(force_range=196, rate_range=250)
    bus.chips[1].measure()
    reading = bus.read(Felt((0.0, 0.0, 3.0), (0.0, -300.0, 0.0), (900.0, 0.0, 0.0)))
    assert reading.clipped == FORCE_CLIPPED | FIELD_CLIPPED | RATE_CLIPPED
    assert reading.force[2] * SCALE["specific_force"] == pytest.approx(2 * G, abs=0.01)


def test_a_field_that_is_not_new_is_left_out(bus):
    bus.configure()
    bus.chips[1].measure()
    assert bus.read(Felt()).present & HAS_FIELD
    assert not bus.read(Felt()).present & HAS_FIELD
    bus.chips[1].measure()
    assert bus.read(Felt()).present & HAS_FIELD


def test_a_chip_that_is_not_there_is_told(bus):
    bus.chips[0].registers[0x75] = 0
    bus.chips[0].reset = lambda: None
    assert bus.configure() is None


def test_a_reading_that_fails_is_none(bus):
    bus.configure()
    bus.is_broken = True
    assert bus.read(Felt()) is None


def test_a_gyroscope_that_does_not_run_yet_gives_no_reading(bus):
    bus.configure()
    bus.chips[0].gyroscope_from_us = bus.chips[0].now_us + 1
    assert bus.read(Felt()) is None
