"""``python -m benchmarks.results``: the figures of every suite as JSON, and the plots made of them.

``python -m benchmarks SUITE --write-docs`` writes ``benchmarks/results/SUITE.json`` as well as the page of
the suite, and plots all suites anew. This command runs nothing and takes the figures from the pages: use it
after a merge that brought a page without its JSON. A page has four digits of a figure, its JSON all of them.
"""

from __future__ import annotations

import html
import json
import math
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from benchmarks.figures import Figure, Report
from benchmarks.suites import SUITES

REPOSITORY = Path(__file__).resolve().parents[1]
RESULTS = Path(__file__).parent / "results"
DOCS = REPOSITORY / "docs"
PLOTS = Path("figures") / "plots"
"""Below ``docs``."""

_SECTION = r"(?s)<!-- begin (\w+) -->\n(.*?)<!-- end \1 -->"
_ROW = r"(?m)^\| `(\w+)` \| ([^|]*) \| ([^|]*) \| ([^|]*) \| [^|]* \| (.*) \|$"
_DECADES = 2
"""How far a plot reaches on either side of the target; what is farther stands at its edge."""


def save(found: dict[str, Any], folder: Path = RESULTS) -> None:
    """Write the JSON of one suite."""
    folder.mkdir(parents=True, exist_ok=True)
    text = json.dumps(found, indent=1, ensure_ascii=False)
    (folder / f"{found['suite']}.json").write_text(f"{text}\n", encoding="utf-8")


def of_pages(docs: Path) -> dict[str, dict[str, Any]]:
    """Read the figures that the pages in ``docs/figures`` show, by suite."""
    found = {}
    for page in sorted((docs / "figures").glob("*.md")):
        for suite, section in re.findall(_SECTION, page.read_text(encoding="utf-8")):
            measured_on = re.search(r"(?m)^Machine: (.*?)\. Command: ", section)
            if measured_on is None:
                continue
            first = section.partition("| figure | value |")[2].partition("\n\n")[0]
            figures = [
                Figure(name, float(value), unit.strip(), target.strip().strip("–"), note.strip())
                for name, value, unit, target, note in re.findall(_ROW, first)
            ]
            found[suite] = Report(suite, figures).as_json() | {"machine": measured_on[1]}
    return found


def stored(folder: Path = RESULTS) -> dict[str, dict[str, Any]]:
    """Read the JSON of every suite."""
    return {path.stem: json.loads(path.read_text(encoding="utf-8")) for path in sorted(folder.glob("*.json"))}


def is_same(page: dict[str, Any], kept: dict[str, Any] | None) -> bool:
    """Judge whether a page shows what is kept as JSON, to the four digits that it has."""
    if kept is None:
        return False
    return [_shown(each) for each in page["figures"]] == [_shown(each) for each in kept["figures"]]


def _shown(figure: dict[str, Any]) -> tuple[str, str, str, str]:
    return figure["name"], f"{figure['value']:.4g}", figure["unit"], figure["target"]


def distance(value: float, target: str) -> float | None:
    """Return the decades by which a figure misses its target, negative where it is better.

    Returns None without a target. Anything beyond the plot is moved to its edge.
    """
    if not target or not math.isfinite(value):
        return None
    bound = float(target.lstrip("<>="))
    worse, better = (bound, value) if target.startswith(">") else (value, bound)
    if worse <= 0.0 or better <= 0.0:
        return -float(_DECADES) if worse <= better else float(_DECADES)
    return min(max(math.log10(worse / better), -_DECADES), _DECADES)


def plot_targets(results: dict[str, dict[str, Any]], suites: Sequence[str]) -> str:
    """Return an SVG with a row for each suite: how far each figure is from its target."""
    rows = [
        (suite, [each for each in results[suite]["figures"] if each["target"]])
        for suite in suites
        if suite in results
    ]
    return _drawing([(suite, figures) for suite, figures in rows if figures])


def plot_beside_vqf(results: dict[str, dict[str, Any]], suites: Sequence[str]) -> str:
    """Return an SVG with a row for each figure that is an error of ``joint`` over that of VQF, target 1."""
    figures = [
        each | {"target": "<=1"}
        for suite in suites
        if suite != "speed"  # those are ratios of times
        for each in results.get(suite, {"figures": []})["figures"]
        if each["name"].endswith("ratio_vqf") and "floor" not in each["name"]  # which is no filter's
    ]
    return _drawing([(each["name"].removesuffix("_ratio_vqf"), [each]) for each in figures], "VQF")


def _drawing(rows: list[tuple[str, list[dict[str, Any]]]], middle: str = "target") -> str:
    """Draw figures as marks on one logarithmic axis, a row for each name; ``middle`` names the place of 1."""
    width, step, top = 400, 18, 30
    left = 40 + 7 * max(len(name) for name, _ in rows)
    height = top + step * len(rows) + 12
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {left + width + 30} {height}" '
        'font-family="sans-serif" font-size="12" fill="#6e7781">',
    ]
    for power in range(-_DECADES, _DECADES + 1):
        x = _place(float(power), left, width)
        stroke, label = ("#6e7781", middle) if power == 0 else ("#6e778155", f"{10.0**power:g} ×")
        lines += [
            f'<line x1="{x:.0f}" y1="{top - 8}" x2="{x:.0f}" y2="{height - 8}" stroke="{stroke}"/>',
            f'<text x="{x:.0f}" y="{top - 14}" text-anchor="middle">{label}</text>',
        ]
    for row, (name, figures) in enumerate(rows):
        y = top + step * row + step // 2
        lines.append(f'<text x="{left - 24}" y="{y + 4}" text-anchor="end">{html.escape(name)}</text>')
        lines += [mark for figure in figures for mark in _marks(figure, y, left, width)]
    return "\n".join([*lines, "</svg>", ""])


def _place(decades: float, left: float, width: float) -> float:
    return left + width * (decades + _DECADES) / (2 * _DECADES)


def _marks(figure: dict[str, Any], y: float, left: float, width: float) -> Iterator[str]:
    """Yield the mark of one figure: a dot where the target is met, a triangle where it is not."""
    far = distance(figure["value"], figure["target"])
    if far is None:
        return
    x = _place(far, left, width)
    words = html.escape(
        f"{figure['name']}: {figure['value']:.4g} {figure['unit']}, target {figure['target']}"
    )
    if Figure(figure["name"], figure["value"], figure["unit"], figure["target"]).verdict == "met":
        shape = f'<circle cx="{x:.1f}" cy="{y}" r="4" fill="#1f6feb99">'
    else:
        shape = f'<path d="M{x - 5:.1f} {y + 4} h10 l-5 -9 z" fill="#d1660f">'
    yield f"{shape}<title>{words}</title></{shape[1:].partition(' ')[0]}>"


def write_plots(docs: Path, folder: Path, suites: Sequence[str]) -> None:
    """Plot what is kept as JSON."""
    results = stored(folder)
    (docs / PLOTS).mkdir(parents=True, exist_ok=True)
    (docs / PLOTS / "targets.svg").write_text(plot_targets(results, suites), encoding="utf-8")
    (docs / PLOTS / "beside_vqf.svg").write_text(plot_beside_vqf(results, suites), encoding="utf-8")


def main() -> None:
    """Bring JSON and plots in line with the pages."""
    kept = stored()
    for suite, found in of_pages(DOCS).items():
        if not is_same(found, kept.get(suite)):
            save(found)
            print(f"{suite}: written from its page")
    write_plots(DOCS, RESULTS, SUITES)


if __name__ == "__main__":
    main()
