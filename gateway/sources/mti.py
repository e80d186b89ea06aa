"""Xsens MTi devices as a source: one device a serial line (Xbus), or a CAN bus."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Iterator, Mapping
from typing import TYPE_CHECKING, Any, ClassVar, Literal, TypeVar

from devices.commands.device_errors import DeviceError, UnfinishedError
from devices.link import Chunk
from devices.vendor_protocols.mti import (
    CLIPPED,
    EVERY_PACKET,
    ITEMS,
    TICK_US,
    Measurement,
    Message,
    Mid,
    MtiCanDecoder,
    MtiDecoder,
    Reply,
    encode,
    encode_output_configuration,
    read_output_configuration,
)
from firmware_protocol import InertialSample
from gateway.frames import NOT_READ, Clipped, Sample
from gateway.sources.makers import (
    LEAST_RATE_SHARE,
    MAGNETIC,
    CommandLine,
    Description,
    MakersDecoder,
    MakersDevice,
    MakersLinkSettings,
    MakersSource,
    SettingAdvice,
    StampCounter,
    cannot_blink,
    identity,
    scaled,
)

if TYPE_CHECKING:
    from gateway.sources.module_table import ModuleTable
    from gateway.sources.statistics import ModuleRecord

_USED = frozenset({"acceleration", "rate_of_turn", "magnetic_field"})
_WANTED = ("packet_counter", "sample_time_fine", "acceleration", "rate_of_turn")
_CLIPPED = {
    CLIPPED["acceleration"]: Clipped.SPECIFIC_FORCE,
    CLIPPED["rate_of_turn"]: Clipped.ANGULAR_RATE,
}

_Found = TypeVar("_Found")


class MtiLinkSettings(MakersLinkSettings):
    """One MTi of Xsens on a serial line."""

    carries: Literal["mti"] = "mti"


class MtiCanLinkSettings(MakersLinkSettings):
    """One MTi of Xsens on a CAN bus."""

    carries: Literal["mti_can"] = "mti_can"


class MtiDevice(MakersDevice):
    """A device counts its packets, all that it sends, and stamps them in steps of 100 µs."""

    new_decoder: ClassVar[Callable[[], MakersDecoder]] = MtiDecoder

    def __init__(self, settings: MakersLinkSettings) -> None:
        super().__init__(settings)
        self._by_stamp = StampCounter()
        self._newest = -1

    def sample(self, message: Message, modules: ModuleTable, chunk: Chunk) -> Sample | None:
        """Return the sample that a measurement holds; None where it holds none."""
        if isinstance(message, Reply):
            self._note(message, modules)
            return None
        stamp_us = _stamp_us(message)
        if stamp_us is None:  # its instant is not known
            self.decoder.unused += 1
            return None
        record, time_ns = modules.timed(self.module, stamp_us % 2**32, chunk)
        number = self._number(message, stamp_us, record, modules, chunk)
        values = message.values
        field = NOT_READ
        if "magnetic_field" in values and not (message.whole("status_word") or 0) & CLIPPED["magnetic_field"]:
            x, y, z = values["magnetic_field"]
            field = scaled((x, y, z), self.settings.field_ut)
        if number is None or not _USED & values.keys():
            self.without_reading += 1
            return None
        if "acceleration" in values and "rate_of_turn" in values:
            (fx, fy, fz), (wx, wy, wz) = values["acceleration"], values["rate_of_turn"]
            self._newest = number
            measured = (fx, fy, fz), (wx, wy, wz), field
            return Sample(self.module, number, time_ns, measured, _clipped(message))
        return Sample(self.module, self._newest, time_ns, (NOT_READ, NOT_READ, field))

    def _number(
        self, message: Measurement, stamp_us: int, record: ModuleRecord, modules: ModuleTable, chunk: Chunk
    ) -> int | None:
        counter, losses = record.counter(InertialSample.KIND), modules.losses(chunk.link)
        count = message.whole("packet_counter")
        if count is None:
            return counter.count_unwrapped(self._by_stamp.number(stamp_us), losses)
        return counter.count(count, losses)

    def _note(self, reply: Reply, modules: ModuleTable) -> None:
        record = modules.records.get(self.module)
        if record is None:
            return
        if reply.mid == Mid.REQUEST_DEVICE_ID + 1 and reply.data:
            record.info = identity(reply.data[-12:])
        elif reply.mid == Mid.GO_TO_MEASUREMENT + 1:  # what it did not measure meanwhile is not lost
            record.counter(InertialSample.KIND).restart()
            self._by_stamp.restart()


class MtiSource(MakersSource):
    """All MTi on serial lines."""

    carries = "mti"
    settings = MtiLinkSettings
    device = MtiDevice


class MtiCanDevice(MtiDevice):
    """On CAN the magnetic field comes after the rest of an instant, under the same count."""

    new_decoder = MtiCanDecoder

    def _number(
        self, message: Measurement, stamp_us: int, record: ModuleRecord, modules: ModuleTable, chunk: Chunk
    ) -> int | None:
        if "acceleration" in message.values:
            return super()._number(message, stamp_us, record, modules, chunk)
        counter = record.counter(InertialSample.KIND | MAGNETIC)
        return counter.count_unwrapped(counter.received, modules.losses(chunk.link))


class MtiCanSource(MakersSource):
    """All MTi on CAN buses."""

    carries = "mti_can"
    settings = MtiCanLinkSettings
    device = MtiCanDevice


class MtiCommands:
    """Asked and set in its configuration mode, in which it measures nothing: some samples are missed."""

    async def describe(self, line: CommandLine) -> Description:
        """Ask for its number and firmware."""

        async def request() -> Description:
            number = await _answered(line, Mid.REQUEST_DEVICE_ID)
            firmware = await _answered(line, Mid.REQUEST_FIRMWARE)
            return Description(number.hex(), "MTi", ".".join(map(str, firmware[:3])) or None)

        return await _configuring(line, request)

    async def identify(self, line: CommandLine, seconds: int) -> None:
        """Raise ``GatewayError``: an MTi has no light to blink."""
        raise cannot_blink("an MTi has no light to blink")

    async def read(self, line: CommandLine) -> dict[str, Any]:
        """Return the rates in Hz of all that it can send; 0: it does not."""

        async def request() -> dict[str, Any]:
            sent = read_output_configuration(await _answered(line, Mid.OUTPUT_CONFIGURATION))
            return dict(sent) | {name: 0 for name in ITEMS if name not in sent}

        return await _configuring(line, request)

    async def write(self, line: CommandLine, settings: Mapping[str, Any]) -> dict[str, Any]:
        """Send items at rates in Hz, none of those at 0; the device keeps that over a loss of power."""
        for name, rate in settings.items():
            if name not in ITEMS:
                raise DeviceError(f"an MTi sends no '{name}'; what it can send: {', '.join(ITEMS)}")
            if not isinstance(rate, int) or not 0 <= rate <= EVERY_PACKET:
                raise DeviceError(f"{name}={rate}: a rate in whole Hz is needed; 0: not at all")

        async def change() -> dict[str, Any]:
            stood = read_output_configuration(await _answered(line, Mid.OUTPUT_CONFIGURATION))
            # The whole list is sent each time: what is left out of it, the device stops sending.
            wanted = {name: rate for name, rate in {**stood, **settings}.items() if rate and name in ITEMS}
            data = encode_output_configuration(wanted)
            after = read_output_configuration(await _answered(line, Mid.OUTPUT_CONFIGURATION, data))
            return {name: after.get(name, 0) for name in settings}

        return await _configuring(line, change)

    def advice(self, module: int, settings: Mapping[str, Any], rate_hz: float) -> Iterator[SettingAdvice]:
        """Yield what would be better otherwise. rate_hz: of the poses."""
        command = f"mocap-gateway modules set {module} {{}} --allow-writes"
        for name in _WANTED:
            if not settings.get(name):
                rate = EVERY_PACKET if isinstance(ITEMS[name].layout, str) else round(rate_hz)
                yield SettingAdvice(f"sends no {name.replace('_', ' ')}", command.format(f"{name}={rate}"))
        for name in ("acceleration", "rate_of_turn"):
            if 0 < settings.get(name, 0) < LEAST_RATE_SHARE * rate_hz:
                found = (
                    f"sends {name.replace('_', ' ')} {settings[name]} times a second for {rate_hz:g} poses"
                )
                yield SettingAdvice(found, command.format(f"{name}={round(rate_hz)}"))
        if not settings.get("status_word"):
            yield SettingAdvice(
                "does not say when a sensor is clipped", command.format(f"status_word={EVERY_PACKET}")
            )


async def _configuring(line: CommandLine, work: Callable[[], Awaitable[_Found]]) -> _Found:
    """Do something in configuration mode, and have the device measure again whatever comes of it."""
    await _answered(line, Mid.GO_TO_CONFIG)
    try:
        return await work()
    finally:
        try:
            await _answered(line, Mid.GO_TO_MEASUREMENT)
        except DeviceError as error:
            raise UnfinishedError(
                f"{error}; it may still be in its configuration mode, measuring nothing: switch it "
                "off and on, or ask it again, as with `mocap-gateway modules list`"
            ) from error


async def _answered(line: CommandLine, mid: Mid, data: bytes = b"") -> bytes:
    reply = await line.request(
        encode(mid, data),
        lambda message: message if _is_answer(message, mid) else None,
        mid.name.lower().replace("_", " "),
    )
    if reply.mid == Mid.ERROR:
        raise DeviceError(f"the device refuses '{mid.name.lower()}': error {reply.data.hex()}")
    return bytes(reply.data)


def _is_answer(message: object, mid: Mid) -> bool:
    return isinstance(message, Reply) and message.mid in (mid + 1, Mid.ERROR)


def _stamp_us(message: Measurement) -> int | None:
    ticks, on_can_us = message.whole("sample_time_fine"), message.whole("sample_time_us")
    return on_can_us if ticks is None else ticks * TICK_US


def _clipped(message: Measurement) -> int:
    status = message.whole("status_word") or 0
    return sum(int(flag) for bits, flag in _CLIPPED.items() if status & bits)
