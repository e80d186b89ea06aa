"""Mode 1: the table of clock compensations, ``α_{i,k} = k / T̄_{i,k}``.

All modules are read when the reference clock (the slowest, ``N_1``) has counted ``k`` minutes; ``T_{i,k}`` is
what module ``i`` has counted meanwhile. Repeated and averaged, ``α_{i,k}`` turns a module's count into the
reference's, for ``k`` = 1 … 60, so the table also covers how rates drift as the modules warm up.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import yaml
from pydantic import Field, model_validator

from gateway.errors import SettingsError
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
