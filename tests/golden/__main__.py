"""The golden set's commands.

python -m tests.golden renew [CASE ...] [--here]   poses that moved are stored anew; by how much each did
python -m tests.golden check [CASE ...]            the same, and nothing is stored
python -m tests.golden record NAME ...             recordings that join the set, with their poses
"""

from __future__ import annotations

import gateway  # noqa: F401 - before NumPy: settles which instructions it takes

# isort: split
import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tests.golden.golden_set import FOLDER, Case, cases
from tests.golden.poses import (
    Comparison,
    StoredPoses,
    compare,
    other_kind,
    read_poses,
    sha256,
    this_machine,
    write_poses,
)
from tests.golden.recipes import RECIPES, SECONDS, write_capture

_HEAD = (
    f"{'recording.method':<32} {'poses':>5} {'moved':>5}  {'angle °':>8} {'place m':>8} {'sigma °':>8} "
    f"{'ω rad/s':>8} {'a m/s²':>8}"
)


@dataclass(frozen=True)
class Outcome:
    """What became of one case."""

    has_moved: bool
    row: str
    """Of the table."""


def judged(case: Case, now: StoredPoses, is_here: bool = False) -> Outcome:
    """Compare the poses of now with the stored ones; is_here: see ``renew``."""
    if not case.poses_path.exists():
        return Outcome(True, f"{len(now.poses):>5} {'new':>5}")
    before = read_poses(case.poses_path)
    found, other = compare(before.poses, now.poses), other_kind(before.machine)
    if found.is_identical and not (other and is_here):
        is_of_another = before.recording_sha256 != now.recording_sha256
        return Outcome(is_of_another, _row(found, "of another recording" if is_of_another else ""))
    if other and found.is_within_tolerance:
        note = f"made on another kind of machine ({other})"
        return Outcome(is_here, _row(found, note))
    return Outcome(True, _row(found, found.first))


def _row(found: Comparison, note: str) -> str:
    shown = [
        np.degrees(found.largest["angle"]), found.largest["p_w"], np.degrees(found.largest["sigma"]),
        found.largest["angular_rate"], found.largest["joint_acceleration"],
    ]  # fmt: skip
    figures = " ".join(f"{value:>8.1e}" if value else f"{0:>8}" for value in shown)
    return f"{found.now:>5} {found.moved:>5}  {figures}  {note}".rstrip()


def renew(chosen: Sequence[Case], *, is_stored: bool = True, is_here: bool = False) -> int:
    """Make the poses of all cases and print by how much they moved. Return how many cases have moved.

    is_stored: moved ones take the place of those before. is_here: so do those that differ only by another
    machine's rounding; from then on this kind of machine is the one that tells every bit.
    """
    moved = []
    print(_HEAD)
    for case in chosen:
        now = StoredPoses(case.solved(), this_machine(), sha256(case.recording_path))
        outcome = judged(case, now, is_here)
        print(f"{case!s:<32} {outcome.row}", flush=True)
        if outcome.has_moved:
            moved.append(str(case))
        if outcome.has_moved and is_stored:
            case.poses_path.parent.mkdir(exist_ok=True)
            write_poses(case.poses_path, now)
    unchanged = f"unchanged: {len(chosen) - len(moved)} of {len(chosen)}"
    what = "renewed" if is_stored else "moved"
    print(f"{what}: {', '.join(moved)}; {unchanged}" if moved else unchanged)
    return len(moved)


def record(name: str, folder: Path = FOLDER, seconds: float = SECONDS) -> None:
    """Make a recording that joins the set. Raises ``RecordingError`` when it is there: it stays as it is."""
    path = Case(name, "", folder).recording_path
    path.parent.mkdir(parents=True, exist_ok=True)
    write_capture(path, RECIPES[name](seconds))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command. Return its exit code."""
    parser = argparse.ArgumentParser("python -m tests.golden", description=__doc__.splitlines()[0])
    parser.add_argument("command", choices=("renew", "check", "record"))
    parser.add_argument("names", nargs="*", help="cases, as RECORDING or RECORDING.METHOD; none: all")
    parser.add_argument(
        "--here", action="store_true", help="renew what differs by another machine's rounding, too"
    )
    given = parser.parse_intermixed_args(arguments)
    unknown = [name for name in given.names if not any(_is_named(case, [name]) for case in cases())]
    if unknown or (given.command == "record" and not given.names):
        parser.error(f"no case {unknown[0]!r}" if unknown else "record: name the recordings to be made")
    if given.command == "record":
        for name in given.names:
            record(name)
    chosen = [case for case in cases() if _is_named(case, given.names)]
    n_moved = renew(chosen, is_stored=given.command != "check", is_here=given.here)
    return int(given.command == "check" and n_moved > 0)


def _is_named(case: Case, names: Sequence[str]) -> bool:
    return not names or case.recording in names or str(case) in names


if __name__ == "__main__":
    sys.exit(main())
