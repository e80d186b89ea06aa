"""Every suite of benchmarks is there, and does its smallest case: it runs seldom, and the gateway changes."""

from __future__ import annotations

import importlib
import inspect
import math
import re
import shutil
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from benchmarks import figures, results
from benchmarks.results import DOCS
from benchmarks.suites import SUITES

SMALL: dict[str, dict[str, Any]] = {
    "batch": {"SECONDS": 2.0, "SESSIONS": 2},
    "calibration": {"HEADINGS_DEG": (0,)},
    "chains": {"CHAINS": 3},
    "faults": {
        "CYCLES": 3,
        "FAULTS": (
            {"kind": "reset", "lasts": 0.3, "module": 2},
            {"kind": "unplug", "lasts": 1.0},
        ),
        "SEVERAL": {},
        "BUS_FAULTS": (),
        "SURROUNDINGS": (),
        "PROCESS_FAULTS": (),
    },
    "damage": {"DAMAGED": 300},
    "gaps": {"GAPS_S": (1.0,), "WALK_S": 50.0},
    "held": {"METHODS": ("independent",), "MODULES": (17,), "RATES_HZ": (100,), "SECONDS": 4.0, "TRIES": 1},
    "joints": {"SECONDS": 12.0},
    "latency": {
        "SECONDS": 5.0,
        "SETTLING_TICKS": 20,
        "LOADS": ((17, 100.0),),
        "FLOOR_SECONDS": 5.0,
        "FLOOR_RUNS": 1,
    },
    "never_worse": {"NAMES": ("clipped_101", "slow_arm_101")},
    "outputs": {"SECONDS": 0.5, "REPEATS": 1, "FLOOD": 200, "FROZEN_S": 1.0},
    "overload": {"MODULES": (17,), "RATES_HZ": (100,), "SECONDS": 0.5, "LONG_SECONDS": 2.0},
    "record": {"REPLAYED_S": 3.0, "REPEATS": 1},
    "running": {
        "METHOD": "independent",
        "STOPPED_ON": ("pty",),
        "STOPPED_S": 3.0,
        "WATCHED_S": 4.0,
        "FLOODED_S": 3.0,
        "CALM_AFTER_S": 2.0,
    },
    "sensors": {"SYNTHETIC": 3},
    "start": {
        "REPEATS": 1,
        "TRIES": 1,
        "ALTERNATIONS": 1,
        "FRAMES": 5,
        "SOLVE_NOTHING": (("config", "schema"),),
    },
    "speed": {"REPEATS": 1, "GROWTH_FRAMES": 20},
}
"""What makes a suite's constants those of a small case. Suites that are not here have none but their own."""
ARGUMENTS: dict[str, dict[str, Any]] = {"record": {"seconds": 6.0, "kills": 1}}
HEADLINE = r"(?m)^\| \[(\w+)\]\(figures/(\w+\.md)\) \|(.*)\|(.*)\|(.*)\|(.*)\|(.*)\|$"
NEED_BROKER = {"faults", "held", "latency", "outputs", "record", "running", "start"}


def suite(name: str) -> ModuleType:
    """Skips, with what is not installed."""
    try:
        return importlib.import_module(f"benchmarks.{name}")
    except ModuleNotFoundError as missing:
        if str(missing.name).partition(".")[0] in {"benchmarks", "devices", "firmware_protocol", "gateway"}:
            raise
        pytest.skip(f"{name}: {missing.name} is not installed")


@pytest.mark.parametrize("name", SUITES)
def test_every_suite_runs_without_arguments_and_has_its_place_in_the_page(name: str) -> None:
    run = inspect.signature(suite(name).run)
    assert all(each.default is not inspect.Parameter.empty for each in run.parameters.values())
    assert run.return_annotation == figures.Report.__name__
    pages = [
        text
        for page in (DOCS / "figures").glob("*.md")
        if f"<!-- begin {name} -->" in (text := page.read_text())
    ]
    assert len(pages) == 1
    assert f"<!-- end {name} -->" in pages[0]


def test_the_headlines_are_the_figures_with_an_aim_of_all_pages() -> None:
    shown: dict[str, list[list[str]]] = {}
    pages: dict[str, str] = {}
    for suite_, page, *cells in re.findall(HEADLINE, (DOCS / "benchmarks.md").read_text()):
        shown.setdefault(suite_, []).append([cell.strip() for cell in cells])
        pages[suite_] = (DOCS / "figures" / page).read_text()
    assert list(shown) == list(SUITES)
    for name, text in pages.items():
        section = text.partition(f"<!-- begin {name} -->")[2].partition("<!-- end")[0]
        first = section.partition("| figure | value |")[2].partition("\n\n")[0]
        figures_ = [line.strip("| ").split(" | ") for line in first.splitlines() if line.startswith("| `")]
        aimed = [[cell.strip() for cell in each[:5]] for each in figures_ if each[3].strip() != "–"]
        assert shown[name] == (aimed or [[""] * 5]), name


def test_json_stands_beside_every_suite_and_says_what_its_page_says() -> None:
    """Where a merge brought one without the other: ``python -m benchmarks.results``."""
    pages, kept = results.of_pages(DOCS), results.stored()
    assert set(kept) == set(pages) == set(SUITES)
    assert [name for name in SUITES if not results.is_same(pages[name], kept[name])] == []
    assert sum(len(each["figures"]) for each in kept.values()) > 300


def test_plots_are_those_of_the_json() -> None:
    kept = results.stored()
    for name, drawn in (("targets", results.plot_targets), ("beside_vqf", results.plot_beside_vqf)):
        assert (DOCS / results.PLOTS / f"{name}.svg").read_text() == drawn(kept, SUITES), name


@pytest.mark.parametrize(
    ("value", "target", "decades"),
    [(1.0, "<=10", -1.0), (10.0, "<1", 1.0), (10.0, ">=100", 1.0), (0.0, "<=0", -2.0), (1.0, "<=0", 2.0)],
)
def test_a_plot_says_by_how_much_a_target_is_missed(value: float, target: str, decades: float) -> None:
    assert results.distance(value, target) == pytest.approx(decades)


def test_a_suite_rewrites_its_page_and_its_headlines_alone(tmp_path: Path) -> None:
    (tmp_path / "figures").mkdir()
    page, headlines = tmp_path / "figures" / "both.md", tmp_path / "benchmarks.md"
    page.write_text(
        "# Both\n\n<!-- begin one -->\nold\n<!-- end one -->\nkept\n<!-- begin two -->\n<!-- end two -->\n"
    )
    headlines.write_text(
        "<!-- begin headlines -->\n"
        "| [two](figures/both.md) | `b` | 1 |  | <2 | met |\n"
        "<!-- end headlines -->\n"
    )
    report = figures.Report("one", [figures.Figure("a", 3.0, "s", "<2"), figures.Figure("c", 4.0, "s")])
    figures.write_docs(report, tmp_path, ("one", "two"))
    assert "old" not in page.read_text()
    assert "kept" in page.read_text()
    assert "`c`" in page.read_text()
    assert headlines.read_text().splitlines()[3:] == [
        "| [one](figures/both.md) | `a` | 3 | s | <2 | short |",
        "| [two](figures/both.md) | `b` | 1 |  | <2 | met |",
        "<!-- end headlines -->",
    ]
    with pytest.raises(SystemExit, match="no page has the markers of 'three'"):
        figures.write_docs(figures.Report("three"), tmp_path, ("one", "two"))


@pytest.mark.slow(reason="the smallest case of a suite still takes up to a minute")
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("name", SMALL)
def test_a_small_case_gives_figures(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if name in NEED_BROKER and shutil.which("mosquitto", path="/usr/sbin:/usr/local/sbin:/usr/bin") is None:
        pytest.skip("mosquitto is not installed")
    module = suite(name)
    for constant, value in SMALL[name].items():
        assert hasattr(module, constant)
        monkeypatch.setattr(module, constant, value)
    report = module.run(**ARGUMENTS.get(name, {}))
    assert report.suite == name
    assert report.figures
    assert any(math.isfinite(figure.value) for figure in report.figures)
