"""``python -m benchmarks.never_worse``: some recordings, some methods, what is wrong with one."""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from benchmarks.figures import table
from benchmarks.never_worse import judged, peers, split
from benchmarks.never_worse.case import Case
from benchmarks.never_worse.judged import ALL
from benchmarks.never_worse.judging import heading_errors, tilt_errors
from benchmarks.never_worse.report import report, write_table
from benchmarks.never_worse.solving import OURS, live
from gateway.frames import FloatArray

BINS = 12


def main() -> None:
    """Print figures and tables."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.never_worse", description=__doc__)
    for part in split.PARTS:
        parser.add_argument(f"--{part}", action="store_true", help=f"recordings of the {part} part alone")
    parser.add_argument(
        "--recordings", nargs="+", metavar="NAME", help="these alone; a beginning of names will do"
    )
    parser.add_argument("--methods", nargs="+", choices=ALL, default=[OURS], help="default: joint, live")
    parser.add_argument("--all-methods", action="store_true", help="all of the gateway's")
    parser.add_argument("--without-peers", action="store_true", help="VQF alone beside it")
    parser.add_argument("--processes", type=int, metavar="N")
    parser.add_argument("--table", type=Path, metavar="FILE", help="write every error of every method as CSV")
    parser.add_argument("--diagnose", metavar="NAME", help="errors over time by segment of one recording")
    arguments = parser.parse_args()
    if arguments.diagnose:
        diagnose(split.case(arguments.diagnose))
        return
    parts = [part for part in split.PARTS if getattr(arguments, part)]
    starts = tuple(arguments.recordings or [""])
    wanted = [one for one in split.named(*parts) if one.name.startswith(starts)]
    if not wanted:
        parser.error(f"no recording is called so; there are: {', '.join(one.name for one in split.named())}")
    begun_s = time.monotonic()
    methods = ALL if arguments.all_methods else arguments.methods
    if OURS not in methods:
        methods = [OURS, *methods]
    found = judged(wanted, methods, not arguments.without_peers, arguments.processes)
    result = report(found)
    for each in result.tables:
        print(each, end="\n\n")
    for figure in result.figures:
        print(figure.line(), figure.note, sep="  # ")
    print(f"{len(found)} recordings in {time.monotonic() - begun_s:.0f} s")
    if arguments.table:
        write_table(found, arguments.table)


def diagnose(case: Case) -> None:
    """Print tilt and heading errors by segment, mean over parts of the time, of VQF and of every variant."""
    solutions = {name: q for name, q in peers.vqf(case).items() if name in (peers.VQF_6, peers.VQF_9)}
    solutions |= {f"joint, {v}": live(OURS, case, v).q_wb for v in case.variants}
    parts = np.array_split(np.arange(len(case.frames)), BINS)
    heads = ["solution", "segment", *(f"{case.times_s[part[0]]:.0f} s" for part in parts)]
    for word, errors in (("Tilt", tilt_errors), ("Heading", heading_errors)):
        rows = []
        for name, q_wb in solutions.items():
            off = np.degrees(errors(case, q_wb))
            for s, segment in enumerate(case.suit.skeleton.segment_names):
                rows.append([name, segment, *(_mean_of(off[part, s], word) for part in parts)])
        means = "signed mean" if word == "Heading" else "RMS"
        print(f"## {word} error, degrees ({means})", table(heads, rows), sep="\n\n", end="\n\n")


def _mean_of(values: FloatArray, word: str) -> str:
    if not np.isfinite(values).any():
        return "–"
    return f"{np.nanmean(values):.1f}" if word == "Heading" else f"{np.sqrt(np.nanmean(values**2)):.1f}"


if __name__ == "__main__":
    main()
