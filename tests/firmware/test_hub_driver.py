"""The driver of a BNO085 against a model of the hub."""

from __future__ import annotations

import ctypes
from math import radians

import pytest

from tests.firmware.machines import shared_library
from tests.firmware.register_models import Felt
from tests.firmware.shtp_model import COMMANDS, REPORTS, Bno085
from tests.firmware.test_sensor_drivers import (
    FIELD_CLIPPED,
    FORCE_CLIPPED,
    HAS_FIELD,
    HAS_FORCE,
    HAS_RATE,
    RATE_CLIPPED,
    SCALE,
    G,
    Reading,
    Settings,
    Setup,
)

INTERVAL_US = 10_000
MOVED = Felt((0.5, -1.0, 1.5), (10.0, -20.0, 300.0), (20.0, -40.05, 0.05))


class Driver:
    """It, compiled for this computer, with the hub behind it."""

    def __init__(self, library: ctypes.CDLL) -> None:
        self.library, self.hub = library, Bno085()
        read = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_int)
        write = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_int)
        delay = ctypes.CFUNCTYPE(None, ctypes.c_int)
        self._kept = (read(self._read), write(self._write), delay(self._delay))
        for name, function in zip(("on_read", "on_write", "on_delay"), self._kept, strict=True):
            ctypes.c_void_p.in_dll(library, name).value = ctypes.cast(function, ctypes.c_void_p).value
        library.imu_configure.restype = library.imu_read.restype = ctypes.c_bool

    def _read(self, data: int, capacity: int) -> int:
        sent = self.hub.read(capacity)
        assert len(sent) <= capacity
        ctypes.memmove(data, sent, len(sent))
        return len(sent)

    def _write(self, data: int, size: int) -> int:
        self.hub.write(ctypes.string_at(data, size))
        return 1

    def _delay(self, us: int) -> None:
        self.hub.pass_time(us)

    def configure(self, rate_dhz: int = 1000) -> Setup | None:
        settings, setup = Settings(rate=rate_dhz, mode=2), Setup()
        is_good = self.library.imu_configure(ctypes.byref(settings), ctypes.byref(setup))
        return setup if is_good else None

    def reading(self) -> Reading | None:
        found = Reading()
        return found if self.library.imu_read(0, ctypes.byref(found)) else None

    def after(self, felt: Felt, us: int = INTERVAL_US) -> Reading | None:
        self.hub.felt = felt
        self.hub.pass_time(us)
        return self.reading()


@pytest.fixture(scope="session")
def library(tmp_path_factory) -> ctypes.CDLL:
    built = tmp_path_factory.mktemp("hub") / "hub.so"
    return shared_library(built, "sensors", ["imu_bno085.c"], "shtp_shim.c")


@pytest.fixture
def driver(library) -> Driver:
    return Driver(library)


@pytest.mark.parametrize(
    ("rate_dhz", "told_dhz", "field_dhz"), [(100, 100, 100), (1000, 1000, 1000), (40000, 2000, 1000)]
)
def test_it_is_asked_for_what_it_measures_twice_as_often_as_it_is_read(driver, rate_dhz, told_dhz, field_dhz):
    setup = driver.configure(rate_dhz)
    assert (setup.force_range, setup.rate_range, setup.field_range) == (785, 2000, 1300)
    assert (setup.force_rate, setup.rate_rate, setup.field_rate) == (told_dhz, told_dhz, field_dhz)
    assert driver.hub.intervals_us[0x01] == driver.hub.intervals_us[0x07] == 5_000_000 // told_dhz
    assert driver.hub.intervals_us.keys() == {0x01, 0x07, 0x0F}
    assert not any(driver.hub.calibrates.values())


def test_readings_come_in_steps_of_the_wire(driver):
    assert driver.configure()
    reading = driver.after(MOVED)
    assert reading.present == HAS_FORCE | HAS_FIELD | HAS_RATE
    assert reading.clipped == 0
    for axis in range(3):
        assert reading.force[axis] * SCALE["specific_force"] == pytest.approx(
            MOVED.acceleration_g[axis] * G, abs=0.005
        )
        assert reading.rate[axis] * SCALE["angular_rate"] == pytest.approx(
            radians(MOVED.rate_dps[axis]), abs=0.002
        )
        assert reading.field[axis] * SCALE["magnetic_field"] == pytest.approx(MOVED.field_ut[axis], abs=0.06)
    assert driver.library.imu_temperature() == -32768


def test_what_is_not_new_is_left_out_and_nothing_new_is_no_reading(driver):
    assert driver.configure(2000)
    seen = [driver.after(MOVED, 5000).present for _ in range(8)]
    assert all(present & HAS_FORCE and present & HAS_RATE for present in seen)
    assert 3 <= sum(bool(present & HAS_FIELD) for present in seen) <= 5
    assert driver.reading() is None


@pytest.mark.parametrize(
    ("felt", "clipped"),
    [
        (Felt((0.0, 0.0, -9.0)), FORCE_CLIPPED),
        (Felt(rate_dps=(2100.0, 0.0, 0.0)), RATE_CLIPPED),
        (Felt(field_ut=(0.0, -1400.0, 0.0)), FIELD_CLIPPED),
    ],
)
def test_what_is_beyond_the_range_is_clipped_as_long_as_it_is(driver, felt, clipped):
    assert driver.configure()
    assert driver.after(felt).clipped == clipped
    driver.after(Felt())
    assert driver.after(Felt()).clipped == 0


def test_a_hub_that_is_not_there_is_told(driver):
    driver.hub.is_there = False
    assert driver.configure() is None


def test_what_nobody_asked_for_is_passed_over(driver):
    assert driver.configure()
    driver.hub.say(COMMANDS, bytes(700))  # longer than any transfer
    driver.hub.say(REPORTS, bytes([0x05, *[9] * 13]))
    driver.hub.say(REPORTS, bytes([0x01, 0, 0]))  # cut off
    assert driver.after(MOVED).present & HAS_FORCE
    assert driver.after(MOVED).force[2] * SCALE["specific_force"] == pytest.approx(1.5 * G, abs=0.005)
