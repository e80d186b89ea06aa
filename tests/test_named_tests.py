"""Every test that a page names is there: a promise stands only as long as something holds it."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

TESTS = Path(__file__).resolve().parent
SECURITY = TESTS.parent / "docs" / "reference" / "security.md"
PAGES = [TESTS.parent / "README.md", *sorted((TESTS.parent / "docs").rglob("*.md"))]
NAMED = re.compile(r"`(?:tests/)?((?:\w+/)*test_\w+\.py|…)(?:::(\w+))?`")


def names_in(path):
    """The names of a file's tests."""
    nodes = ast.walk(ast.parse(path.read_text()))
    return {n.name for n in nodes if isinstance(n, ast.FunctionDef | ast.AsyncFunctionDef)}


def missing(text):
    """What a page names and is not there; ``…`` stands for the file named last."""
    absent, path = [], None
    for file, name in NAMED.findall(text):
        path = path if file == "…" else TESTS / file
        if path is None or not path.is_file() or (name and name not in names_in(path)):
            absent.append(f"{file}::{name}")
    return absent


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_test_that_a_page_names_is_there(page):
    assert missing(page.read_text()) == []


def test_every_promise_names_its_test():
    table = SECURITY.read_text().partition("| promise | test |\n| --- | --- |\n")[2].partition("\n\n")[0]
    promises = [line for line in table.splitlines() if not NAMED.search(line) and "the same" not in line]
    assert promises == []
    assert len(table.splitlines()) > 40


@pytest.mark.parametrize(
    "named", ["`test_none.py`", "`test_named_tests.py::test_none`", "`…::test_every_promise_names_its_test`"]
)
def test_one_that_is_not_there_is_noticed(named):
    assert missing(named)
    assert not missing("`test_named_tests.py::missing`, `…::names_in`")
