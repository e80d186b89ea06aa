"""``python -m benchmarks.fuzzing.campaign --minutes 30 [TARGET …]``: fuzz one target after another.

Begins with what ``seeds`` makes and with what once broke something (``tests/fuzz/corpora``). What reached
new code is kept in ``build/fuzz/corpora`` for the next campaign here; time, executions and findings are added
up in ``tests/fuzz/ledger.json``. Ends with 1 when an input broke a check; that input is kept where it says.
Once it is mended, the input goes to ``tests/fuzz/corpora``, named for what it found.
Needs Atheris (Linux on x86-64): ``make fuzz`` installs it.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from benchmarks.fuzzing.seeds import seeds
from benchmarks.fuzzing.targets import CORPORA, TARGETS, Target

LEDGER = CORPORA.parent / "ledger.json"
FINDINGS = Path("build/fuzz")
"""Where inputs go that broke something."""
KEPT = FINDINGS / "corpora"
"""A folder for every target, of inputs that reached something new."""
LARGEST_CORPUS = 64 * 1024
"""Bytes kept a target."""
INPUT_TIMEOUT_S = 10
LARGEST_MEMORY_MB = 2048
_GRACE_S = 120
_SURVEY_S = 900
_RUNS = re.compile(r"(?:^#|stat::number_of_executed_units: )(\d+)", re.MULTILINE)


@dataclass
class Account:
    """What one target has been through, all campaigns together."""

    seconds: float = 0.0
    executions: int = 0
    findings: int = 0


@dataclass
class Result:
    """One target in one campaign."""

    executions: int
    seconds: float
    finding: Path | None
    output: str = field(repr=False)


def fuzz(target: Target, seconds: float) -> Result:
    """Run one target; what it found is kept."""
    kept = KEPT / target.name
    kept.mkdir(parents=True, exist_ok=True)
    before = set(FINDINGS.iterdir())
    with tempfile.TemporaryDirectory(prefix="mocap-fuzz-") as folder, _beginnings(target) as first:
        begun = time.monotonic()
        arguments = [f"-max_total_time={round(seconds)}", folder, str(kept), first]
        output = _run(target, arguments, seconds + _GRACE_S)
        took_s = time.monotonic() - begun
        _keep(target, Path(folder))
    new = sorted(set(FINDINGS.iterdir()) - before)
    return Result(_executions(output), took_s, new[0] if new else None, output)


@contextlib.contextmanager
def _beginnings(target: Target) -> Iterator[str]:
    """Lay out, in a folder for the time being, what is good and what once broke something."""
    with tempfile.TemporaryDirectory(prefix="mocap-fuzz-") as folder:
        for number, data in enumerate([*seeds(target), *(path.read_bytes() for path in target.found)]):
            (Path(folder) / str(number)).write_bytes(data)
        yield folder


def _run(target: Target, arguments: list[str], timeout_s: float) -> str:
    command = [
        *("nice", sys.executable, "-m", "benchmarks.fuzzing.child", target.name),
        *(f"-max_len={target.largest}", f"-timeout={INPUT_TIMEOUT_S}", f"-rss_limit_mb={LARGEST_MEMORY_MB}"),
        *(f"-artifact_prefix={FINDINGS}/{target.name}-", "-print_final_stats=1", *arguments),
    ]
    try:
        done = subprocess.run(
            command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, timeout=timeout_s, check=False
        )
        output = done.stdout
    except subprocess.TimeoutExpired as late:  # a machine with too much to do: what it did counts
        output = late.stdout or b""
    return output.decode(errors="replace")


def _executions(output: str) -> int:
    return max((int(found.group(1)) for found in _RUNS.finditer(output)), default=0)


def surveyed(target: Target, *folder: str) -> dict[str, Any]:
    """``coverage`` in a process of its own, since modules must not be imported yet."""
    command = [sys.executable, "-m", "benchmarks.fuzzing.coverage", target.name, *folder]
    done = subprocess.run(["nice", *command], stdout=subprocess.PIPE, timeout=_SURVEY_S, check=True)
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


def _keep(target: Target, found: Path) -> None:
    """Of what was found, keep what reaches more than all before, shortest first, while there is room."""
    kept = KEPT / target.name
    room = LARGEST_CORPUS - sum(path.stat().st_size for path in kept.iterdir())
    for name in surveyed(target, str(kept), str(found))["adding"]:
        data = (found / name).read_bytes()
        room -= len(data)
        if room < 0:
            break
        (kept / name).write_bytes(data)


def read_ledger() -> dict[str, Account]:
    """By target; those never fuzzed have nothing in it."""
    plain = json.loads(LEDGER.read_text()) if LEDGER.is_file() else {}
    return {name: Account(**plain.get(name, {})) for name in TARGETS}


def _note(name: str, result: Result) -> None:
    ledger = read_ledger()
    account = ledger[name]
    account.seconds = round(account.seconds + result.seconds, 1)
    account.executions += result.executions
    account.findings += result.finding is not None
    LEDGER.write_text(json.dumps({key: asdict(each) for key, each in ledger.items()}, indent=1) + "\n")


def main() -> int:
    """Parse, run, tell."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.fuzzing.campaign", description=__doc__)
    parser.add_argument("targets", nargs="*", metavar="TARGET", help=f"of: {', '.join(TARGETS)}; none: all")
    parser.add_argument("--minutes", type=float, default=30.0, help="all targets together")
    arguments = parser.parse_args()
    unknown = sorted(set(arguments.targets) - set(TARGETS))
    if unknown:
        parser.error(f"no target '{unknown[0]}'; there are {', '.join(TARGETS)}")
    names = arguments.targets or list(TARGETS)
    seconds = max(arguments.minutes * 60.0 / len(names), 1.0)
    broken = 0
    for name in names:
        result = fuzz(TARGETS[name], seconds)
        _note(name, result)
        print(f"{name}: {result.executions} executions in {result.seconds:.0f} s", flush=True)
        if result.finding is not None:
            broken += 1
            tail = "\n".join(result.output.splitlines()[-60:])
            print(f"{name}: BROKEN by {result.finding}\n{tail}", flush=True)
    return 1 if broken else 0


if __name__ == "__main__":
    sys.exit(main())
