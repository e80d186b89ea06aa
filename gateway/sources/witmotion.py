"""WitMotion devices as a source: one device a serial line, or an identifier of a CAN bus."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from pydantic import Field

from devices.commands.device_errors import DeviceError, NoAnswerError, UnfinishedError
from devices.link import Chunk
from devices.vendor_protocols.witmotion import (
    BAUDS,
    CAN_BAUDS,
    IDENTIFIER,
    N_NUMBER,
    NUMBER,
    RANGE_DEG_S,
    RANGE_G,
    RATES_HZ,
    READ_ADDRESS,
    REGISTERS_BY_NAME,
    SAVE,
    SIZE,
    UNLOCK,
    Inertial,
    Magnetic,
    Message,
    Values,
    WitMotionCanDecoder,
    WitMotionDecoder,
    encode_write,
)
from firmware_protocol import CanFrame, InertialSample, pack_can_records
from firmware_protocol.samples import STANDARD_GRAVITY
from gateway.frames import NOT_READ, Clipped, Sample
from gateway.sources.arrival_counter import ArrivalCounter
from gateway.sources.makers import (
    LEAST_RATE_SHARE,
    MAGNETIC,
    CommandLine,
    Description,
    MakersDevice,
    MakersLinkSettings,
    MakersSource,
    SettingAdvice,
    cannot_blink,
    health,
    scaled,
)

if TYPE_CHECKING:
    from gateway.sources.module_table import ModuleTable

_END = 0.9995
"""Of its range, from where a sensor is at the end of it."""
_FIELD_UNIT_UT = 1.0 / 120.0
"""Of one count, in models that do not say otherwise."""
_CONTENT = ("time", "acceleration", "angular_rate", "angle", "field", "ports", "pressure", "place", "speed",
            "quaternion", "satellites")  # fmt: skip
_WANTED = ("acceleration", "angular_rate", "field")
_RATE_OF = {hz: number for number, hz in RATES_HZ.items()}
_PACKET_BITS, _CAN_FRAME_BITS = 10 * SIZE, 135
"""On a line with a start and a stop bit a byte; on CAN with the most stuff bits that 8 bytes can have."""
_COMFORTABLE = 0.9
"""Of a line that its packets may take."""
_ANSWERS_ELSEWHERE = {"baud": "that rate in the link's url", "address": "that identifier at the link"}
"""Settings after which a device may be heard in another way only, and what the configuration then says."""
_TEMPERATURE_EVERY = 100
"""Samples between two looks at the temperature."""


class WitMotionLinkSettings(MakersLinkSettings):
    """One WitMotion device on a serial line."""

    carries: Literal["witmotion"] = "witmotion"
    rate_hz: float | None = Field(
        default=None,
        gt=0,
        le=1000,
        description="for witmotion: samples a second that it is set to; left out: told from the first ones",
    )
    count_ut: float = Field(
        default=_FIELD_UNIT_UT,
        gt=0,
        le=10,
        description="for witmotion: µT of one count of its magnetometer, which depends on the model",
    )


class WitMotionCanLinkSettings(WitMotionLinkSettings):
    """One WitMotion device on a CAN bus."""

    carries: Literal["witmotion_can"] = "witmotion_can"  # type: ignore[assignment]
    identifier: int = Field(
        default=IDENTIFIER, ge=0, le=0x7FF, description="for witmotion_can: identifier of its frames"
    )


class WitMotionDevice(MakersDevice):
    """A device sends neither count nor stamp: samples are counted by arrivals and by damaged packets."""

    new_decoder = WitMotionDecoder

    def __init__(self, settings: Any) -> None:
        super().__init__(settings)
        self._times = ArrivalCounter(list(_RATE_OF), getattr(settings, "rate_hz", None))
        self._count_ut = getattr(settings, "count_ut", _FIELD_UNIT_UT)
        self._newest: tuple[int, int] | None = None

    def sample(self, message: Message, modules: ModuleTable, chunk: Chunk) -> Sample | None:
        """Return the sample that a message is; None for orientations and registers."""
        if isinstance(message, Inertial):
            return self._inertial(message, modules, chunk)
        if isinstance(message, Magnetic) and self._newest is not None:
            # A reading of the magnetometer is dated with the newest inertial sample.
            number, stamp_us = self._newest
            record, time_ns = modules.timed(self.module, stamp_us, chunk)
            counter = record.counter(InertialSample.KIND | MAGNETIC)
            counter.count_unwrapped(counter.received, modules.losses(chunk.link))
            field = scaled(message.field, self._count_ut)
            return Sample(self.module, number, time_ns, (NOT_READ, NOT_READ, field))
        if not isinstance(message, Values):
            self.decoder.unused += 1
        return None

    def _inertial(self, message: Inertial, modules: ModuleTable, chunk: Chunk) -> Sample | None:
        self._newest = self._times.stamp(chunk.arrived_ns, n_lost=message.n_incomplete)
        if self._newest is None:  # its instant is not known
            self.decoder.unused += 1
            return None
        number, stamp_us = self._newest
        record, time_ns = modules.timed(self.module, stamp_us, chunk)
        record.counter(InertialSample.KIND).count_unwrapped(number, modules.losses(chunk.link))
        if message.celsius is not None and number % _TEMPERATURE_EVERY == 0:
            record.health = health(temperature_celsius=message.celsius)
        force = scaled(message.specific_force, STANDARD_GRAVITY)
        rate = scaled(message.angular_rate, math.pi / 180.0)
        return Sample(self.module, number, time_ns, (force, rate, NOT_READ), _clipped(message))


class WitMotionSource(MakersSource):
    """All WitMotion devices on serial lines."""

    carries = "witmotion"
    settings = WitMotionLinkSettings
    device = WitMotionDevice


class WitMotionCanDevice(WitMotionDevice):
    """On a CAN bus devices are told apart by the identifiers of their frames."""

    def __init__(self, settings: Any) -> None:
        super().__init__(settings)
        self._identifier: int = getattr(settings, "identifier", IDENTIFIER)
        self.decoder = WitMotionCanDecoder(self._identifier)

    def framed(self, command: bytes) -> bytes:
        """Return a command as the record of a frame."""
        return pack_can_records([CanFrame(self._identifier, command, is_extended=False)])


class WitMotionCanSource(MakersSource):
    """All WitMotion devices on CAN buses."""

    carries = "witmotion_can"
    settings = WitMotionCanLinkSettings
    device = WitMotionCanDevice


class WitMotionCommands:
    """Registers are read while it goes on sending, and written after a key, which locks again by itself."""

    _bauds: ClassVar[Mapping[int, int]] = BAUDS
    _packet_bits: ClassVar[int] = _PACKET_BITS

    async def describe(self, line: CommandLine) -> Description:
        """Ask for its number and version."""
        values = [await _read(line, NUMBER + k) for k in range(N_NUMBER)]
        version = await _read(line, REGISTERS_BY_NAME["version"].address)
        number = b"".join(each.to_bytes(2, "little") for each in values)
        return Description(number.hex(), "WitMotion", str(version))

    async def identify(self, line: CommandLine, seconds: int) -> None:
        """Raise ``GatewayError``: its light is switched by a register, which nothing writes unasked."""
        raise cannot_blink("a WitMotion device does not blink when it is asked")

    async def read(self, line: CommandLine) -> dict[str, Any]:
        """Return the registers that matter to a gateway: rate in Hz, content by name, baud in bit/s."""
        return {name: await self._read_back(line, name) for name in REGISTERS_BY_NAME}

    async def write(self, line: CommandLine, settings: Mapping[str, Any]) -> dict[str, Any]:
        """Unlock, write, keep over a loss of power, and return what stands there now.

        Last what it may be heard in another way after. Raises ``UnfinishedError`` where it is not heard then.
        """
        values = {name: self._meant(name, value) for name, value in settings.items()}
        steady = {name: value for name, value in values.items() if name not in _ANSWERS_ELSEWHERE}
        # One by one and read back: the device acknowledges nothing.
        for name, value in steady.items():
            await self._write_register(line, REGISTERS_BY_NAME[name].address, value)
        after = {name: await self._read_back(line, name) for name in steady}
        if steady:
            await self._write_register(line, *SAVE)
        # Last what changes how the device is reached: after it, the old settings no longer find it.
        for name in values.keys() - steady.keys():
            await self._write_register(line, REGISTERS_BY_NAME[name].address, values[name])
            await self._write_register(line, *SAVE)
            try:
                after[name] = await self._read_back(line, name)
            except NoAnswerError as error:
                raise UnfinishedError(
                    f"{name}={settings[name]} is written, and the device is not heard since: put "
                    f"{_ANSWERS_ELSEWHERE[name]}, and write it once more, which keeps it over a loss of "
                    "power; if it is not heard so either, switch it off and on: it then has one of the two"
                ) from error
        return {name: after[name] for name in settings}

    def advice(self, module: int, settings: Mapping[str, Any], rate_hz: float) -> Iterator[SettingAdvice]:
        """Yield what would be better otherwise. rate_hz: of the poses."""
        command = f"mocap-gateway modules set {module} {{}} --allow-writes"
        content, hz, baud = settings["content"], settings["rate"], settings["baud"]
        missing = [name for name in _WANTED if name not in content]
        if missing:
            wanted = ",".join(name for name in _CONTENT if name in {*content, *missing})
            what = " and no ".join(name.replace("_", " ") for name in missing)
            yield SettingAdvice(f"sends no {what}", command.format(f"content={wanted}"))
        if hz < LEAST_RATE_SHARE * rate_hz:
            enough = min((each for each in _RATE_OF if each >= rate_hz), default=max(_RATE_OF))
            yield SettingAdvice(
                f"sends {hz:g} samples a second for {rate_hz:g} poses", command.format(f"rate={enough:g}")
            )
        load = hz * self._packet_bits * len(content) / baud
        if load > _COMFORTABLE:
            least = ",".join(name for name in _CONTENT if name in {*_WANTED} & {*content} | {*missing})
            yield SettingAdvice(
                f"{len(content)} packets × {hz:g} Hz take {load:.0%} of {baud:,} bit/s: some are never sent",
                f"{command.format(f'content={least}')}; or a faster line: baud=, then the same in url",
            )

    async def _write_register(self, line: CommandLine, register: int, value: int) -> None:
        await line.send(encode_write(*UNLOCK))
        await line.send(encode_write(register, value))

    async def _read_back(self, line: CommandLine, name: str) -> Any:
        value = await _read(line, REGISTERS_BY_NAME[name].address)
        if name == "content":
            return [word for bit, word in enumerate(_CONTENT) if value >> bit & 1]
        return self._choices(name).get(value, value)

    def _choices(self, name: str) -> Mapping[int, float]:
        """Return what a register's numbers mean; nothing where they mean themselves."""
        return {"rate": RATES_HZ, "baud": self._bauds}.get(name, {})

    def _meant(self, name: str, value: Any) -> int:
        """Return what to write. Raises ``DeviceError``."""
        register = REGISTERS_BY_NAME.get(name)
        if register is None or not register.is_writable:
            can = ", ".join(name for name, each in REGISTERS_BY_NAME.items() if each.is_writable)
            raise DeviceError(f"'{name}' cannot be set on a WitMotion device; what can: {can}")
        if name == "content":
            words = value if isinstance(value, list) else str(value).split(",")
            if strange := [word for word in words if word not in _CONTENT]:
                raise DeviceError(f"content={','.join(strange)}: unknown; there is: {', '.join(_CONTENT)}")
            return sum(1 << _CONTENT.index(word) for word in set(words))
        choices = self._choices(name)
        number = next(
            (number for number, each in choices.items() if each == value), None if choices else value
        )
        if not isinstance(number, int) or not register.least <= number <= register.most:
            can = (
                ", ".join(f"{each:.10g}" for each in choices.values())
                or f"{register.least} to {register.most}"
            )
            raise DeviceError(f"{name}={value}: can be {can}")
        return number


class WitMotionCanCommands(WitMotionCommands):
    """On a CAN bus the register of the bit rate means others."""

    _bauds = CAN_BAUDS
    _packet_bits = _CAN_FRAME_BITS


async def _read(line: CommandLine, register: int) -> int:
    found = await line.request(
        encode_write(READ_ADDRESS, register),
        lambda message: message if isinstance(message, Values) else None,
        f"register 0x{register:02X}",
    )
    return found.values[0]


def _clipped(message: Inertial) -> int:
    force = max(map(abs, message.specific_force)) >= _END * RANGE_G
    rate = max(map(abs, message.angular_rate)) >= _END * RANGE_DEG_S
    return Clipped.SPECIFIC_FORCE * force | Clipped.ANGULAR_RATE * rate
