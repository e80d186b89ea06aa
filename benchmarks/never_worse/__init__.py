"""Never worse than VQF: every recording, every method, with and without field and device, training and
validation.

``split.yaml`` says which recordings settings may be chosen on. ``Objective`` is the one number to choose them
by. ``python -m benchmarks.never_worse`` has options.
"""

from __future__ import annotations

import multiprocessing
import os
import sys
from collections.abc import Collection, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed

from benchmarks.figures import Report
from benchmarks.never_worse import split
from benchmarks.never_worse.judged import ALL, Judged, judge
from benchmarks.never_worse.report import report

NAMES: tuple[str, ...] = ()
"""Recordings that are judged; none: all."""
_BAR = 30


def run() -> Report:
    """Every recording that is there, by all methods."""
    return report(judged([one for one in split.named() if not NAMES or one.name in NAMES]))


def judged(
    wanted: Sequence[split.Named],
    methods: Collection[str] = ALL,
    has_peers: bool = True,
    processes: int | None = None,
) -> list[Judged]:
    """Return what was found on each recording that is there, in order; the others are named as skipped."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(processes or os.cpu_count(), mp_context=context) as pool:
        waiting = {pool.submit(judge, one, tuple(methods), has_peers): one for one in wanted}
        found: dict[str, Judged] = {}
        for done, future in enumerate(as_completed(waiting), 1):
            name = waiting[future].name
            try:
                found[name] = future.result()
            except (FileNotFoundError, ValueError) as error:
                print(f"skipped {name}: {error}", flush=True)
            _show(done, len(wanted), name)
    return [found[one.name] for one in wanted if one.name in found]


def _show(done: int, total: int, name: str) -> None:
    """Draw how far it is, on a terminal alone."""
    if not sys.stderr.isatty():
        return
    full = _BAR * done // total
    end = "\n" if done == total else ""
    sys.stderr.write(f"\r[{'#' * full}{'.' * (_BAR - full)}] {done}/{total} {name:<28}{end}")
    sys.stderr.flush()
