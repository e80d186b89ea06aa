"""What fuzzing has been through and reaches: all campaigns, and what the tests' inputs reach."""

from __future__ import annotations

from benchmarks.figures import Figure, Report, table
from benchmarks.fuzzing.campaign import read_ledger, surveyed
from benchmarks.fuzzing.targets import TARGETS


def run() -> Report:
    """A row for every target; the survey runs here and now, hours and executions are those noted."""
    ledger, rows, reached, lines = read_ledger(), [], 0, 0
    for name, target in TARGETS.items():
        account, found = ledger[name], surveyed(target)
        reached, lines = reached + found["reached"], lines + found["lines"]
        rows.append(
            [
                f"`{name}`",
                target.meaning,
                f"{account.seconds / 60:.1f}",
                f"{account.executions}",
                f"{account.findings}",
                f"{len(target.found)}",
                f"{100 * found['reached'] / found['lines']:.0f} % of {found['lines']}",
            ]
        )
    accounts = list(ledger.values())
    report = Report("fuzz")
    report.figures = [
        Figure("fuzz_hours", sum(each.seconds for each in accounts) / 3600, "h", note="all targets together"),
        Figure("fuzz_executions", sum(each.executions for each in accounts), "", note="inputs tried"),
        Figure("fuzz_coverage_percent", 100 * reached / lines, "%", note="lines of the watched functions"),
    ]
    heads = ["target", "reads", "minutes", "executions", "findings", "inputs that broke it", "lines reached"]
    report.tables.append("## Fuzzing, by target\n\n" + table(heads, rows))
    return report
