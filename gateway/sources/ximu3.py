"""x-IMU3 modules of x-io Technologies as a source: one device a link, over serial, TCP or UDP."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Literal

from pydantic import Field

from devices.commands.device_errors import DeviceError
from devices.link import Chunk
from devices.vendor_protocols.ximu3 import (
    COMMAND_PORT,
    DISCOVERY_PORT,
    INERTIAL_HZ,
    SETTINGS,
    Answer,
    Battery,
    Inertial,
    Magnetic,
    Message,
    Radio,
    Temperature,
    Ximu3Decoder,
    encode_command,
    read_announcement,
)
from firmware_protocol import InertialSample
from firmware_protocol.samples import STANDARD_GRAVITY
from gateway.frames import NOT_READ, Clipped, Sample
from gateway.sources.makers import (
    LEAST_RATE_SHARE,
    MAGNETIC,
    Announced,
    CommandLine,
    Description,
    Discovery,
    MakersDevice,
    MakersLinkSettings,
    MakersSource,
    SettingAdvice,
    StampCounter,
    health,
    identity,
    scaled,
)

if TYPE_CHECKING:
    from gateway.sources.module_table import ModuleTable

RANGE_DEG_S, RANGE_G = 1999.0, 23.99
"""At or beyond these a sensor of the device is at the end of its range."""
_RATE_SETTING = "inertial_message_rate_divisor"


class Ximu3LinkSettings(MakersLinkSettings):
    """One x-IMU3 of x-io."""

    carries: Literal["ximu3"] = "ximu3"
    command_port: int = Field(
        default=COMMAND_PORT,
        ge=1,
        le=65535,
        description="for ximu3 over udp: port on which the device takes commands (udp_receive_port)",
    )


class Ximu3Device(MakersDevice):
    """A device numbers nothing: its stamps show what is lost."""

    new_decoder = Ximu3Decoder

    def __init__(self, settings: Ximu3LinkSettings) -> None:
        super().__init__(settings)
        self._inertial, self._magnetic = StampCounter(), StampCounter()
        self._health = health()

    def sample(self, message: Message, modules: ModuleTable, chunk: Chunk) -> Sample | None:
        """Return the sample that a message is; None for one about the device itself."""
        if not isinstance(message, Inertial | Magnetic):
            self._note(message, modules)
            return None
        record, time_ns = modules.timed(self.module, message.time_us % 2**32, chunk)
        losses = modules.losses(chunk.link)
        if isinstance(message, Magnetic):
            # The magnetometer has a rate, and so numbers, of its own; a reading goes with the newest inertial
            # sample.
            number = self._magnetic.number(message.time_us)
            record.counter(InertialSample.KIND | MAGNETIC).count_unwrapped(number, losses)
            field = scaled(message.field, self.settings.field_ut)
            return Sample(self.module, self._inertial.newest, time_ns, (NOT_READ, NOT_READ, field))
        number = self._inertial.number(message.time_us)
        record.counter(InertialSample.KIND).count_unwrapped(number, losses)
        force, rate = (
            scaled(message.specific_force, STANDARD_GRAVITY),
            scaled(message.angular_rate, math.pi / 180.0),
        )
        return Sample(self.module, number, time_ns, (force, rate, NOT_READ), _clipped(message))

    def command_address(self, module: int) -> str:
        """Return host and port on which it takes commands; empty where there is one other end."""
        host, colon, _ = (self.sender or "").rpartition(":")
        return f"{host}{colon}{self.settings.command_port}" if host else ""

    def _note(self, message: Battery | Radio | Temperature | Answer, modules: ModuleTable) -> None:
        record = modules.records.get(self.module)
        if record is None:
            return
        if isinstance(message, Answer):
            described = _described(message)
            record.info = record.info if described is None else identity(bytes.fromhex(described.unique_id))
            return

        if isinstance(message, Battery):
            values: Mapping[str, Any] = {
                "battery_percent": round(message.percent),
                "battery_voltage": round(message.voltage, 3),
            }
        elif isinstance(message, Radio):
            values = {"rssi_dbm": round(message.power_dbm)}
        else:
            values = {"temperature_celsius": round(message.celsius, 2)}
        self._health = record.health = replace(self._health, **values)


class Ximu3Source(MakersSource):
    """All x-IMU3 devices."""

    carries = "ximu3"
    settings = Ximu3LinkSettings
    device = Ximu3Device


class Ximu3Commands:
    """Commands are JSON of one key, answered under the same key with what stands there now."""

    async def describe(self, line: CommandLine) -> Description:
        """Ask who it is."""
        return await line.request(encode_command("ping"), _described, "ping")

    async def identify(self, line: CommandLine, seconds: int) -> None:
        """Flash its light for five seconds, however many are asked for: the device knows no other."""
        if not seconds:
            raise DeviceError("an x-IMU3 cannot be told to stop: its light goes out after five seconds")
        await _answered(line, "strobe", None)

    async def read(self, line: CommandLine) -> dict[str, Any]:
        """Return the settings that matter to a gateway."""
        found = {}
        for key in SETTINGS:
            try:
                found[key] = await _answered(line, key, None)
            except DeviceError:  # an older or newer firmware calls some of them otherwise
                continue
        return found

    async def write(self, line: CommandLine, settings: Mapping[str, Any]) -> dict[str, Any]:
        """Write, act by them, and keep them over a loss of power."""
        after = {key: await _answered(line, key, value) for key, value in settings.items()}
        for key in ("apply", "save"):
            await _answered(line, key, None)
        return after

    def advice(self, module: int, settings: Mapping[str, Any], rate_hz: float) -> Iterator[SettingAdvice]:
        """Yield what would be better otherwise. rate_hz: of the poses."""
        divisor = settings.get(_RATE_SETTING)
        command = f"mocap-gateway modules set {module} {{}} --allow-writes"
        if divisor is not None and (not divisor or INERTIAL_HZ / divisor < LEAST_RATE_SHARE * rate_hz):
            sent_hz = INERTIAL_HZ / divisor if divisor else 0
            wanted = max(1, int(INERTIAL_HZ // rate_hz))
            yield SettingAdvice(
                f"sends {sent_hz:g} inertial messages a second for {rate_hz:g} poses",
                command.format(f"{_RATE_SETTING}={wanted}"),
            )
        if settings.get("magnetometer_message_rate_divisor") == 0:
            yield SettingAdvice(
                "its magnetometer is off: headings are held by joints alone",
                command.format("magnetometer_message_rate_divisor=1"),
            )
        if settings.get("binary_mode_enabled") is False:
            yield SettingAdvice(
                "sends text, which takes three times the bytes", command.format("binary_mode_enabled=true")
            )
        if settings.get("ahrs_message_rate_divisor"):
            yield SettingAdvice(
                "sends orientations of its own, which nothing is made from",
                command.format("ahrs_message_rate_divisor=0"),
            )


async def _answered(line: CommandLine, key: str, value: object) -> Any:
    answer = await line.request(
        encode_command(key, value),
        lambda message: message if isinstance(message, Answer) and message.key in (key, "error") else None,
        key,
    )
    refused = answer.value.get("error") if isinstance(answer.value, dict) else None
    if answer.key == "error" or refused is not None:
        raise DeviceError(f"the device refuses '{key}': {refused or answer.value}")
    return answer.value


def _described(message: object) -> Description | None:
    """Return who answers a ping; None for anything else."""
    identity = message.value if isinstance(message, Answer) and message.key == "ping" else None
    serial = str(identity.get("sn", identity.get("serialNumber"))) if isinstance(identity, dict) else ""
    if not re.fullmatch(r"([0-9A-Fa-f]{2}){1,12}", serial):
        return None
    assert isinstance(identity, dict)
    return Description(serial.lower(), str(identity.get("name", identity.get("deviceName", "")))[:64])


def _announced(data: bytes) -> Announced | None:
    announced = read_announcement(data)
    if announced is None:
        return None
    more = {} if announced.receive_port == COMMAND_PORT else {"command_port": announced.receive_port}
    url = f"udp://0.0.0.0:{announced.send_port}?peers={announced.address}"
    return Announced(
        "ximu3",
        announced.name,
        announced.serial_number.lower(),
        url,
        more,
        announced.battery_percent,
        announced.rssi_percent,
    )


DISCOVERY = Discovery(DISCOVERY_PORT, _announced)


def _clipped(message: Inertial) -> int:
    force = max(map(abs, message.specific_force)) >= RANGE_G
    rate = max(map(abs, message.angular_rate)) >= RANGE_DEG_S
    return Clipped.SPECIFIC_FORCE * force | Clipped.ANGULAR_RATE * rate
