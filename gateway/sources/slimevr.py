"""SlimeVR trackers as a source: all that send to one UDP port, told apart by their address on the network.

They send orientations to a level reference of their own and linear acceleration, with no stamp. From these
what their sensors felt is made again (``unfused``), since the gateway's filter removes the drift of headings
and theirs cannot.
"""

from __future__ import annotations

import ipaddress
import re
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Literal, Self

from pydantic import Field, field_validator

from devices.commands.device_errors import DeviceError
from devices.deferred import Deferred
from devices.link import Chunk, SentChunk
from devices.vendor_protocols import slimevr as wire
from devices.vendor_protocols.slimevr import (
    Acceleration,
    Battery,
    Features,
    Handshake,
    Kind,
    Message,
    Pong,
    Rotation,
    SensorInfo,
    SettingDone,
    Signal,
    SlimevrDecoder,
    Temperature,
)
from firmware_protocol import InertialSample
from gateway.errors import nearest
from gateway.frames import NOT_READ, Sample
from gateway.sources.makers import (
    LEAST_RATE_SHARE,
    Announced,
    CommandLine,
    Description,
    Discovery,
    MakersDevice,
    MakersSource,
    OthersLinkSettings,
    SettingAdvice,
    cannot_blink,
    health,
    identity,
)

if TYPE_CHECKING:
    from gateway.sources.module_table import ModuleTable
    from gateway.sources.unfused import UnfusedSensor

BEATS_S = 0.5
"""Between two heartbeats, and two pings; a tracker that receives nothing for three seconds looks for its
server again."""
FORGOTTEN_S = 10.0
"""A tracker silent for so long is spoken to no more."""
_MOST_TRACKERS, _MOST_REPLIES = 64, 256
_TOKENS = 1 << 16
_OLD_ACCELERATION = 1 << 31
"""Bit of a ping's token, which also names the tracker by its place in the configuration: who returns it can
be told in a recording that began after the handshake."""
_new_sensor: Callable[[], UnfusedSensor] = Deferred("gateway.sources.unfused", "UnfusedSensor")


class SlimevrLinkSettings(OthersLinkSettings):
    """All SlimeVR trackers that send to a UDP port."""

    carries: Literal["slimevr"] = "slimevr"
    trackers: Mapping[str, int] = Field(
        default_factory=dict,
        description="for slimevr: number in the rig of each tracker, by its MAC or IP address; a second "
        "sensor is /1 behind that: {'a4:e5:7c:00:00:01': 0, 'a4:e5:7c:00:00:01/1': 1, 192.168.1.32: 2}",
    )

    @field_validator("trackers")
    @classmethod
    def _are_addresses(cls, given: Mapping[str, int]) -> Mapping[str, int]:
        found: dict[str, int] = {}
        for key, module in given.items():
            name = _normal(key)
            if not 0 <= module <= 254:
                raise ValueError(f"'{key}': {module} is no number of a module: 0 to 254")
            if module in found.values():
                raise ValueError(f"'{key}': module {module} is another tracker's already")
            found[name] = module
        return found

    @property
    def modules(self) -> tuple[int, ...]:
        """Numbers of all trackers."""
        return tuple(self.trackers.values())

    @classmethod
    def unknown(cls, name: str, content: str) -> Self:
        """Return the settings of a link with no tracker that has a number."""
        return cls(name=name, url="recording:")


def _normal(key: str) -> str:
    """Return a tracker's key as ``mac/sensor`` or ``address/sensor``. Raises ``ValueError``."""
    address, _, sensor = key.strip().lower().partition("/")
    mac = re.sub(r"[:-]", "", address)
    if not re.fullmatch(r"[0-9a-f]{12}", mac):
        try:
            mac = str(ipaddress.ip_address(address))
        except ValueError:
            wanted = "a MAC address such as a4:e5:7c:00:00:01, or an IP address"
            raise ValueError(f"'{key}' is no tracker: {wanted}; /1 behind it for a second sensor") from None
    if not (sensor or "0").isdecimal() or int(sensor or 0) > 254:
        raise ValueError(f"'{key}': '{sensor}' is no number of a sensor: 0, 1 …")
    # The first sensor may be left out, or written as /0.
    return f"{mac}/{int(sensor or 0)}"


@dataclass
class _Tracker:
    """One device with its sensors."""

    sender: str
    key: str
    """Its MAC address, or that on the network."""
    decoder: SlimevrDecoder = field(default_factory=SlimevrDecoder)
    firmware: str = ""
    has_old_axes: bool = False
    """Acceleration comes a quarter turn about z away from orientation."""
    infos: dict[int, SensorInfo] = field(default_factory=dict)
    health: Any = field(default_factory=health)
    received_ns: int = 0


class SlimevrDevice(MakersDevice):
    """All trackers on one port, and the server that they look for."""

    new_decoder = SlimevrDecoder

    def __init__(self, settings: SlimevrLinkSettings) -> None:
        super().__init__(settings)
        self.trackers: dict[str, _Tracker] = {}
        """By address on the network."""
        self._keys = sorted({key.partition("/")[0] for key in settings.trackers})
        self._gone: Counter[str] = Counter()
        self._gone_unused = 0
        self._asked: dict[int, tuple[int, int]] = {}
        self._replies: deque[tuple[bytes, str]] = deque(maxlen=_MOST_REPLIES)
        self._beaten_ns: dict[str, int] = {}
        self._token = 0
        self._unknown_trackers: dict[str, str] = {}
        self._sensors: dict[int | None, UnfusedSensor] = {}

    @property
    def dropped(self) -> Counter[str]:
        """What could not be read, by reason."""
        leaps = sum(sensor.leaps for sensor in self._sensors.values())
        found = self._gone + self._strange + Counter(leap_in_orientation=leaps)
        for tracker in self.trackers.values():
            found += tracker.decoder.dropped
        return found

    @property
    def unused(self) -> int:
        """Messages that nothing is made from."""
        return self._gone_unused + sum(tracker.decoder.unused for tracker in self.trackers.values())

    def feed(self, chunk: Chunk) -> Sequence[Message]:
        """Return the messages of a datagram, and note what is to be answered."""
        tracker = self.trackers.get(chunk.sender) or self._met(chunk)
        if tracker is None:
            return ()
        messages = self._decoded(tracker.decoder, chunk)
        if messages:
            tracker.received_ns = chunk.arrived_ns
        return messages

    def module_of(self, message: Message, chunk: Chunk) -> int | None:
        """Return the number of the sensor that a message is of; of the first one, if it is of none."""
        tracker = self.trackers.get(chunk.sender)
        return None if tracker is None else self._module(tracker, getattr(message, "sensor", 0))

    def sample(self, message: Message, modules: ModuleTable, chunk: Chunk) -> Sample | None:
        """Return the sample that a rotation completes: the one before it."""
        tracker = self.trackers[chunk.sender]
        match message:
            case Rotation():
                return self._rotated(tracker, message, modules, chunk)
            case Acceleration():
                linear = message.acceleration
                if tracker.has_old_axes:
                    # Older firmware turns its axes by a quarter about z.
                    linear = linear[1], -linear[0], linear[2]
                sensor = self._sensors.get(self._module(tracker, message.sensor))
                if sensor is not None:
                    sensor.acceleration = linear
            case Pong():
                self._returned(tracker, message, chunk)
            case SensorInfo():
                tracker.infos[message.sensor] = message
                # A tracker repeats its description until it is acknowledged.
                self._replies.append((wire.acknowledge(message.sensor, message.state), tracker.sender))
            case Features():
                flags = wire.BUNDLES | wire.COMPACT_BUNDLES
                self._replies.append((wire.encode(Kind.FEATURES, 0, bytes((flags,))), tracker.sender))
            case Handshake():
                self._shaken(tracker, message)
            case Battery() | Signal() | Temperature():
                self._note(tracker, message, modules)
        return None

    def command_address(self, module: int) -> str:
        """Return where a tracker is."""
        tracker, _ = self._of(module)
        return "" if tracker is None else tracker.sender

    def due(self, now_ns: int) -> Sequence[tuple[bytes, str]]:
        """Return answers, and heartbeats and pings of those that are heard."""
        datagrams = list(self._replies)
        self._replies.clear()
        for tracker in self.trackers.values():
            if now_ns - tracker.received_ns > FORGOTTEN_S * 1e9:
                continue
            if now_ns - self._beaten_ns.get(tracker.sender, 0) >= BEATS_S * 1e9:
                self._beaten_ns[tracker.sender] = now_ns
                datagrams.append((wire.encode(Kind.ROTATION), tracker.sender))
                datagrams.append((wire.ping(self._next_token(tracker)), tracker.sender))
        return datagrams

    def sent(self, chunk: SentChunk) -> None:
        """Note when a ping left."""
        # A ping is its kind, a number of eight bytes, and the token.
        if chunk.data[:4] == bytes((0, 0, 0, Kind.PING)) and len(chunk.data) == 16:
            token = int.from_bytes(chunk.data[12:], "big")
            self._asked[token % _TOKENS] = token, chunk.sent_ns

    def findings(self, rate_hz: float) -> Iterator[SettingAdvice]:
        """Yield who has no number, who is silent, and what a tracker's firmware lacks."""
        for key, firmware in self._unknown_trackers.items():
            yield SettingAdvice(
                f"a tracker {_shown(key)} ({firmware or 'no name'}) has no number",
                f"write it into the link: trackers: {{'{_shown(key)}': NUMBER}}",
            )
        for key, module in self.settings.trackers.items():
            found = self._sensors.get(module)
            if found is None or not found.line.interval_ns:
                yield SettingAdvice(
                    f"tracker {_shown(key)} (module {module}) sends no orientations",
                    "switch it on, in this machine's network; it stays with whoever answers first: close the "
                    "SlimeVR server",
                )
                continue  # without orientations nothing else can be said of the tracker
            if found.acceleration is None:
                yield SettingAdvice(
                    f"tracker {_shown(key)} (module {module}) sends no acceleration: without it joints "
                    "tell little",
                    "update its firmware",
                )
            sent_hz = 1e9 / found.line.interval_ns
            if sent_hz < LEAST_RATE_SHARE * rate_hz:
                yield SettingAdvice(
                    f"tracker {_shown(key)} (module {module}) sends {sent_hz:.0f} orientations a second for "
                    f"{rate_hz:g} poses",
                    f"assembly: {{rate_hz: {sent_hz:.0f}}} in the configuration",
                )

    def has_magnetometer(self, module: int) -> bool | None:
        """Return whether a tracker's magnetometer is on; None: it has none, or has not said so."""
        tracker, sensor = self._of(module)
        info = None if tracker is None else tracker.infos.get(sensor)
        # Bit 1 says that there is one, bit 0 that it is on.
        return None if info is None or not info.settings & 2 else bool(info.settings & 1)

    def identity_of(self, module: int) -> tuple[str, str]:
        """Return a tracker's key and firmware."""
        tracker, _ = self._of(module)
        return ("", "") if tracker is None else (tracker.key, tracker.firmware)

    def sensor_of(self, module: int) -> int:
        """Return which of its device's sensors a module is."""
        return self._of(module)[1]

    def note_setting(self, module: int, is_on: bool) -> None:
        """Take note that a magnetometer was switched."""
        tracker, sensor = self._of(module)
        if tracker is not None and sensor in tracker.infos:
            info = tracker.infos[sensor]
            tracker.infos[sensor] = replace(info, settings=info.settings & ~1 | is_on)

    def _of(self, module: int) -> tuple[_Tracker | None, int]:
        name = next((key for key, number in self.settings.trackers.items() if number == module), "/0")
        key, _, sensor = name.partition("/")
        return next((each for each in self.trackers.values() if each.key == key), None), int(sensor)

    def _module(self, tracker: _Tracker, sensor: int) -> int | None:
        found: int | None = self.settings.trackers.get(f"{tracker.key}/{sensor}")
        return found

    def _met(self, chunk: Chunk) -> _Tracker | None:
        """Return the tracker that speaks for the first time from an address; None: it is not known who."""
        message = next(iter(SlimevrDecoder().feed(chunk.data)), None)
        host = chunk.sender.rpartition(":")[0].strip("[]")
        if isinstance(message, Handshake):
            key = message.mac if message.mac in self._keys or host not in self._keys else host
        # One that is entered by its address is known without a handshake, which came before we listened.
        elif host in self._keys:
            key = host
        elif isinstance(message, Pong) and (returned := self._key_of(message.token)) is not None:
            key = returned
        else:
            self._strange["before_handshake"] += 1
            return None
        return self._take_on(_Tracker(chunk.sender, key or host))

    def _take_on(self, tracker: _Tracker) -> _Tracker | None:
        if tracker.key not in self._keys and len(self._unknown_trackers) < _MOST_TRACKERS:
            self._unknown_trackers[tracker.key] = tracker.firmware
        for sender, known in list(self.trackers.items()):
            if known.key == tracker.key:  # it comes from another port now
                self._forget(sender)
        if len(self.trackers) >= _MOST_TRACKERS:
            # Those without a number make room first, of each kind the one that is silent longest.
            silent = min(self.trackers.values(), key=lambda each: (each.key in self._keys, each.received_ns))
            if silent.key in self._keys:
                self._strange["too_many_trackers"] += 1
                return None
            self._forget(silent.sender)
        self.trackers[tracker.sender] = tracker
        return tracker

    def _forget(self, sender: str) -> None:
        gone = self.trackers.pop(sender)
        # What it counted stays counted: counters in the health message never fall.
        self._gone += gone.decoder.dropped
        self._gone_unused += gone.decoder.unused
        self._beaten_ns.pop(sender, None)

    def _shaken(self, tracker: _Tracker, sent: Handshake) -> None:
        tracker.firmware = sent.firmware
        tracker.has_old_axes = sent.version < wire.VERSION
        tracker.decoder.missed = 0
        for _, sensor in self._numbered_sensors(tracker):
            sensor.begin()
        if tracker.key in self._unknown_trackers:
            self._unknown_trackers[tracker.key] = sent.firmware
        self._replies.append((wire.GREETING, tracker.sender))

    def _rotated(
        self, tracker: _Tracker, message: Rotation, modules: ModuleTable, chunk: Chunk
    ) -> Sample | None:
        module = self._module(tracker, message.sensor)
        if module is None:
            self._strange["no_number"] += 1
            return None
        sensor = self._sensors.get(module) or self._sensors.setdefault(module, _new_sensor())
        arrival = sensor.arrived(tracker.decoder.missed, chunk.arrived_ns)
        record, time_ns = modules.timed(module, arrival.stamp_us, chunk, clock=sensor.clock)
        record.info = record.info or _info(tracker)
        # Counted for the statistics of loss alone; the reading has its number from the arrival.
        record.counter(InertialSample.KIND).count_unwrapped(arrival.number, modules.losses(chunk.link))
        felt = sensor.complete(arrival, time_ns, message.orientation)
        if felt is None:
            self.without_reading += 1
            return None
        measured = felt.specific_force, felt.angular_rate, NOT_READ
        return Sample(module, felt.number, felt.time_ns, measured)

    def _returned(self, tracker: _Tracker, pong: Pong, chunk: Chunk) -> None:
        token, sent_ns = self._asked.pop(pong.token % _TOKENS, (None, 0))
        if token != pong.token:
            return
        if not tracker.firmware:  # its handshake was before this recording
            tracker.has_old_axes = bool(pong.token & _OLD_ACCELERATION)
        for _, sensor in self._numbered_sensors(tracker):
            sensor.clock.add_round_trip(chunk.arrived_ns - sent_ns)

    def _note(self, tracker: _Tracker, message: Battery | Signal | Temperature, modules: ModuleTable) -> None:
        match message:
            case Battery(voltage, share):
                percent = round(100 * min(share, 1.0))
                tracker.health = replace(
                    tracker.health, battery_percent=percent, battery_voltage=round(voltage, 3)
                )
            case Signal(dbm):
                tracker.health = replace(tracker.health, rssi_dbm=dbm)
            case Temperature(celsius=celsius):
                tracker.health = replace(tracker.health, temperature_celsius=round(celsius, 2))
        for module, _ in self._numbered_sensors(tracker):
            modules.records[module].health = tracker.health

    def _numbered_sensors(self, tracker: _Tracker) -> Iterator[tuple[int, UnfusedSensor]]:
        """Yield the sensors of a tracker that have numbers and were heard, with these."""
        for key, module in self.settings.trackers.items():
            if key.partition("/")[0] == tracker.key and module in self._sensors:
                yield module, self._sensors[module]

    def _next_token(self, tracker: _Tracker) -> int:
        self._token = (self._token + 1) % _TOKENS
        place = self._keys.index(tracker.key) + 1 if tracker.key in self._keys else 0
        return self._token | place % 2**15 << 16 | (_OLD_ACCELERATION if tracker.has_old_axes else 0)

    def _key_of(self, token: int) -> str | None:
        """Return which tracker a ping that is outstanding went to."""
        place = (token & ~_OLD_ACCELERATION) >> 16
        is_ours = self._asked.get(token % _TOKENS, (None, 0))[0] == token
        return self._keys[place - 1] if is_ours and 0 < place <= len(self._keys) else None


def _info(tracker: _Tracker) -> Any:
    numbers = [int(part) for part in re.findall(r"\d+", tracker.firmware)[:3]] + [0, 0, 0]
    version = (min(numbers[0], 255), min(numbers[1], 255), min(numbers[2], 255))
    is_mac = re.fullmatch(r"[0-9a-f]{12}", tracker.key)
    return identity(bytes.fromhex(tracker.key) if is_mac else tracker.key.encode()[:12], version)


def _shown(key: str) -> str:
    """Return a tracker's key as people write it."""
    address, _, sensor = key.partition("/")
    if re.fullmatch(r"[0-9a-f]{12}", address):
        address = ":".join(address[place : place + 2] for place in range(0, 12, 2))
    return address if sensor in ("", "0") else f"{address}/{sensor}"


class SlimevrSource(MakersSource):
    """All ports to which trackers send."""

    carries = "slimevr"
    settings = SlimevrLinkSettings
    device = SlimevrDevice


class SlimevrCommands:
    """A tracker returns pings, and its magnetometer can be switched where it has one."""

    async def describe(self, line: CommandLine) -> Description:
        """Wait until it returns a ping, and return what it sent when it was greeted."""
        device = line.device
        assert isinstance(device, SlimevrDevice)
        await line.request(
            wire.ping(0), lambda message: message if isinstance(message, Pong) else None, "ping"
        )
        key, firmware = device.identity_of(line.module)
        return Description(key, "SlimeVR", firmware or None)

    async def identify(self, line: CommandLine, seconds: int) -> None:
        """Raise ``GatewayError``: a SlimeVR tracker knows no command for its light."""
        raise cannot_blink("a SlimeVR tracker knows no command for its light")

    async def read(self, line: CommandLine) -> dict[str, Any]:
        """Return what can be set, as the tracker sent it."""
        device = line.device
        assert isinstance(device, SlimevrDevice)
        is_on = device.has_magnetometer(line.module)
        return {} if is_on is None else {"magnetometer": is_on}

    async def write(self, line: CommandLine, settings: Mapping[str, Any]) -> dict[str, Any]:
        """Switch its magnetometer; the tracker keeps that."""
        device = line.device
        assert isinstance(device, SlimevrDevice)
        for name, value in settings.items():
            if name != "magnetometer":
                raise DeviceError(
                    f"a SlimeVR tracker has no setting '{name}'{nearest(name, ['magnetometer'])}"
                )
            if not isinstance(value, bool):
                raise DeviceError(f"magnetometer={value}: true or false is needed")
            if device.has_magnetometer(line.module) is None:
                raise DeviceError("the tracker says that it has no magnetometer to switch")
            sensor = device.sensor_of(line.module)
            await line.request(
                wire.set_setting(sensor, wire.MAGNETOMETER, value),
                lambda message: message if isinstance(message, SettingDone) else None,
                name,
            )
            device.note_setting(line.module, value)
        return dict(settings)

    def advice(self, module: int, settings: Mapping[str, Any], rate_hz: float) -> Iterator[SettingAdvice]:
        """Yield what would be better otherwise. rate_hz: of the poses."""
        if settings.get("magnetometer"):
            yield SettingAdvice(
                f"the magnetometer of module {module} is on: its heading turns with the iron of the room",
                f"mocap-gateway modules set {module} magnetometer=false --allow-writes",
            )


def _announced(data: bytes) -> Announced | None:
    message = next(iter(SlimevrDecoder().feed(data)), None)
    if not isinstance(message, Handshake) or not message.mac:
        return None
    url = f"udp://0.0.0.0:{wire.PORT}"
    return Announced("slimevr", "trackers", message.mac, url, entry=("trackers", _shown(message.mac)))


DISCOVERY = Discovery(wire.PORT, _announced)
