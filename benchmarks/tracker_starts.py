"""How often ``joint`` finds the headings of trackers that begin with none: starts with other noise.

A heading that is not found stays wrong: the table of suite ``trackers`` is of one start a motion.
"""

from __future__ import annotations

from benchmarks import trackers
from benchmarks.figures import Figure, Report, table

STARTS = 6
MINUTES = 2.5
FOUND_DEG = 20.0
"""A segment further off than this against the others has not found its heading."""
MOTIONS = ("walking", "chain")


def run() -> Report:
    """Starts of the quicker motions."""
    report, rows = Report("tracker_starts", also="guide/slimevr.md"), []
    for motion in trackers.motions():
        key = motion.name.split(" ")[0]
        if key not in MOTIONS:
            continue
        worst = [_worst_deg(motion, seed) for seed in range(1, STARTS + 1)]
        found = sum(each <= FOUND_DEG for each in worst)
        rows.append([motion.name, f"{found} of {STARTS}", ", ".join(f"{each:.0f}" for each in worst)])
        what = f"of {STARTS} starts, those with every heading found after {MINUTES:g} min"
        report.figures.append(Figure(f"{key}_starts_found", found, "", f">={STARTS}", what))
    heads = ["motion", "starts with all headings found", "worst segment of each, degrees"]
    report.tables.append(f"Starts of `joint`, after {MINUTES:g} minutes:\n\n" + table(heads, rows))
    return report


def _worst_deg(motion: trackers.Motion, seed: int) -> float:
    return trackers.measure(motion, MINUTES, seed).joint[trackers.MINUTES[0]].worst
