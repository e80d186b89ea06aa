"""The measurement of a clock table: every module's count, minute by minute of the slowest one's clock.

Counts are read at common instants of gateway time, by every module's own estimated clock, and are then
expressed by the reference's count; the gateway's own rate drops out. Sans-I/O.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from gateway.clocks.batching import LinkBatching
from gateway.clocks.estimated import EstimatedClock
from gateway.clocks.table import MINUTE_S, ClockTable, clock_table, rank_by_crystal
from gateway.errors import GatewayError
from gateway.frames import FloatArray

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
