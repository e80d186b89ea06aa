"""Lets the modules of an emulated suit speak as SlimeVR trackers: fused on board, without field or stamp."""

from __future__ import annotations

import struct
from collections.abc import Mapping

import numpy as np

from devices.deferred import VQF
from devices.emulators.device.emulated_device import EmulatedDevice
from devices.emulators.makers.vendor_emulator import Sensed, VendorEmulator
from devices.vendor_protocols import slimevr as wire
from devices.vendor_protocols.slimevr import Battery, Handshake, Kind, SensorInfo, SettingDone, Temperature
from devices.vendor_protocols.slimevr_tracker import Part, TrackerSession
from firmware_protocol import Health
from firmware_protocol.samples import STANDARD_GRAVITY

_MAC = "a4e57c0000{:02x}"
_IMU_LSM6DSV, _BOARD, _MCU = 13, 4, 2
_FIRMWARE = "0.7.2"
_HAS_MAGNETOMETER = 2
_RESTARTED_S = 1.0


class SlimevrEmulator(VendorEmulator):
    """Six-axis orientation and linear acceleration of each sample, in one datagram.

    It looks for a server, and sends data to one that greets it alone. The first samples teach its filter the
    sampling interval.
    """

    shares_link = True

    def __init__(self, module: int, field_ut: float = 49.0) -> None:
        super().__init__(module, field_ut)
        self.mac = _MAC.format(module)
        self._before_us: int | None = None
        self._now_s = 0.0
        self._begin()

    @property
    def link_settings(self) -> Mapping[str, object]:
        """Which tracker is which module."""
        mac = ":".join(self.mac[place : place + 2] for place in range(0, 12, 2))
        return {"trackers": {mac: self.module}}

    def encode_sample(self, sensed: Sensed) -> bytes:
        """Return the datagram of a sample; a handshake, or nothing, where no server has greeted it."""
        self._pass(sensed.time_us)
        if (handshake := self.session.due(self._now_s)) is not None:
            return handshake
        parts = [*self.session.presentations(self._now_s), *self._fused(sensed)]
        return self._one(self.session.data(parts))

    def encode_health(self, time_us: int, health: Health) -> bytes:
        """Return battery, signal and temperature; the battery alone to a server of old."""
        self._pass(time_us)
        charge = Battery(health.battery_voltage or 0.0, (health.battery_percent or 0) / 100.0)
        celsius = Temperature(0, health.temperature_celsius or 0.0)
        parts: list[Part] = [(Kind.BATTERY, wire.battery(charge))]
        if self.session.takes_bundles:
            dbm = -60 if health.rssi_dbm is None else health.rssi_dbm
            parts += [(Kind.SIGNAL, wire.signal(dbm)), (Kind.TEMPERATURE, wire.temperature(celsius))]
        return self._one(self.session.data(parts))

    def receive(self, data: bytes, device: EmulatedDevice) -> bytes:
        """Answer the server; obey it where it switches the magnetometer, which nothing is fused from."""
        answers = self.session.receive(data, self._now_s)
        message = wire.read_from_server(data)
        if (
            isinstance(message, wire.FromServer)
            and message.kind == Kind.SET_SETTING
            and len(message.payload) == 4
        ):
            sensor, setting, value = struct.unpack(">BHB", message.payload)
            if setting == wire.MAGNETOMETER:
                self.session.sensors[0] = _sensor(is_on=bool(value))
                done = SettingDone(sensor, setting)
                answers += self.session.data([(Kind.SETTING_DONE, wire.setting_done(done))])
        return self._one(answers)

    def _begin(self) -> None:
        identity = Handshake(wire.VERSION, _FIRMWARE, self.mac, _IMU_LSM6DSV, _BOARD, _MCU)
        self.session = TrackerSession(identity, [_sensor(is_on=False)])
        self._filter: VQF | None = None

    def _pass(self, time_us: int) -> None:
        now_s = time_us * 1e-6
        if now_s < self._now_s - _RESTARTED_S:  # its power was gone
            self._before_us = None
            self._begin()
        self._now_s = now_s

    def _fused(self, sensed: Sensed) -> list[Part]:
        before_us, self._before_us = self._before_us, sensed.time_us
        if before_us is None or sensed.time_us <= before_us:
            return []
        if self._filter is None:
            self._filter = VQF((sensed.time_us - before_us) * 1e-6)
        force = np.array(sensed.force)
        self._filter.update(np.array(sensed.rate), force)
        w, x, y, z = self._filter.getQuat6D()
        # The last row of the rotation: the world's vertical in sensor axes.
        up = np.array([2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z])
        # Trackers send acceleration without gravity.
        a, b, c = (force - STANDARD_GRAVITY * up).tolist()
        orientation = float(w), float(x), float(y), float(z)
        if not self.session.takes_bundles:
            both = wire.rotation_and_acceleration(0, orientation, (a, b, c))
            return [(Kind.ROTATION_AND_ACCELERATION, both)]
        turned = wire.rotation_data(0, orientation)
        return [(Kind.ROTATION_DATA, turned), (Kind.ACCELERATION, wire.acceleration(0, (a, b, c)))]

    @staticmethod
    def _one(datagrams: list[bytes]) -> bytes:
        """Return the one datagram that is to be sent at a time."""
        return datagrams[0] if datagrams else b""


def _sensor(*, is_on: bool) -> SensorInfo:
    return SensorInfo(0, 1, _IMU_LSM6DSV, _HAS_MAGNETOMETER | is_on)
