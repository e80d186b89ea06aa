"""Lets the modules of an emulated suit speak as x-IMU3, and obey as they do."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

from devices.emulators.device.emulated_device import EmulatedDevice
from devices.emulators.makers.vendor_emulator import Sensed, VendorEmulator, degrees, shares
from devices.vendor_protocols.ximu3 import (
    COMMAND_PORT,
    DISCOVERY_PORT,
    INERTIAL_HZ,
    MAGNETIC_HZ,
    Announcement,
    encode_announcement,
    encode_binary,
    encode_command,
    encode_text,
)
from firmware_protocol import Health
from firmware_protocol.samples import STANDARD_GRAVITY

_FIELD_LATER_US = 800
_FLASHES_S = 5
_INERTIAL, _MAGNETIC = "inertial_message_rate_divisor", "magnetometer_message_rate_divisor"
_FACTORY: dict[str, Any] = {
    "device_name": "x-IMU3",
    "firmware_version": "v1.0.0",
    "binary_mode_enabled": True,
    _INERTIAL: 4,
    _MAGNETIC: 1,
    "ahrs_message_rate_divisor": 0,
    "high_g_accelerometer_message_rate_divisor": 0,
    "synchronisation_enabled": True,
    "udp_send_port": 0,
    "udp_receive_port": COMMAND_PORT,
}


class Ximu3Emulator(VendorEmulator):
    """Samples of the magnetometer come by themselves, 20 a second; battery and signal every second."""

    def __init__(self, module: int, field_ut: float = 49.0, receive_port: int = COMMAND_PORT) -> None:
        """Speak, and take commands on UDP port ``receive_port``."""
        super().__init__(module, field_ut)
        self.from_port = receive_port
        serial = f"{0x65570000 + module:08X}"
        self.settings = {**_FACTORY, "serial_number": serial, "udp_receive_port": receive_port}
        """By name, as the device sends and takes them."""
        self._staged: dict[str, Any] = {}
        self._field_due_us = 0
        self._rest = b""
        self._health: Health | None = None

    @property
    def link_settings(self) -> Mapping[str, object]:
        """Where it takes commands, if that is not the usual port."""
        return {} if self.from_port == COMMAND_PORT else {"command_port": self.from_port}

    def encode_sample(self, sensed: Sensed) -> bytes:
        """Return the messages of one sample."""
        force, rate = shares(sensed.force, STANDARD_GRAVITY), degrees(sensed.rate)
        messages = self._encoded(b"I", sensed.time_us, (*rate, *force))
        interval_us = self.settings[_MAGNETIC] * 1_000_000 // MAGNETIC_HZ
        if sensed.field is None or not interval_us or sensed.time_us < self._field_due_us:
            return messages
        self._field_due_us = max(self._field_due_us + interval_us, sensed.time_us - interval_us)
        # its magnetometer runs by itself: a sample of an instant before, sent after
        at_us = max(sensed.time_us - _FIELD_LATER_US, 0)
        return messages + self._encoded(b"M", at_us, shares(sensed.field, self.field_ut))

    def encode_health(self, time_us: int, health: Health) -> bytes:
        """Return battery, signal and temperature."""
        self._health = health
        rssi_dbm = -60 if health.rssi_dbm is None else health.rssi_dbm
        reported = {
            b"B": (health.battery_percent or 0, health.battery_voltage or 0.0, 0.0),
            b"W": (_percent(rssi_dbm), rssi_dbm),
            b"T": (health.temperature_celsius or 0.0,),
        }
        return b"".join(self._encoded(letter, time_us, values) for letter, values in reported.items())

    def receive(self, data: bytes, device: EmulatedDevice) -> bytes:
        """Obey commands, one a line."""
        *lines, self._rest = (self._rest + data).split(b"\n")
        return b"".join(self._obeyed(line, device) for line in lines if line.strip())

    def announcement(self, port: int) -> tuple[int, bytes]:
        """Return the datagram of network discovery."""
        health = self._health
        announced = Announcement(
            name=self.settings["device_name"],
            serial_number=self.settings["serial_number"],
            address="127.0.0.1",
            tcp_port=7000,
            send_port=port,
            receive_port=self.settings["udp_receive_port"],
            battery_percent=None if health is None else health.battery_percent,
            rssi_percent=None if health is None or health.rssi_dbm is None else _percent(health.rssi_dbm),
        )
        return DISCOVERY_PORT, encode_announcement(announced)

    def _encoded(self, letter: bytes, time_us: int, values: tuple[float, ...]) -> bytes:
        encode = encode_binary if self.settings["binary_mode_enabled"] else encode_text
        return encode(letter, time_us, values)

    def _obeyed(self, line: bytes, device: EmulatedDevice) -> bytes:
        try:
            ((key, value),) = json.loads(line).items()
        except (ValueError, AttributeError):
            return encode_command("error", "Unable to parse JSON")
        match key:
            case "ping":
                reported = {"interface": "UDP", "name": self.settings["device_name"]}
                return encode_command("ping", reported | {"sn": self.settings["serial_number"]})
            case "strobe" | "blink":
                device.blink(_FLASHES_S if key == "strobe" else 1)
            case "apply" | "save":
                self._apply(device)
            case _ if key in self.settings:
                # A key without value asks; one with a value stages it until it is applied.
                if value is not None:
                    self._staged[key] = value
                return encode_command(key, self._staged.get(key, self.settings[key]))
            case _:
                return encode_command(key, {"error": "Unknown command"})
        return encode_command(key)

    def _apply(self, device: EmulatedDevice) -> None:
        self.settings |= self._staged
        divisor = self._staged.get(_INERTIAL)
        self._staged = {}
        if divisor:
            device.adopt({"sampling_rate": INERTIAL_HZ / divisor})


def _percent(rssi_dbm: float) -> int:
    return round(min(max(2.0 * (rssi_dbm + 100.0), 0.0), 100.0))


def ximu3_emulators(modules: Sequence[int], field_ut: float) -> Mapping[int, VendorEmulator]:
    """Return the emulators of devices that take commands each on a port of its own."""
    ports = enumerate(modules, start=COMMAND_PORT)
    return {module: Ximu3Emulator(module, field_ut, port) for port, module in ports}
