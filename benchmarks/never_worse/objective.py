"""One number to choose settings by, over the training part alone, quick enough to be asked hundreds of times.

::

    with Objective() as objective:
        print(objective({"gyroscope": 0.0005}))
"""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from types import TracebackType
from typing import NamedTuple

import numpy as np

from benchmarks.never_worse import peers, split
from benchmarks.never_worse.case import Case, Variant
from benchmarks.never_worse.judging import errors
from benchmarks.never_worse.solving import OURS, live
from gateway.reconstruction.inertial.tree.reconstructor import ChainSettings
from gateway.reconstruction.inertial.tree.tuning import tuning


class Score(NamedTuple):
    """What settings are worth: less is better."""

    value: float
    """The mean ratio, and the mean of what ratios exceed 1 by."""
    mean_ratio: float
    """Geometric, of `joint` live over the fair VQF: of the variants of a recording, of the recordings of a
    kind, of the kinds."""
    penalty: float
    ratios: dict[tuple[str, Variant], float]

    def __str__(self) -> str:
        (name, variant), worst = max(self.ratios.items(), key=lambda each: each[1])
        return (
            f"{self.value:.4f}: mean ratio {self.mean_ratio:.4f}, penalty {self.penalty:.4f}, "
            f"worst {worst:.2f} ({name}, {variant})"
        )


def fair_vqf(case: Case, variant: Variant, field: str = "total") -> float:
    """Return the error, degrees, of the better VQF that knows no more: 6-axis alone where the field is not
    used."""
    found = peers.vqf(case)
    names = [name for name in (peers.VQF_6, peers.VQF_9) if name in found]
    used = names if variant.has_field else names[:1]
    return min(float(getattr(errors(case, variant, found[name]), field)) for name in used)


class Objective:
    """Processes that stay, so that settings are tried one after the other without starting anew."""

    def __init__(self, part: str = "training", processes: int | None = None) -> None:
        """part: of the split; settings are chosen on ``training`` alone."""
        self._names = [one.name for one in split.named(part)]
        context = multiprocessing.get_context("spawn")
        self._pool = ProcessPoolExecutor(processes or os.cpu_count(), mp_context=context)

    def __enter__(self) -> Objective:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._pool.shutdown(cancel_futures=True)

    def __call__(self, changes: Mapping[str, float] | None = None) -> Score:
        """Return what changes of the tuning table are worth. Raises ``FileNotFoundError`` where a recording
        is not there: a score over others cannot be compared."""
        found = list(self._pool.map(ratios, self._names, [changes] * len(self._names)))
        return score(dict(zip(self._names, found, strict=True)))


def ratios(name: str, changes: Mapping[str, float] | None = None) -> tuple[str, dict[Variant, float]]:
    """Return the kind of a recording and `joint` over VQF by variant, with changes of the tuning table."""
    case, settings = split.case(name), ChainSettings(tuning=tuning(**(changes or {})))
    return case.kind, {
        variant: errors(case, variant, live(OURS, case, variant, settings).q_wb).total / _vqf(name, variant)
        for variant in case.variants
    }


_VQF: dict[tuple[str, Variant], float] = {}


def _vqf(name: str, variant: Variant) -> float:
    """Return what does not change from one try to the next."""
    if (name, variant) not in _VQF:
        _VQF[name, variant] = fair_vqf(split.case(name), variant)
    return _VQF[name, variant]


def score(found: dict[str, tuple[str, dict[Variant, float]]]) -> Score:
    """Return the score of ratios by recording."""
    kinds: dict[str, list[tuple[float, float]]] = {}
    for kind, by_variant in found.values():
        each = np.array(list(by_variant.values()))
        kinds.setdefault(kind, []).append(
            (float(np.log(each).mean()), float(np.maximum(each - 1.0, 0.0).mean()))
        )
    logs, penalties = np.array([np.mean(values, axis=0) for values in kinds.values()]).T
    mean, penalty = float(np.exp(logs.mean())), float(penalties.mean())
    flat = {(name, variant): r for name, (_, each) in found.items() for variant, r in each.items()}
    return Score(mean + penalty, mean, penalty, flat)
