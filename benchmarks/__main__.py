"""``python -m benchmarks accuracy|speed|latency|faults|clock|record|walking|joints|sensors|all``."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path

from benchmarks import accuracy, clock, faults, joints, latency, record, sensors, speed, walking
from benchmarks.figures import Report, write_docs

SUITES: dict[str, Callable[[], Report]] = {
    "accuracy": accuracy.run,
    "speed": speed.run,
    "latency": latency.run,
    "faults": faults.run,
    "clock": clock.run,
    "walking": walking.run,
    "record": record.run,
    "joints": joints.run,
    "sensors": sensors.run,
}
PAGE = Path(__file__).parent.parent / "docs" / "benchmarks.md"


def main() -> None:
    """Run suites, print their figures, and write them where asked."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("suite", choices=[*SUITES, "all"])
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures to FILE")
    parser.add_argument("--write-docs", action="store_true", help=f"rewrite the tables in {PAGE.name}")
    arguments = parser.parse_args()
    names = list(SUITES) if arguments.suite == "all" else [arguments.suite]
    reports = []
    for name in names:
        print(f"== {name}", flush=True)
        report = SUITES[name]()
        for table in report.tables:
            print(table, end="\n\n")
        for figure in report.figures:
            print(figure.line(), flush=True)
        if arguments.write_docs:
            write_docs(report, PAGE)
        reports.append(report.as_json())
    if arguments.json:
        arguments.json.write_text(json.dumps(reports if len(reports) > 1 else reports[0], indent=2))


main()
