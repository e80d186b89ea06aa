"""What a suite gives: figures with their targets, and tables for the documentation."""

from __future__ import annotations

import operator
import platform
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

HEADLINES = ["suite", "figure", "value", "unit", "target", "verdict"]
_COMPARISONS = {"<=": operator.le, ">=": operator.ge, "<": operator.lt}


@dataclass(frozen=True)
class Figure:
    """One measured number. ``target`` such as ``<=5``, or empty where nothing is aimed at."""

    name: str
    value: float
    unit: str
    target: str = ""
    note: str = ""
    """What exactly was measured, for the documentation."""

    @property
    def verdict(self) -> str:
        """``met``, ``short``, or ``-`` without a target."""
        if not self.target:
            return "-"
        sign = "<=" if self.target.startswith("<=") else ">=" if self.target.startswith(">=") else "<"
        return "met" if _COMPARISONS[sign](self.value, float(self.target.removeprefix(sign))) else "short"

    def line(self) -> str:
        """The one line that a suite ends with."""
        return (
            f"figure {self.name} {self.value:.4g} {self.unit} target {self.target or 'none'} {self.verdict}"
        )


@dataclass
class Report:
    """All that a suite found out."""

    suite: str
    figures: list[Figure] = field(default_factory=list)
    tables: list[str] = field(default_factory=list)
    """Markdown, each with its own heading."""
    also: str = ""
    """A page beside that of all suites whose readers want the tables: they come between its markers too."""

    def as_json(self) -> dict[str, object]:
        """For ``--json``."""
        return {
            "suite": self.suite,
            "machine": machine(),
            "figures": [asdict(figure) | {"verdict": figure.verdict} for figure in self.figures],
        }

    def markdown(self) -> str:
        """The suite's page section."""
        head = f"Machine: {machine()}. Command: `python -m benchmarks {self.suite}`."
        return "\n\n".join([head, self.figures_table(), *self.tables]) + "\n"

    def figures_table(self) -> str:
        """The figures alone."""
        heads = ["figure", "value", "unit", "target", "verdict", "what"]
        rows = [
            [f"`{f.name}`", f"{f.value:.4g}", f.unit, f.target or "–", f.verdict, f.note]
            for f in self.figures
        ]
        return table(heads, rows)


def table(heads: list[str], rows: list[list[str]]) -> str:
    """A markdown table; columns whose cells are all numbers are set to the right."""
    is_number = [all(_is_number(row[i]) for row in rows) for i in range(len(heads))]
    rule = ["---:" if right else "---" for right in is_number]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in (heads, rule, *rows))


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def machine() -> str:
    """What the figures were measured on."""
    cores = model = ""
    info = Path("/proc/cpuinfo")
    if info.exists():
        lines = info.read_text().splitlines()
        cores = f"{sum(line.startswith('processor') for line in lines)} cores, "
        model = next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), "")
    return f"{cores}{model or platform.machine()}, Python {platform.python_version()}, shared virtual machine"


def write_docs(report: Report, docs: Path, suites: Sequence[str]) -> None:
    """Replace the suite's section of its page in ``docs/figures``, and its lines among the headlines.

    suites: all, in the order of the headlines. Raises ``SystemExit`` where no page has the suite's markers.
    """
    for page in sorted((docs / "figures").glob("*.md")):
        if replace_section(page, report.suite, report.markdown()):
            break
    else:
        raise SystemExit(f"{docs / 'figures'}: no page has the markers of '{report.suite}'")
    if report.also:
        replace_section(docs / report.also, f"{report.suite} tables", "\n\n".join([*report.tables, ""]))
    headlines = docs / "benchmarks.md"
    rows = _headlines(headlines)
    link = f"[{report.suite}](figures/{page.name})"
    rows[report.suite] = [
        [link, f"`{f.name}`", f"{f.value:.4g}", f.unit, f.target, f.verdict]
        for f in report.figures
        if f.target
    ] or [[link, "", "", "", "", ""]]
    ordered = sorted(rows, key=lambda suite: suites.index(suite) if suite in suites else len(suites))
    whole = table(HEADLINES, [row for suite in ordered for row in rows[suite]])
    replace_section(headlines, "headlines", f"{whole}\n")


def _headlines(page: Path) -> dict[str, list[list[str]]]:
    """Return the rows of the page's table by suite."""
    rows: dict[str, list[list[str]]] = {}
    for line in page.read_text(encoding="utf-8").splitlines():
        cells = [cell.strip() for cell in line.strip().strip("|").split("|")]
        if line.startswith("| [") and len(cells) == len(HEADLINES):
            rows.setdefault(cells[0][1 : cells[0].index("]")], []).append(cells)
    return rows


def replace_section(page: Path, name: str, section: str) -> bool:
    """Put a section between the markers of that name; False where they are not."""
    begin, end = f"<!-- begin {name} -->", f"<!-- end {name} -->"
    text = page.read_text(encoding="utf-8")
    before, begun, rest = text.partition(begin)
    _, ended, after = rest.partition(end)
    if begun and ended:
        page.write_text(f"{before}{begin}\n{section}{end}{after}", encoding="utf-8")
    return bool(begun and ended)
