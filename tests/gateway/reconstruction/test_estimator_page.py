"""The page that states the estimator's model and the code that computes it name each other."""

from __future__ import annotations

import importlib
import re
import tokenize
from pathlib import Path

ROOT = Path(__file__).parents[3]
PACKAGE = "gateway.reconstruction.inertial"
FOLDER = ROOT / PACKAGE.replace(".", "/")
PAGE = (ROOT / "docs/explanation/estimator.md").read_text()
FILES = {path.stem: path for path in (*(FOLDER / "tree").glob("*.py"), FOLDER / "contacts.py")}


def named(text: str) -> set[int]:
    """Numbers of equations in comments, docstrings or a page: (5), (28) to (34)."""
    found: set[int] = set()
    for first, last in re.findall(r"(?<!\w)\((\d{1,2})\)(?: to \((\d{1,2})\))?", text):
        found |= set(range(int(first), int(last or first) + 1))
    return found


def words(path: Path) -> str:
    """Comments and docstrings of a file: its code has numbers in brackets of its own."""
    with tokenize.open(path) as file:
        tokens = [token.string for token in tokenize.generate_tokens(file.readline)]
    return "\n".join(text for text in tokens if text.startswith(("#", '"""')))


NUMBERS = [int(number) for number in re.findall(r"\\tag\{(\d+)\}", PAGE)]


def test_equations_are_numbered_in_order():
    assert list(range(1, len(NUMBERS) + 1)) == NUMBERS
    assert len(NUMBERS) >= 60


def test_code_names_every_equation_and_no_other():
    in_code = set().union(*(named(words(path)) for path in FILES.values()))
    assert in_code == set(NUMBERS)


def test_the_page_speaks_of_no_other_equations():
    assert named(PAGE) <= set(NUMBERS)


def test_every_section_says_where_its_code_is():
    sections = re.split(r"^## (?=\d+\.)", PAGE, flags=re.MULTILINE)[1:]
    without = [text.splitlines()[0] for text in sections if "tag{" in text and "\nCode: " not in text]
    assert not without
    places = re.findall(r"`(\w+)\.(\w+)`", " ".join(re.findall(r"^Code: .*", PAGE, flags=re.MULTILINE)))
    assert len(places) > 20
    for file, name in places:
        room = PACKAGE if file == "contacts" else f"{PACKAGE}.tree"
        assert hasattr(importlib.import_module(f"{room}.{file}"), name), f"{file}.{name}"
