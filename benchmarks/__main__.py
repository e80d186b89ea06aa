"""``python -m benchmarks SUITE``: one suite, or all."""

from __future__ import annotations

import argparse
import importlib
import json
from pathlib import Path

from benchmarks.figures import Report, write_docs
from benchmarks.results import DOCS, RESULTS, save, write_plots
from benchmarks.suites import SUITES


def run(name: str) -> Report:
    """The figures of one suite."""
    report: Report = importlib.import_module(f"benchmarks.{name}").run()
    return report


def main() -> None:
    """Run suites, print their figures, and write them where asked."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("suite", choices=[*SUITES, "all"])
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures to FILE")
    parser.add_argument(
        "--write-docs",
        action="store_true",
        help="rewrite its page in docs/figures, its JSON in benchmarks/results, and the plots",
    )
    arguments = parser.parse_args()
    names = SUITES if arguments.suite == "all" else (arguments.suite,)
    reports = []
    for name in names:
        print(f"== {name}", flush=True)
        report = run(name)
        for table in report.tables:
            print(table, end="\n\n")
        for figure in report.figures:
            print(figure.line(), flush=True)
        if arguments.write_docs:
            write_docs(report, DOCS, SUITES)
            save(report.as_json())
            write_plots(DOCS, RESULTS, SUITES)
        reports.append(report.as_json())
    if arguments.json:
        arguments.json.write_text(json.dumps(reports if len(reports) > 1 else reports[0], indent=2))


if __name__ == "__main__":
    main()
