"""Mode 1: the table of clock compensations, ``α_{i,k} = k / T̄_{i,k}``; measured, and at run time.

All modules are read when the reference clock (the slowest, ``N_1``) has counted ``k`` minutes; ``T_{i,k}`` is
what module ``i`` has counted meanwhile. Repeated and averaged, ``α_{i,k}`` turns a module's count into the
reference's, for ``k`` = 1 … 60, so the table also covers how rates drift as the modules warm up.

``ClockCalibration`` measures it: counts are read at common instants of gateway time, by every module's own
estimated clock, and are then expressed by the reference's count; the gateway's own rate drops out.

``TableClock`` uses it: rates from the table, offsets from the first arrivals, then from nothing else.
Every module's count becomes time of the reference clock by the table. How the counts of two modules stand to
each other is found once, in the first seconds after the module's start; from then on it is the table alone
that holds them together. The reference's own clock is turned into gateway time by its arrivals. Sans-I/O.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import yaml
from pydantic import Field, model_validator

from gateway.clocks.batching import LinkBatching
from gateway.clocks.counter import Counter32
from gateway.clocks.estimated import EstimatedClock
from gateway.clocks.module_clock import ClockFigures
from gateway.errors import GatewayError, SettingsError
from gateway.frames import FloatArray
from gateway.support.settings_files import Strict, load_settings
from gateway.support.whole_files import write_whole

MINUTE_S = 60.0


class ClockTableFile(Strict):
    """A clock table as stored beside the rig."""

    reference: int = Field(ge=0, le=255, description="module whose clock the others are turned into")
    interval_s: float = Field(default=MINUTE_S, gt=0, le=3600, description="reference time of one k, s")
    repetitions: int = Field(default=1, ge=1, description="counts averaged for each entry")
    ranking: list[int] = Field(min_length=1, description="modules by crystal, slowest first")
    alpha: dict[int, list[float]] = Field(description="by module: reference time over its own, k = 1, 2, …")

    @model_validator(mode="after")
    def _is_whole(self) -> ClockTableFile:
        if sorted(self.ranking) != sorted(self.alpha) or self.reference not in self.alpha:
            raise ValueError("'ranking', 'alpha' and 'reference' must name the same modules, each once")
        lengths = {len(row) for row in self.alpha.values()}
        if len(lengths) != 1 or 0 in lengths:
            raise ValueError("'alpha' needs the same number of entries, at least one, for every module")
        for module, row in self.alpha.items():
            if any(not 0.9 < value < 1.1 for value in row):
                raise ValueError(f"'alpha' of module {module} is not near 1: these are relative rates")
        return self


@dataclass(frozen=True)
class ClockTable:
    """Turns counts of modules into time of the reference clock."""

    reference: int
    ranking: tuple[int, ...]
    """Slowest first; the first one is the reference."""
    interval_s: float
    """Reference time from ``k`` to ``k + 1``, s: a minute."""
    alpha: dict[int, FloatArray]
    """(K,) ``α_{i,k}`` by module, k = 1 … K."""
    repetitions: int = 1
    _counts_us: dict[int, list[float]] = field(init=False, repr=False, compare=False)
    """By module: its counts at k = 0 … K."""

    def __post_init__(self) -> None:
        minute_us = self.interval_s * 1e6
        counts = {
            i: [0.0, *(k * minute_us / value for k, value in enumerate(row.tolist(), start=1))]
            for i, row in self.alpha.items()
        }
        object.__setattr__(self, "_counts_us", counts)  # derived once; the class stays frozen

    def reference_us(self, module: int, counted_us: float) -> float:
        """Return the reference time since a common start, of a module's own count since then, µs.

        Between the table's entries it goes straight; after the last (and before the start) it goes on at
        the last (first) interval's rate. A module that the table does not name is taken at its word.
        """
        counts = self._counts_us.get(module)
        if counts is None:
            return counted_us
        k = min(max(bisect_left(counts, counted_us), 1), len(counts) - 1)
        minute_us = self.interval_s * 1e6
        return minute_us * (k - 1 + (counted_us - counts[k - 1]) / (counts[k] - counts[k - 1]))

    def skew_ppm(self, module: int) -> float:
        """Return how much faster than the reference a module counts, over the whole table."""
        return float((1.0 / self.alpha[module][-1] - 1.0) * 1e6)


def rank_by_crystal(counts: Mapping[int, float]) -> tuple[int, ...]:
    """Return modules by what they counted in one and the same time, slowest first (equal ones by id)."""
    return tuple(sorted(counts, key=lambda module: (counts[module], module)))


def clock_table(
    repetitions: Sequence[Mapping[int, Sequence[float]]], interval_s: float = MINUTE_S
) -> ClockTable:
    """Return the table of repeated counts.

    repetitions: each gives by module ``T_{i,k}`` in units of the interval (minutes), k = 1 … K: what the
    module had counted when the reference had counted ``k``. Raises ``ValueError`` when they do not agree in
    modules or in K.
    """
    modules = sorted(repetitions[0]) if repetitions else []
    lengths = {len(row) for counts in repetitions for row in counts.values()}
    if not modules or len(lengths) != 1 or 0 in lengths or any(sorted(c) != modules for c in repetitions):
        raise ValueError("every repetition needs the same modules, each with the same number of counts")
    mean: dict[int, FloatArray] = {
        i: np.array([counts[i] for counts in repetitions]).mean(axis=0) for i in modules
    }
    k = np.arange(1, lengths.pop() + 1)
    # By the last count: over the longest time the crystals differ most clearly.
    ranking = rank_by_crystal({i: float(row[-1]) for i, row in mean.items()})
    return ClockTable(
        reference=ranking[0],
        ranking=ranking,
        interval_s=interval_s,
        alpha={i: k / row for i, row in mean.items()},
        repetitions=len(repetitions),
    )


def save_clock_table(table: ClockTable, path: Path) -> None:
    """Write the table as YAML. Raises ``SettingsError`` when the file cannot be written."""
    content = ClockTableFile(
        reference=table.reference,
        interval_s=table.interval_s,
        repetitions=table.repetitions,
        ranking=list(table.ranking),
        alpha={i: [round(float(value), 10) for value in row] for i, row in sorted(table.alpha.items())},
    )
    head = "# Clock compensation measured by `mocap-gateway calibrate clocks`.\n"
    text = head + yaml.safe_dump(content.model_dump(), sort_keys=False, default_flow_style=None)
    try:
        write_whole(path, text.encode())
    except OSError as error:
        raise SettingsError(f"{path}: cannot be written: {error}") from error


def load_clock_table(path: Path) -> ClockTable:
    """Read a table. Raises ``SettingsError`` naming the file, the entry and the remedy."""
    try:
        content = load_settings(path, ClockTableFile)
    except SettingsError as error:
        raise SettingsError(f"clock.table: {error}") from None
    return ClockTable(
        reference=content.reference,
        ranking=tuple(content.ranking),
        interval_s=content.interval_s,
        alpha={i: np.array(row, dtype=np.float64) for i, row in content.alpha.items()},
        repetitions=content.repetitions,
    )


_READS_PER_INTERVAL = 60
_SPARE = 0.01
"""How much longer than the reference's count the gateway's time is taken: clocks differ by less."""


class ClockCalibration:
    """Takes the stamps of all modules as they come; gives the table."""

    def __init__(
        self, modules: tuple[int, ...], minutes: int, repetitions: int = 1, minute_s: float = MINUTE_S,
        settling_s: float = 15.0,
    ) -> None:  # fmt: skip
        self._clocks: dict[int, EstimatedClock] = {}
        self._expected = modules
        self._minutes, self._repetitions, self._minute_s = minutes, repetitions, minute_s
        self._settling_ns = round(settling_s * 1e9)
        self._step_ns = round(minute_s * 1e9 / _READS_PER_INTERVAL)
        self._first_ns: int | None = None
        self._newest_ns = 0
        self._reads: list[tuple[int, dict[int, float]]] = []
        run_s = minutes * minute_s
        self.duration_s = settling_s + repetitions * run_s * (1.0 + _SPARE) + minute_s / _READS_PER_INTERVAL

    def observe(
        self, module: int, stamp_us: int, arrived_ns: int, batching: LinkBatching | None = None
    ) -> None:
        """Note a stamp of a module; modules that are not of the rig are ignored.

        Raises ``GatewayError`` if the module has restarted: its counts no longer belong together.
        """
        if module not in self._expected:
            return
        if self._first_ns is None:
            self._first_ns = arrived_ns
        self._newest_ns = arrived_ns
        clock = self._clocks.get(module)
        if clock is None:
            clock = self._clocks[module] = EstimatedClock(batching)
        if clock.gateway_time(stamp_us, arrived_ns) and clock.restarts:
            raise GatewayError(f"module {module} restarted while the clocks were measured; begin again")
        # Counts are read off at common instants: stamps of different modules never coincide.
        due_ns = self._first_ns + self._settling_ns + len(self._reads) * self._step_ns
        if arrived_ns >= due_ns:
            counts = {i: clock.count_us(due_ns) for i, clock in self._clocks.items()}
            self._reads.append((due_ns, counts))

    @property
    def elapsed_s(self) -> float:
        """How much of ``duration_s`` has gone by, by the arrivals."""
        return 0.0 if self._first_ns is None else (self._newest_ns - self._first_ns) * 1e-9

    @property
    def is_complete(self) -> bool:
        """Whether it has lasted for ``duration_s``."""
        return self.elapsed_s >= self.duration_s

    @property
    def received(self) -> tuple[int, ...]:
        """Modules that have sent something, in order of their ids."""
        return tuple(sorted(self._clocks))

    def table(self) -> ClockTable:
        """Return the table. Raises ``GatewayError`` when modules were not heard, or not for long enough."""
        silent = [i for i in self._expected if i not in self._clocks]
        if silent:
            raise GatewayError(
                f"modules {', '.join(map(str, silent))} of the rig were not heard: "
                "switch them on, or take them out of the rig file"
            )
        # Only moments at which all were heard compare all clocks.
        whole = [(at, counts) for at, counts in self._reads if len(counts) == len(self._expected)]
        if len(whole) < 2:
            raise GatewayError("the modules were not heard together for long enough to measure their clocks")
        counted = {i: np.array([counts[i] for _, counts in whole]) for i in self._expected}
        reference = rank_by_crystal({i: float(row[-1] - row[0]) for i, row in counted.items()})[0]
        runs = self._runs(counted, reference)
        return clock_table(runs, self._minute_s)

    def _runs(self, counted: Mapping[int, FloatArray], reference: int) -> list[dict[int, list[float]]]:
        """Return, by repetition and module, counts ``T_{i,k}`` at the reference's k-th minute, in minutes."""
        minute_us = self._minute_s * 1e6
        own = counted[reference]
        runs = []
        for run in range(self._repetitions):
            start_us = own[0] + run * self._minutes * minute_us
            marks_us = start_us + np.arange(self._minutes + 1) * minute_us
            if marks_us[-1] > own[-1]:
                raise GatewayError(
                    f"module {reference} counted {(own[-1] - own[0]) * 1e-6:.1f} s, not the "
                    f"{self._repetitions * self._minutes * self._minute_s:.1f} s that were to be measured"
                )
            at_marks = {i: np.interp(marks_us, own, row) for i, row in counted.items()}
            runs.append({i: ((row[1:] - row[0]) / minute_us).tolist() for i, row in at_marks.items()})
        return runs


FREEZE_US = 20_000_000
"""After so much time of the module its offset against the reference stands."""


class TableClocks:
    """The clocks of all modules of one table."""

    def __init__(self, table: ClockTable, *, is_compiled: bool = True) -> None:
        """Begin without modules; ``is_compiled`` as for ``EstimatedClock``."""
        self.table = table
        self.is_compiled = is_compiled
        self.reference: TableClock | None = None
        """Clock of the reference module, once it was heard."""

    def clock(self, module: int, batching: LinkBatching | None = None) -> TableClock:
        """Return the clock of a module."""
        clock = TableClock(self, module, batching)
        if module == self.table.reference:
            self.reference = clock
        return clock


class TableClock:
    """One module by the table. Without a reference on the air it estimates its corrected time by itself."""

    def __init__(self, clocks: TableClocks, module: int, batching: LinkBatching | None) -> None:
        self._clocks = clocks
        self._module = module
        self._counter = Counter32()
        self._estimate = EstimatedClock(batching, is_compiled=clocks.is_compiled)
        self._start_us = 0
        self._counts_per_us = 1.0
        self._ahead_us: float | None = None  # reference's corrected time minus this one's, same instant
        self._reference_restarts = 0

    @property
    def restarts(self) -> int:
        """How often the module's counter was found to count from anew."""
        return self._counter.restarts

    def gateway_time(self, module_time_us: int, arrived_ns: int) -> int:
        """Gateway time of a sample, ns, from the module's counter (µs) and the packet's arrival."""
        expected_us = self._start_us + self._counts_per_us * self._estimate.count_us(arrived_ns)
        full_us = self._counter.full_us(module_time_us, int(expected_us), arrived_ns)
        # The counter began anew: offsets of before hold no longer, the rate does.
        if full_us is None:
            full_us = self._start_us = module_time_us
            self._ahead_us = None
            self._estimate.forget()
        counted_us = full_us - self._start_us
        corrected_us = self._clocks.table.reference_us(self._module, counted_us)
        if corrected_us > 0:
            self._counts_per_us = counted_us / corrected_us
        estimated_ns = self._estimate.gateway_time(round(corrected_us) % 2**32, arrived_ns)
        reference = self._clocks.reference

        if reference is None or reference is self:
            return estimated_ns
        if self._ahead_us is None or self._reference_restarts != reference.restarts:
            # Until both have run for a while, the offset between them is not known well enough to be frozen.
            if min(corrected_us, reference.corrected_us) < FREEZE_US:
                return estimated_ns
            self._reference_restarts = reference.restarts
            self._ahead_us = reference.count_us(estimated_ns) - corrected_us
        return min(reference.instant_ns(corrected_us + self._ahead_us), arrived_ns)

    @property
    def corrected_us(self) -> float:
        """Reference time since the start, at the newest stamp."""
        return float(self._estimate.newest_us)

    def count_us(self, time_ns: int) -> float:
        """Return the reference time since the start at a gateway time."""
        return self._estimate.count_us(time_ns)

    def instant_ns(self, corrected_us: float) -> int:
        """Gateway time of a reference time since the start."""
        return self._estimate.instant_ns(round(corrected_us))

    def figures(self) -> ClockFigures:
        """Return offset and rate; the rate adds what was estimated to that of the table."""
        figures = self._estimate.figures()
        table = self._clocks.table
        ppm = table.skew_ppm(self._module) if self._module in table.alpha else 0.0
        return figures._replace(skew_ppm=figures.skew_ppm + ppm)
