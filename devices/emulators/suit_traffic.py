"""All that an emulated suit sends, in order of time. Sans-I/O, deterministic, computed in blocks.

A block evaluates the truth at all sampling instants of all modules at once, so that 64 modules at
100 Hz, or 17 at 1000 Hz, cost a part of one core.
"""

from __future__ import annotations

import heapq
import struct
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from devices.emulators.bodies import NO_MODULE, FloatArray
from devices.emulators.delivery import Delivery, Encoding, PacketFaults, Transmission
from devices.emulators.emulated_module import (
    EmulatedLocalSender,
    EmulatedModule,
    Sender,
    StatusReports,
    Timed,
    device_info,
)
from devices.emulators.emulated_relay import EmulatedRelay
from devices.emulators.ideal_sensors import GRAVITY, MAGNETIC_FIELD, measure_point, sense
from devices.emulators.imperfect_sensors import ImperfectSensors
from devices.emulators.imperfections import (
    IDEAL,
    Imperfections,
    ModuleErrors,
    draw_clock,
    draw_errors,
    module_random,
)
from devices.emulators.motions import BodyMotion
from devices.emulators.sample_encoding import SENSORS, SampleEncoder
from devices.link import Framing
from firmware_protocol import RELAY, InertialSample, InertialSampleFine

_ERRORS, _CLOCK, _RADIO, _HOST = range(4)  # purposes of random streams


@dataclass(frozen=True)
class SuitSettings:
    """How the suit is built; what is wrong with it is in ``Imperfections``."""

    sampling_rate_hz: float = 100.0
    module_rates_hz: Mapping[int, float] = field(default_factory=dict)
    """Sampling rates of single modules that differ."""
    sensors: tuple[str, ...] = SENSORS
    """What every module carries."""
    is_fine: bool = False
    """Send ``InertialSampleFine`` instead of ``InertialSample``."""
    has_relay: bool = False
    """A relay gathers all packets and forwards batches (byte streams only)."""
    encoding: Encoding = field(default_factory=Encoding)
    gravity: FloatArray = field(default_factory=GRAVITY.copy)
    """(3,) world, m/s²."""
    magnetic_field: FloatArray = field(default_factory=MAGNETIC_FIELD.copy)
    """(3,) world, µT."""
    info_interval_s: float = 5.0
    health_interval_s: float = 1.0
    block_s: float = 0.5

    def rate(self, module: int) -> float:
        """Sampling rate of a module, Hz."""
        return self.module_rates_hz.get(module, self.sampling_rate_hz)


class SuitTraffic:
    """The sender's side of a whole suit on one link."""

    def __init__(
        self,
        motion: BodyMotion,
        settings: SuitSettings | None = None,
        imperfections: Imperfections = IDEAL,
        seed: int = 0,
    ) -> None:
        """Raises ``ValueError`` when a relay is asked for on a CAN bus."""
        self.settings = settings = settings or SuitSettings()
        if settings.has_relay and settings.encoding.framing is Framing.CAN:
            raise ValueError("a relay on a CAN bus: CAN cannot carry its batches; use a byte stream")
        self.motion = motion
        self.counts: Counter[str] = Counter()
        """Packets sent, lost and duplicated, wire frames corrupted, by those words."""
        self._imperfections = imperfections
        self._seed = seed
        self._now_s = 0.0
        self._pending: list[tuple[float, int, bytes]] = []
        self._order = 0
        self.senders: dict[int, Sender] = {}
        """Every module by its id; ``sender.clock`` is the truth for clock estimation."""
        self._build_modules()
        self._build_way_to_host()

    def transmissions(self, duration_s: float | None = None) -> Iterator[Transmission]:
        """Everything sent until ``duration_s`` of motion time (None: without end), computed as it is taken.

        At the end, what is still under way comes too.
        """
        while duration_s is None or self._now_s < duration_s:
            to_s = self._now_s + self.settings.block_s
            yield from self.advance(to_s if duration_s is None else min(to_s, duration_s))
        yield from self._arrived_before(np.inf)

    def advance(self, to_s: float) -> list[Transmission]:
        """Everything that arrives between the last call's time and ``to_s`` (motion time, s), in order."""
        delivered: list[Transmission] = []
        on_air = [
            (module, self._faults[module].apply(sorted(sent, key=lambda timed: timed.time_s)))
            for module, sent in self._sent_by_module(to_s)
        ]
        if self._relay is not None:
            packets = [timed for _, sent in on_air for timed in sent]
            delivered += self._deliveries[RELAY].deliver(self._relay.gather(packets, to_s))
        else:
            for module, sent in on_air:
                delivered += self._deliveries[module].deliver(sent)
        for transmission in delivered:
            heapq.heappush(self._pending, (transmission.time_s, self._order, transmission.data))
            self._order += 1
        self._now_s = to_s
        return list(self._arrived_before(to_s))

    def _arrived_before(self, to_s: float) -> Iterator[Transmission]:
        while self._pending and self._pending[0][0] < to_s:
            time_s, _, data = heapq.heappop(self._pending)
            yield Transmission(time_s, data)

    def _sent_by_module(self, to_s: float) -> list[tuple[int, list[Timed]]]:
        samples = self._samples(to_s)
        for local in self._locals:
            samples.append((local.sender.module, self._measurements(local, to_s)))
        return [
            (module, self._reports[module].until(to_s) + sent)  # at one moment, who it is comes first
            for module, sent in samples
        ]

    def _samples(self, to_s: float) -> list[tuple[int, list[Timed]]]:
        instants = [module.schedule.until(to_s) for module in self._modules]
        longest = max(map(len, instants), default=0)
        if not longest:
            return [(module.sender.module, []) for module in self._modules]
        # One column a module; the shorter ones are filled up with a time that nothing is read at.
        times = np.full((longest, len(instants)), self._now_s)
        for column, (at, module) in enumerate(zip(instants, self._modules, strict=True)):
            times[: len(at), column] = module.sender.clock.true_time(1.0) * at
        ideal = sense(
            self.motion.module_state(self._segments, times),
            self._lever_arms,
            self._R_bs,
            self.settings.gravity,
            self.settings.magnetic_field,
        )
        sampled = []
        columns = zip(instants, self._modules, self._sensors, strict=True)
        for column, (at, module, sensors) in enumerate(columns):
            rows = (slice(len(at)), column)
            readings = sensors.read(
                ideal.specific_force[rows], ideal.angular_rate[rows], ideal.magnetic_field[rows]
            )
            sampled.append((module.sender.module, module.samples(at, readings)))
        return sampled

    def _measurements(self, local: EmulatedLocalSender, to_s: float) -> list[Timed]:
        at = local.schedule.until(to_s)
        if not len(at):
            return []
        times = local.sender.clock.true_time(1.0) * at
        state = self.motion.module_state(np.array([local.device.segment]), times[:, None])
        values = measure_point(state, local.device.position[None], local.device.quantity)
        return local.measurements(at, values[:, 0])

    def _build_modules(self) -> None:
        body, settings = self.motion.body, self.settings
        self._segments = np.flatnonzero(body.module_ids != NO_MODULE)
        ids = [int(i) for i in body.module_ids[self._segments]]
        errors = [draw_errors(self._imperfections, self._random(i, _ERRORS)) for i in ids]
        self._lever_arms, self._R_bs = self._mountings(errors)
        encoder = SampleEncoder(InertialSampleFine if settings.is_fine else InertialSample, settings.sensors)
        self.senders = {i: self._sender(i, settings.rate(i)) for i in ids}
        self._modules = [EmulatedModule(self.senders[i], encoder, settings.rate(i)) for i in ids]
        self._sensors = [
            ImperfectSensors(self._imperfections, drawn, self._seed, i, settings.rate(i))
            for i, drawn in zip(ids, errors, strict=True)
        ]
        self.senders |= {d.module: self._sender(d.module, d.rate_hz) for d in body.local_devices}
        self._locals = [
            EmulatedLocalSender(self.senders[d.module], d, self._seed) for d in body.local_devices
        ]
        schedules = {unit.sender.module: unit.schedule for unit in self._modules}
        schedules |= {unit.sender.module: unit.schedule for unit in self._locals}
        self._reports = {
            i: StatusReports(
                sender,
                schedules[i],
                device_info(self._unique_id(i), settings.rate(i), settings.sensors if i in ids else ()),
                settings.info_interval_s,
                settings.health_interval_s,
            )
            for i, sender in self.senders.items()
        }

    def _build_way_to_host(self) -> None:
        settings, faults = self.settings, self._imperfections
        self._faults = {i: PacketFaults(faults, self._random(i, _RADIO), self.counts) for i in self.senders}
        self._deliveries = {
            i: Delivery(faults, settings.encoding, self._random(i, _HOST), self.counts)
            for i in (*self.senders, RELAY)
        }
        self._relay: EmulatedRelay | None = None
        if settings.has_relay:
            fastest = max((settings.rate(i) for i in self.senders), default=settings.sampling_rate_hz)
            self._relay = EmulatedRelay(self._sender(RELAY, fastest), 1.0 / fastest)

    def _mountings(self, errors: list[ModuleErrors]) -> tuple[FloatArray, FloatArray]:
        """Where the modules really are: lever arms (M, 3) and rotations (M, 3, 3) sensor to segment."""
        body = self.motion.body
        shifts = np.array([e.placement for e in errors]).reshape(-1, 3)
        turns = np.array([e.placement_rotation for e in errors]).reshape(-1, 3, 3)
        nominal = Rotation.from_quat(body.sensor_to_segment[self._segments], scalar_first=True).as_matrix()
        return body.module_positions[self._segments] + shifts, nominal @ turns

    def _sender(self, module: int, rate_hz: float) -> Sender:
        return Sender(module, draw_clock(self._imperfections, self._random(module, _CLOCK), 1.0 / rate_hz))

    def _unique_id(self, module: int) -> bytes:
        return struct.pack("<8sHH", b"EMULATED", self._seed % 2**16, module)

    def _random(self, module: int, purpose: int) -> np.random.Generator:
        return module_random(self._seed, module, purpose)
