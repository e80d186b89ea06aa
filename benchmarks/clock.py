"""How far samples of 17 modules are from one common instant, by mode of clock compensation."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.clock_faults import recoveries
from benchmarks.clock_orientation import clocks_in_degrees
from benchmarks.clock_recordings import recorded_clocks
from benchmarks.figures import Figure, Report, table
from devices.link import Chunk, Framing, SentChunk
from firmware_protocol import BROADCAST, InertialSample, SamplingTrigger, encode_frame, wire_frame
from gateway.clocks import (
    ArrivalClock,
    ArrivalLine,
    ClockCalibration,
    EstimatedClock,
    LinkBatching,
    ModuleClock,
    TableClocks,
    TriggerAnswers,
    TriggerTimer,
)
from gateway.emulation.clock_simulation import (
    LATENCY_US,
    LOSS,
    SKEW_PPM,
    Crystal,
    ModuleTraffic,
    module_traffic,
    relay_errors,
    transport_limit_us,
)
from gateway.frames import FloatArray, InertialBatch
from gateway.sources.arrival_counter import ArrivalCounter
from gateway.sources.clock_mode import ClockMode
from gateway.sources.module_table import ModuleTable
from gateway.sources.suit import SuitSource

SEED = 4
MODULES = 17
HOUR_S = 3600.0
SETTLED_S = 60.0
RELAY_S = 900.0
RATE_HZ = 100.0
TABLE_RATE_HZ = 25.0
"""Of table mode, whose estimate does not depend on it; it saves time."""
EXCHANGES_HZ, PINGS_HZ = 4.0, 2.0
SWING_RAD, SWING_HZ = np.radians(60.0), 2.0
RECEPTION_US = 10.0
"""Mean time from a broadcast's coming to the sensor's sampling (interrupt latency), exponential."""


@dataclass(frozen=True)
class Errors:
    """Published minus true instants, latency left in, at every second after settling, µs."""

    own: FloatArray  # (modules, seconds)

    @property
    def common(self) -> FloatArray:
        """Against the median module's: what tears the samples of one frame apart."""
        return self.own - np.median(self.own, axis=0)

    def row(self, name: str, limit_us: float | None = None) -> list[str]:
        """A line of the table."""
        p50, p99, worst = np.quantile(np.abs(self.common), [0.5, 0.99, 1.0])
        limit = "–" if limit_us is None else f"{limit_us:.0f}"
        return [name, f"{p50:.0f}", f"{p99:.0f}", f"{worst:.0f}", limit, f"{self.swing_rmse_deg():.3f}"]

    def p99_us(self) -> float:
        return float(np.quantile(np.abs(self.common), 0.99))

    def swing_rmse_deg(self) -> float:
        """Error of the angle of a limb that swings ±60° at 2 Hz, seen against the others."""
        rng = np.random.default_rng(SEED)
        at = rng.uniform(0, 1, self.own.shape)
        angle = SWING_RAD * np.sin(2 * np.pi * SWING_HZ * at)
        seen = SWING_RAD * np.sin(2 * np.pi * SWING_HZ * (at - self.common * 1e-6))
        return float(np.degrees(np.sqrt(np.mean((seen - angle) ** 2))))


def suit(seed: int = SEED) -> list[Crystal]:
    """Crystals of all modules."""
    rng = np.random.default_rng(seed)
    return [Crystal(rng, HOUR_S, skew) for skew in rng.uniform(-SKEW_PPM, SKEW_PPM, MODULES)]


def traffic(
    crystals: list[Crystal],
    slot_us: float,
    rate_hz: float = RATE_HZ,
    spread_us: float = 0.0,
    seed: int = SEED,
) -> list[ModuleTraffic]:
    """An hour of all modules. spread_us: latencies differ between modules by up to so much."""
    rngs = [np.random.default_rng([seed, module]) for module in range(MODULES)]
    return [
        module_traffic(rng, crystal, HOUR_S, rate_hz, slot_us, LATENCY_US + spread_us * rng.uniform())
        for rng, crystal in zip(rngs, crystals, strict=True)
    ]


def find_slot(modules: list[ModuleTraffic]) -> LinkBatching:
    """The link's slot from the first seconds of what came over it."""
    batching = LinkBatching()
    first = np.unique(np.concatenate([m.arrived_ns[: int(10 * RATE_HZ)] for m in modules]))
    for arrived_ns in first.tolist():
        batching.observe(arrived_ns)
    return batching


def errors_of(module: ModuleTraffic, published_ns: list[int]) -> FloatArray:
    """Published minus true at every second from ``SETTLED_S``, µs, (seconds,)."""
    seconds = np.arange(SETTLED_S, HOUR_S - 1.0) * 1e6
    error_us = np.array(published_ns) * 1e-3 - module.true_us
    return error_us[np.searchsorted(module.true_us, seconds)]


def run_clock(module: ModuleTraffic, clock: ModuleClock) -> FloatArray:
    """Errors of one clock fed with one module's packets."""
    stamps, arrivals = module.stamps_us.tolist(), module.arrived_ns.tolist()
    convert = clock.gateway_time
    return errors_of(module, [convert(stamp, at) for stamp, at in zip(stamps, arrivals, strict=True)])


def by_arrival(slot_us: float) -> Errors:
    """The estimate from arrival times alone."""
    modules = traffic(suit(), slot_us)
    batching = find_slot(modules)
    return Errors(np.array([run_clock(module, EstimatedClock(batching)) for module in modules]))


def uncompensated(slot_us: float) -> Errors:
    """No compensation: module time from the first arrival on, rate as stamped."""
    errors = []
    for module in traffic(suit(), slot_us, TABLE_RATE_HZ):
        elapsed_us = module.counter * module.interval_us
        offset_us = module.arrived_ns[0] * 1e-3 - elapsed_us[0]
        errors.append(errors_of(module, ((elapsed_us + offset_us) * 1e3).tolist()))
    return Errors(np.array(errors))


def by_exchange(slot_us: float) -> tuple[Errors, float]:
    """Two-way exchanges beside the samples; latencies differ by 1 ms. Also the mean published bound, µs."""
    modules = traffic(suit(), slot_us, spread_us=1000.0)
    batching = find_slot(modules)
    errors, bounds = [], []
    every = int(RATE_HZ / EXCHANGES_HZ)
    for k, module in enumerate(modules):
        clock, rng = EstimatedClock(batching), np.random.default_rng([SEED, 100 + k])
        published = []
        there_us = module.latency_us + rng.exponential(1000.0, len(module.counter))
        sent_ns = np.round((module.true_us - there_us) * 1e3).astype(np.int64).tolist()
        stamps, arrivals = module.stamps_us.tolist(), module.arrived_ns.tolist()
        for n, (stamp, at) in enumerate(zip(stamps, arrivals, strict=True)):
            if n % every == 0:  # the answer leaves with the sample, at once
                clock.add_exchange(sent_ns[n], stamp, stamp, at)
            published.append(clock.gateway_time(stamp, at))
        errors.append(errors_of(module, published))
        bounds.append(clock.figures().bound_us or np.nan)
    return Errors(np.array(errors)), float(np.mean(bounds))


def by_pings(slot_us: float) -> tuple[Errors, float]:
    """No stamps: the line of earliest arrivals, less half the shortest round trip of pings. Latencies differ
    by 1 ms. Also the mean published bound, µs."""
    errors, bounds = [], []
    every = int(RATE_HZ / PINGS_HZ)
    for k, module in enumerate(traffic(suit(), slot_us, spread_us=1000.0)):
        line, rng = ArrivalLine(), np.random.default_rng([SEED, 300 + k])
        clock = ArrivalClock(line)
        steps = np.diff(module.counter, prepend=module.counter[0] - 1).tolist()
        trips_ns = (2e3 * module.latency_us + rng.exponential(1e6, (len(steps), 2)).sum(axis=1)).tolist()
        published = []
        for n, (step, at) in enumerate(zip(steps, module.arrived_ns.tolist(), strict=True)):
            if n % every == 0:
                clock.add_round_trip(int(trips_ns[n]))
            published.append(clock.gateway_time(line.instant(step, at) // 1000 % 2**32, at))
        errors.append(errors_of(module, published))
        bounds.append(clock.figures().bound_us or np.nan)
    return Errors(np.array(errors)), float(np.mean(bounds))


def by_maker(
    stamped_in_us: int | None, counter_bits: int | None = None, *, sees_losses: bool = False
) -> Errors:
    """What devices of other makers say of their samples, batched by 1 ms.

    stamped_in_us: steps of their stamps; None: they send none. counter_bits: of a count in the place of
    stamps; None: none either. sees_losses: whether every loss shows, as where a damaged packet is seen.
    """
    modules = traffic(suit(), 1000.0)
    batching, errors, rng = find_slot(modules), [], np.random.default_rng(SEED)
    for module in modules:
        arrivals, counts = module.arrived_ns.tolist(), module.counter.tolist()
        if stamped_in_us is None:
            times = ArrivalCounter((RATE_HZ,), None if counter_bits is None else RATE_HZ, counter_bits)
            lost = (np.diff(module.counter, prepend=module.counter[0] - 1) - 1).tolist()
            stamped = [
                times.stamp(at, None if counter_bits is None else count, n if sees_losses else 0)
                for at, count, n in zip(arrivals, counts, lost, strict=True)
            ]
            stamps = [0 if each is None else each[1] for each in stamped]
        else:
            # at rates that steps do not divide, instants are after their stamps by anything up to a step
            whole = module.counter * module.interval_us - rng.uniform(0.0, stamped_in_us, len(arrivals))
            stamps = (whole.astype(np.int64) % 2**32).tolist()
        convert = EstimatedClock(batching).gateway_time
        first = stamps.index(next(filter(None, stamps)))
        published = [0] * first
        published += [convert(stamp, at) for stamp, at in zip(stamps[first:], arrivals[first:], strict=True)]
        errors.append(errors_of(module, published))
    return Errors(np.array(errors))


def makers_clocks() -> tuple[list[Figure], list[list[str]]]:
    """Figures and rows of the table, by what a maker's devices say of their samples."""
    ways = {
        "stamped_1us": ("stamps of 1 µs (x-IMU3, MTi on CAN)", by_maker(1)),
        "stamped_100us": ("stamps of 100 µs (MTi)", by_maker(100)),
        "stamped_1ms": ("stamps of 1 ms (MVN, mocopi)", by_maker(1000)),
        "counted": ("a count of 8 bits (BNO08x)", by_maker(None, 8)),
        "neither": ("neither, every loss seen (WitMotion)", by_maker(None, sees_losses=True)),
        "neither_unseen": ("neither, no loss seen (WitMotion)", by_maker(None)),
    }
    figures = [
        Figure(f"{name}_p99_us", errors.p99_us(), "µs", "", f"{what}, arrival times, 1 ms batching")
        for name, (what, errors) in ways.items()
    ]
    return figures, [errors.row(what) for what, errors in ways.values()]


def by_relay() -> Errors:
    """Two-way exchanges through a relay unit that sends every 10 ms what it has got."""
    seconds = np.arange(SETTLED_S, RELAY_S)
    rngs = [np.random.default_rng([SEED, 200 + module]) for module in range(MODULES)]
    return Errors(
        np.array(
            [relay_errors(rng, crystal, seconds, RATE_HZ) for rng, crystal in zip(rngs, suit(), strict=True)]
        )
    )


def by_table(slot_us: float) -> tuple[Errors, float]:
    """A table of 60 minutes measured in one capture, used in another at other temperatures."""
    crystals = suit()
    measured = traffic(crystals, slot_us, TABLE_RATE_HZ)
    batching = find_slot(measured)
    calibration = ClockCalibration(tuple(range(MODULES)), minutes=58)
    for module, stamp, at in _by_arrival(measured):
        calibration.observe(module, stamp, at, batching)
    clocks = TableClocks(calibration.table())
    used = traffic(crystals, slot_us, TABLE_RATE_HZ, seed=SEED + 1)
    begin = [clocks.clock(module, batching) for module in range(MODULES)]
    published: list[list[int]] = [[] for _ in used]
    for module, stamp, at in _by_arrival(used):
        published[module].append(begin[module].gateway_time(stamp, at))
    errors = [errors_of(module, instants) for module, instants in zip(used, published, strict=True)]
    return Errors(np.array(errors)), float(len(clocks.table.alpha[clocks.table.reference]))


def _by_arrival(modules: Sequence[ModuleTraffic]) -> Iterator[tuple[int, int, int]]:
    """Yield number, stamp in µs and arrival in ns of all packets, in the order of their arrival."""
    arrivals = np.concatenate([module.arrived_ns for module in modules])
    numbers = np.repeat(np.arange(len(modules)), [len(module.arrived_ns) for module in modules])
    stamps = np.concatenate([module.stamps_us for module in modules])
    order = np.argsort(arrivals, kind="stable")
    yield from zip(numbers[order].tolist(), stamps[order].tolist(), arrivals[order].tolist(), strict=True)


def by_trigger() -> tuple[Errors, TriggerTimer, TriggerAnswers]:
    """The gateway's timer rules: one broadcast reaches all modules; each samples an interrupt later.

    Triggers and answers pass through the stream as in the running gateway.
    """
    rng = np.random.default_rng(SEED)
    timer, answers = TriggerTimer(1e9), TriggerAnswers(range(MODULES), patience_ns=100_000_000)
    stream = SuitSource(ModuleTable(ClockMode.TRIGGER), answers)
    stream.add_link("radio", Framing.BYTE_STREAM)
    sample = InertialSample(angular_rate=(0.0, 0.0, 0.0), triggered=True)
    shown = []
    timer.start(0)
    for second in range(int(HOUR_S)):  # one trigger a second is looked at
        sent_ns = second * 10**9 + int(rng.exponential(200_000))  # the host's own lateness: common to all
        trigger = timer.due(sent_ns)
        assert trigger is not None
        timer.sent(trigger, sent_ns)
        asked = wire_frame(SamplingTrigger(trigger.number), BROADCAST, trigger.number, 0)
        stream.sent(SentChunk(encode_frame(asked), sent_ns, "radio"))
        sampled_ns = sent_ns + LATENCY_US * 1e3 + rng.exponential(RECEPTION_US * 1e3, MODULES)
        answering = np.flatnonzero(rng.random(MODULES) >= LOSS).tolist()
        frames = [wire_frame(sample, module, trigger.number, sent_ns // 1000 % 2**32) for module in answering]
        readings = stream.receive(Chunk(b"".join(map(encode_frame, frames)), sent_ns + 3_000_000, "radio"))
        batches = [reading for reading in readings if isinstance(reading, InertialBatch)]
        if second >= SETTLED_S and sum(map(len, batches)) == MODULES:
            published_ns = np.concatenate([batch.samples["time_ns"] for batch in batches])
            shown.append((published_ns - sampled_ns) * 1e-3)
    return Errors(np.array(shown).T), timer, answers


def packet_cost_us() -> float:
    """Processor time of one packet in the estimate, best of five, µs."""
    module = traffic(suit()[:1] * MODULES, 1000.0)[0]
    stamps, arrivals = module.stamps_us[:60_000].tolist(), module.arrived_ns[:60_000].tolist()
    best = np.inf
    for _ in range(5):
        batching = LinkBatching()
        batching.slot_us = 1000.0
        convert: Callable[[int, int], int] = EstimatedClock(batching).gateway_time
        begin = time.process_time()
        for stamp, at in zip(stamps, arrivals, strict=True):
            convert(stamp, at)
        best = min(best, (time.process_time() - begin) / len(stamps) * 1e6)
    return float(best)


@dataclass(frozen=True)
class ByMode:
    """Errors in each mode of the clock, of emulated suits."""

    uncompensated: Errors
    table: Errors
    table_minutes: float
    arrival_1ms: Errors
    arrival_16ms: Errors
    exchanged: Errors
    exchange_bound_us: float
    unstamped: Errors
    ping_bound_us: float
    relayed: Errors
    triggered: Errors

    def figures(self) -> Iterator[Figure]:
        """Yield the figures that are kept."""
        yield _p99("sync_p99_us", self.exchanged, "two-way exchanges at 4 Hz, 1 ms batching", "<=50")
        yield _p99("arrival_1ms_p99_us", self.arrival_1ms, "arrival times alone, 1 ms batching", "<=300")
        yield _p99("arrival_16ms_p99_us", self.arrival_16ms, "arrival times alone, 16 ms batching")
        yield _p99(
            "unstamped_p99_us",
            self.unstamped,
            "no stamps (SlimeVR): line of the earliest arrivals, pings at 2 Hz, 1 ms batching",
        )
        what = "bound published with it, mean of the modules"
        yield Figure("unstamped_bound_us", self.ping_bound_us, "µs", "", what)
        yield _p99("relay_p99_us", self.relayed, "relay unit, ticks of 10 ms, exchanges at 4 Hz")
        yield _p99("trigger_p99_us", self.triggered, "unified control, broadcast trigger")
        yield _p99(
            "table_p99_us", self.table, f"table of {self.table_minutes:.0f} minutes, other temperatures"
        )
        what = "bound published with the exchanges, mean of the modules"
        yield Figure("sync_bound_us", self.exchange_bound_us, "µs", "", what)

    def rows(self, of_makers: Sequence[list[str]]) -> list[list[str]]:
        """Return the table of errors. of_makers: rows of the clocks of other makers' modules."""
        limit_1ms, limit_16ms = (transport_limit_us(slot, 1e6 / RATE_HZ, 60.0) for slot in (1000.0, 16_000.0))
        return [
            self.uncompensated.row("none: rate as stamped"),
            self.table.row("1, table"),
            self.arrival_16ms.row("arrival times, 16 ms batching", limit_16ms),
            self.arrival_1ms.row("arrival times, 1 ms batching", limit_1ms),
            self.exchanged.row("two-way exchanges, 1 ms batching"),
            self.unstamped.row("no stamps: line of arrivals and pings, 1 ms batching"),
            *of_makers,
            self.relayed.row("two-way exchanges, relay unit with ticks of 10 ms"),
            self.triggered.row("2, unified control"),
        ]


def _p99(name: str, errors: Errors, what: str, limit: str = "") -> Figure:
    return Figure(name, errors.p99_us(), "µs", limit, what)


def run() -> Report:
    """All modes, and recordings."""
    cost_us = packet_cost_us()
    triggered, timer, answers = by_trigger()
    by_mode = ByMode(
        uncompensated(1000.0),
        *by_table(1000.0),
        by_arrival(1000.0),
        by_arrival(16_000.0),
        *by_exchange(1000.0),
        *by_pings(1000.0),
        by_relay(),
        triggered,
    )
    of_makers, rows_of_makers = makers_clocks()
    recorded, recorded_table = recorded_clocks()
    recovered, recovery_table = recoveries()
    in_degrees, degrees_table = clocks_in_degrees()
    report = Report("clock")
    what = "processor time of the estimate, one packet on average"
    cost = Figure("clock_packet_us", cost_us, "µs", "<=2", what)
    report.figures = [*by_mode.figures(), *of_makers, cost, *recorded, *recovered, *in_degrees]
    heads = ["mode", "p50 µs", "p99 µs", "max µs", "limit p99 µs", "±60° swing at 2 Hz: RMSE °"]
    report.tables = [
        _explained(timer, answers) + table(heads, by_mode.rows(rows_of_makers)),
        degrees_table,
        recovery_table,
        recorded_table,
    ]
    return report


def _explained(timer: TriggerTimer, answers: TriggerAnswers) -> str:
    """What the table of errors was made from."""
    kept, missed = timer.figures, sum(answers.figures.missed.values())
    return (
        "## Error of the common instant\n\n"
        "17 modules at 100 Hz for an hour, the first minute left out; crystals to ±100 ppm, drifting by "
        "1 ppm/min up and down in turns of 10 min; delay 0.5 ms + exponential of mean 1 ms, 2 % lost. "
        "Error of a module's instants against the median module's. *limit*: Cramér–Rao bound with the rate "
        "known and 60 s of packets. Exchanges: latencies differ between modules by up to 1 ms, which "
        "arrival times alone cannot see. Trigger: reception differs by an exponential of mean "
        f"{RECEPTION_US:.0f} µs; timer jitter RMS {kept.jitter_rms_us:.0f} µs (common to all), "
        f"{missed} answers missed of "
        f"{kept.sent * MODULES}. Relay: {RELAY_S / 60:.0f} min.\n\n"
    )
