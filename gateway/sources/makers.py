"""Modules of other makers: one device a link, and the link says which module of the rig it is.

A maker is a file beside this one: a ``MakersDevice`` that turns what its decoder read into samples, a
``MakersSource`` that names it, and where its devices take commands, ``MakersCommands``. Clocks, counters,
losses, balances and strangers on the link are dealt with here, for all of them.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Awaitable, Callable, Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Protocol, Self, TypeVar

from pydantic import Field

from devices.commands.device_errors import DeviceError
from devices.link import Chunk, SentChunk
from firmware_protocol import DeviceInfo, Health
from gateway.contract.balances import Balance
from gateway.frames import FusedReading, InertialBatch, Sample, Vector3
from gateway.sources.link_settings import LinkSettings
from gateway.sources.source import ListeningSource, SourceContext

if TYPE_CHECKING:
    from gateway.sources.module_table import ModuleTable

ANOTHER_SENDER = "another_sender"
"""Reason for which datagrams of a second device on a link are dropped."""
MAGNETIC = 1 << 9
"""Added to the kind of inertial samples: what comes of a magnetometer by itself is counted by itself."""
TALK_S = 0.05
"""How often those that await being spoken to are asked what is due."""
LEAST_RATE_SHARE = 0.9
"""Of the poses' rate, below which a device is too slow for them."""
_INTERVALS, _FEWEST_INTERVALS = 31, 8
"""Between stamps: of so many the lower quartile is the interval of the samples, once there are some."""

LEAP_IN_NUMBER = "leap_in_number"
"""Reason for which a message with a number, or a stamp, far from those before is dropped."""
_OVERTAKEN, _MISSED = 64, 10_000
"""By how much a number may be behind the newest one, and before it."""
_LONGEST_INTERVAL_MS = 200
"""Between the stamps of two numbers that follow on each other."""

_Found = TypeVar("_Found")


class OthersLinkSettings(LinkSettings):
    """Modules of another maker: one, or several that share a link."""

    @property
    def modules(self) -> tuple[int, ...]:
        """Numbers under which the rig knows those on the link."""
        raise NotImplementedError

    @property
    def own_numbers(self) -> tuple[int, ...]:
        """Those of them that no device of another link can have."""
        return self.modules

    @classmethod
    def unknown(cls, name: str, content: str) -> Self:
        """Return what is said of a link of a recording whose configuration says nothing of it."""
        raise NotImplementedError


class MakersLinkSettings(OthersLinkSettings):
    """One device of another maker."""

    module: int = Field(
        ge=0, le=254, description="for a link of one module: number under which the rig knows it"
    )
    field_ut: float = Field(
        default=49,
        gt=0,
        le=100,
        description="for magnetometers that send shares of the field they were calibrated in: its strength, "
        "µT; of the earth where that was done",
    )

    @property
    def modules(self) -> tuple[int, ...]:
        """Its number, alone."""
        return (self.module,)

    @classmethod
    def unknown(cls, name: str, content: str) -> Self:
        """Return the settings of a device without a number."""
        return cls(name=name, url="recording:", carries=content, module=0)


class MakersDecoder(Protocol):
    """Bytes of one device to its messages; never raises for what they hold."""

    dropped: Counter[str]
    """What could not be read, by reason."""
    unused: int
    """Messages of kinds that nothing is made from."""

    def feed(self, data: bytes) -> Sequence[Any]:
        """Return the messages that the bytes complete."""


class MakersDevice:
    """What is known of the device on one link, or of all that share it. A maker's own extends this."""

    new_decoder: ClassVar[Callable[[], MakersDecoder]]

    def __init__(self, settings: Any) -> None:
        """Serve one device; ``settings`` are those of its link, of the class that its source names."""
        self.settings = settings
        self.decoder = type(self).new_decoder()
        self.without_reading = 0
        """Packets counted that gave no reading: they had come before, or hold nothing that is read."""
        self.is_damaged = False
        """Something of the last chunk could not be read."""
        self.sender: str | None = None
        """Address of the device, on a link with several senders; None before it was heard."""
        self.made: Counter[type[InertialBatch | FusedReading]] = Counter()
        """Samples and orientations that its messages gave."""
        self._strange: Counter[str] = Counter()

    @property
    def module(self) -> int:
        """Number under which the rig knows it."""
        module: int = self.settings.module
        return module

    @property
    def modules(self) -> tuple[int, ...]:
        """Numbers of all on the link."""
        numbers: tuple[int, ...] = self.settings.modules
        return numbers

    def module_of(self, message: Any, chunk: Chunk) -> int | None:
        """Return the number of the device that a message is from; None: of none that the rig knows."""
        return self.module

    @property
    def dropped(self) -> Counter[str]:
        """What could not be read, by reason."""
        return self.decoder.dropped + self._strange

    def sample(self, message: Any, modules: ModuleTable, chunk: Chunk) -> Sample | None:
        """Return the sample that a message is; None where it is none, or one that came before."""
        raise NotImplementedError

    def readings(self, message: Any, modules: ModuleTable, chunk: Chunk) -> Iterable[Sample | FusedReading]:
        """Return all that a message gives, for makers whose messages are more than one sample."""
        sample = self.sample(message, modules, chunk)
        return () if sample is None else (sample,)

    def framed(self, command: bytes) -> bytes:
        """Return a command as it is written to the link."""
        return command

    @property
    def unused(self) -> int:
        """Messages that nothing is made from."""
        return self.decoder.unused

    def command_address(self, module: int) -> str:
        """Return where a device takes commands, on a link with several senders."""
        return self.sender or ""

    def due(self, now_ns: int) -> Sequence[tuple[bytes, str]]:
        """Return what is to be sent by now, each with its addressee, where a device waits for it.

        Asked every ``TALK_S``; what the readings depend on changes in ``receive`` and ``sent`` alone.
        """
        return ()

    def sent(self, chunk: SentChunk) -> None:
        """Take note of what was put on the link."""

    def findings(self, rate_hz: float) -> Iterator[SettingAdvice]:
        """Yield what would be better otherwise, as far as listening shows. rate_hz: of the poses."""
        yield from ()

    def feed(self, chunk: Chunk) -> Sequence[Any]:
        """Return the messages of the device; those of another sender are counted, since it has the number."""
        if self.sender not in (None, chunk.sender):
            self._strange[ANOTHER_SENDER] += 1
            return ()
        messages = self._decoded(self.decoder, chunk)
        if messages:
            self.sender = chunk.sender
        return messages

    def _decoded(self, decoder: Any, chunk: Chunk) -> Sequence[Any]:
        """Return the messages of a chunk; note whether any of it was damaged."""
        before = decoder.dropped.total()
        messages: Sequence[Any] = decoder.feed(chunk.data)
        self.is_damaged = decoder.dropped.total() != before
        return messages


SampleWatcher = Callable[[Sequence[Sample], Chunk], None]
"""Called with the samples that a chunk gave. Must neither wait nor raise."""
Listener = Callable[[Any], None]
"""Called with every message of a module. Must neither wait nor raise."""


class MakersSource(ListeningSource):
    """All links of one maker's devices."""

    observes = InertialBatch
    carries: ClassVar[str]
    """The configuration's word for it."""
    settings: ClassVar[type[OthersLinkSettings]]
    device: ClassVar[type[MakersDevice]]

    def __init__(self, context: SourceContext) -> None:
        self.modules = context.modules
        """Of all sources."""
        self.devices: dict[str, MakersDevice] = {}
        """By link."""
        self._links = context.links
        self._listeners: dict[tuple[str, int | None], list[Listener]] = {}
        self.watchers: list[SampleWatcher] = []
        """Called with all samples, beside what takes them."""
        self._accepted = 0

    def add_link(self, name: str, content: str) -> None:
        """Announce a device."""
        settings = self._links.get(name)
        if not isinstance(settings, self.settings):
            settings = self.settings.unknown(name, content)
        self.devices[name] = self.device(settings)
        self.modules.add_link(name)

    def receive(self, chunk: Chunk) -> list[InertialBatch | FusedReading]:
        """Return the samples that a chunk completes, and orientations fused on board."""

        device = self.devices[chunk.link]
        messages = device.feed(chunk)
        self.modules.begin_chunk(chunk, is_damaged=device.is_damaged)

        rows: list[Sample] = []
        found: list[InertialBatch | FusedReading] = []
        for message in messages:
            for reading in device.readings(message, self.modules, chunk):
                if isinstance(reading, FusedReading):
                    found.append(reading)
                else:
                    rows.append(reading)
            if self._listeners:
                for listener in self._listeners.get((chunk.link, device.module_of(message, chunk)), ()):
                    listener(message)
        # Watchers see samples as they came: shaking a module is found before any correction.
        for watch in self.watchers if rows else ():
            watch(rows, chunk)
        device.made[FusedReading] += len(found)
        device.made[InertialBatch] += len(rows)
        self._accepted += len(rows) + len(found)
        return [*found, InertialBatch.of(rows)] if rows else found

    def sent(self, chunk: SentChunk) -> None:
        """Take note of what the gateway put on one of the links."""
        self.devices[chunk.link].sent(chunk)

    def listen(self, link: str, module: int, listener: Listener) -> None:
        """Call a listener with every message of a module on a link, until ``stop_listening``."""
        self._listeners.setdefault((link, module), []).append(listener)

    def stop_listening(self, link: str, module: int, listener: Listener) -> None:
        """End what ``listen`` began."""
        self._listeners[link, module].remove(listener)
        if not self._listeners[link, module]:
            del self._listeners[link, module]

    def dropped(self) -> Mapping[str, Mapping[str, int]]:
        """Return what could not be read, by link and reason."""
        return {name: device.dropped for name, device in self.devices.items()}

    def statistics(self) -> Mapping[str, object]:
        """Return how many messages nothing is made from, by link."""
        return {self.carries: {name: {"unused": device.unused} for name, device in self.devices.items()}}

    def balances(self) -> Iterator[Balance]:
        """Yield the messages read, each of which is a sample."""
        others = sum(device.without_reading for device in self.devices.values())
        yield Balance("packets_decoded", self._accepted + others, {})
        yield Balance("readings", self._accepted, {})


class StreamCounter:
    """Continues the numbers of a stream that begins anew, as when a program is started again.

    What is far from all before, by its number or its stamp, is believed when the next one follows on it: one
    wrong stamp would date an instant, and all that is held until then, into the future.
    """

    def __init__(self) -> None:
        self._newest: tuple[int, int] | None = None
        """Number and stamp, ms."""
        self._strange: tuple[int, int] | None = None
        self._shift = 0

    def number(self, number: int, stamp_ms: int) -> int | None:
        """Return the number of an instant, from one that goes on; None: it is not believed yet."""
        here = number, stamp_ms
        if self._newest is None or _goes_on(self._newest, here, _OVERTAKEN, _MISSED):
            self._newest = here if self._newest is None else max(here, self._newest)
        # Two strange numbers that go on from each other are believed: the device counts from anew.
        elif self._strange is not None and _goes_on(self._strange, here, 0, _OVERTAKEN):
            # Too far away to be late or lost packets: numbers are shifted to go on where they were.
            if not -_OVERTAKEN <= number - self._newest[0] <= _MISSED:
                self._shift += self._newest[0] + 1 - number
            self._newest = here
        else:
            self._strange = here
            return None
        self._strange = None
        return number + self._shift


def _goes_on(before: tuple[int, int], here: tuple[int, int], behind: int, ahead: int) -> bool:
    """Return whether number and stamp, ms, follow on others, by at most so many numbers behind or ahead."""
    step, since_ms = here[0] - before[0], here[1] - before[1]
    return -behind <= step <= ahead and abs(since_ms) <= _LONGEST_INTERVAL_MS * max(1, abs(step))


class StampCounter:
    """Numbers samples that have stamps and no numbers, by their interval: so that lost ones leave a gap."""

    def __init__(self) -> None:
        self.newest = -1
        """Number of the newest sample."""
        self._stamp_us: int | None = 0
        self._intervals: deque[int] = deque(maxlen=_INTERVALS)

    def restart(self) -> None:
        """Take the next sample, whatever its stamp, for the one that follows: nothing was sent in between."""
        self._stamp_us = None

    def number(self, stamp_us: int) -> int:
        """Return the number of the next sample; of one that is no later than the one before, the next."""
        follows = self._stamp_us is None
        interval = 0 if self._stamp_us is None else stamp_us - self._stamp_us
        self._stamp_us = stamp_us
        if interval <= 0 and not follows:
            self._intervals.clear()
        step = 1
        if len(self._intervals) >= _FEWEST_INTERVALS:
            # A low quantile of the intervals, as losses only make them longer.
            usual = sorted(self._intervals)[len(self._intervals) // 4]
            step = max(1, round(interval / usual))
        if interval > 0 and self.newest >= 0:
            self._intervals.append(interval)
        self.newest += step
        return self.newest


def scaled(vector: Vector3, factor: float) -> Vector3:
    """Return a vector in other units."""
    x, y, z = vector
    return factor * x, factor * y, factor * z


def health(temperature_celsius: float | None = None) -> Health:
    """Return how a device fares that counts nothing of its own."""
    return Health(None, None, temperature_celsius, None, 0, 0, 0, 0, 0)


def identity(unique_id: bytes, firmware: tuple[int, int, int] = (0, 0, 0)) -> DeviceInfo:
    """Return who a device is: its serial number, which is shorter than that of our own."""
    return DeviceInfo(unique_id, (0, 0), firmware, *[None] * 6)


class Description(NamedTuple):
    """Who is at the other end of a link."""

    unique_id: str
    """Serial number, hexadecimal, lower case."""
    name: str = ""
    firmware: str | None = None


def cannot_blink(why: str) -> DeviceError:
    """Return the error of a device that has no light for the gateway to switch, with what does instead."""
    return DeviceError(f"{why}: shake it, and see in `mocap-gateway view` which segment moves")


class SettingAdvice(NamedTuple):
    """Something in a device's settings that a gateway would have otherwise."""

    found: str
    remedy: str


class CommandLine(Protocol):
    """The way to one device, and back."""

    @property
    def module(self) -> int:
        """Its number in the rig."""
        ...

    @property
    def device(self) -> MakersDevice:
        """What is known of it, and of those that share its link."""
        ...

    async def send(self, data: bytes) -> None:
        """Write to the device. Raises ``LinkError``."""
        ...

    def request(self, data: bytes, meant: Callable[[Any], _Found | None], what: str) -> Awaitable[_Found]:
        """Write until a message comes for which ``meant`` returns something, and return that.

        what: is asked for, for people. Raises ``LinkError``, and ``NoAnswerError`` where none comes.
        """
        ...


class MakersCommands(Protocol):
    """What may be asked of a maker's devices. What a device cannot do raises ``DeviceError``."""

    async def describe(self, line: CommandLine) -> Description:
        """Return what the device says of itself. Raises ``GatewayError`` if it does not answer."""

    async def identify(self, line: CommandLine, seconds: int) -> None:
        """Make it blink."""
        ...

    async def read(self, line: CommandLine) -> dict[str, Any]:
        """Return its settings by name."""
        ...

    async def write(self, line: CommandLine, settings: Mapping[str, Any]) -> dict[str, Any]:
        """Change settings, keep them over a loss of power, and return what stands there now."""
        ...

    def advice(self, module: int, settings: Mapping[str, Any], rate_hz: float) -> Iterator[SettingAdvice]:
        """Yield what would be better otherwise in settings that were read. rate_hz: of the poses."""
        ...


class Announced(NamedTuple):
    """A device that announces itself in the network."""

    carries: str
    name: str
    unique_id: str
    url: str
    """For the link that reads it."""
    more: Mapping[str, object] = {}
    """What the configuration of that link must say besides."""
    battery_percent: int | None = None
    rssi_percent: int | None = None
    entry: tuple[str, str] | None = None
    """On a link that several share: the setting that lists them, and what it is called there."""


class Discovery(NamedTuple):
    """How devices of a maker are found in the network."""

    port: int
    """UDP port that they announce themselves on."""
    read: Callable[[bytes], Announced | None]
    """Datagram to what it announces; None: not one of theirs."""
