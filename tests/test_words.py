"""Words that the field does not use, or that this project has given up, stay out of code and documents.

The list is that of docs/reference/glossary.md, "Words that were given up".
"""

from __future__ import annotations

import io
import keyword
import re
import subprocess
import tokenize
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).parents[1]
ESTIMATOR = ("gateway/reconstruction/inertial/", "docs/explanation/estimator", "docs/diary/estimator")
NUMERICS = "gateway/reconstruction/inertial/"
PROGRAM = ("gateway/", "devices/", "firmware_protocol/", "benchmarks/", "examples/")


class Retired(NamedTuple):
    """A word that is not used, by a regular expression, and what is said instead."""

    pattern: str
    instead: str
    where: tuple[str, ...] = ("",)
    """Beginnings of the paths where it is retired; elsewhere the word may mean something else."""
    but: str = " "
    """Beginning of the paths that still have it."""
    endings: tuple[str, ...] = ()
    """Endings of the files where it is looked for; empty: all texts."""


RETIRED = (
    Retired(r"gyrometer", "gyroscope"),
    Retired(r"\bhabits?\b", "motion statistics"),
    Retired(r"misfit", "normalised innovation squared (NIS)"),
    Retired(r"\bdoubt(s|ed|ing)?\b", "noise inflation, or NIS", ESTIMATOR),
    Retired(r"\bbending\b", "second-order variance", ESTIMATOR),
    Retired(r"\bheading (opens|is open)\b|\bopen heading", "heading observable", ESTIMATOR),
    Retired(r"\bswing matri(x|ces)\b", "filtered lever-arm matrix"),
    Retired(r"\bheld up\b", "aided, or delayed"),
    Retired(r"\banchored\b", "aided, or fixed"),
    Retired(r"\bhears\b", "receives; of a link: has_link"),
    Retired(r"\bwhat is told\b", "a verb and its object: publish, report, print", but=NUMERICS),
    Retired(r"\bnothing is remembered\b", "no-op: stateless"),
    Retired(r"\b\w*_happened\b", "apply_event", PROGRAM, NUMERICS, (".py",)),
    Retired(r"\b\w*_told\w*|\btold(_\w+|\b(?=\())", "report, errors, known", PROGRAM, NUMERICS, (".py",)),
    Retired(r"\b_?deeds?\b", "action, command"),
    Retired(r"\b\w*_telling\b", "progress, reported, observable", PROGRAM, NUMERICS, (".py",)),
)
NAMES = re.compile(
    r"(^|_)(told|tells?|telling|heard|unheard|hears?|spoken|speaks|said|says?|voices?|believed)(_|$)"
)
"""Verbs of speech as names: what is meant is a report, a message, a sample or a publication."""
NAMED_BY_OTHERS = {"tell"}
"""As a method: the place in a file, which Python calls so."""
_OPTIONS = {"speaks": "the option --speaks of emulate"}
_CODE = ("gateway/", "devices/", "firmware_protocol/", "benchmarks/")

ALLOWED = {
    "gateway/support/former_names.py": "reads files of the release before",
    "tests/gateway/test_former_names.py": "writes such files",
    "tests/test_words.py": "names them",
    "docs/reference/glossary.md": "names them",
    "CHANGELOG.md": "says what was renamed",
}
"""File to why a retired word stands there."""
_TEXTS = (".py", ".md", ".yaml", ".json", ".toml", ".c", ".h", ".ino", ".js", ".html", ".sh")


def _texts() -> dict[str, list[str]]:
    """Give the lines of every text that belongs to the repository, by its path."""
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=False)
    if listed.returncode != 0:
        pytest.skip("not a clone of the repository: which files belong to it is not known")
    names = [name for name in listed.stdout.split("\0") if name.endswith(_TEXTS) and name not in ALLOWED]
    return {
        name: (ROOT / name).read_text(encoding="utf-8").splitlines()
        for name in names
        if (ROOT / name).exists()
    }


def test_no_retired_word_is_used():
    texts = _texts()
    assert len(texts) > 500
    found = []
    for word in RETIRED:
        pattern = re.compile(word.pattern, re.IGNORECASE)
        found += [
            f"{name}:{number}: say '{word.instead}', not '{match[0]}'"
            for name, lines in texts.items()
            if name.startswith(word.where)
            and not name.startswith(word.but)
            and name.endswith(word.endings or _TEXTS)
            for number, line in enumerate(lines, 1)
            for match in pattern.finditer(line)
        ]
    assert not found, f"{len(found)} retired words\n" + "\n".join(found)


def test_no_name_is_a_verb_of_speech():
    listed = [name for name in _texts() if name.startswith(_CODE)]
    found = []
    for name in listed:
        if not name.endswith(".py"):
            continue
        source = (ROOT / name).read_text(encoding="utf-8")
        for token in tokenize.generate_tokens(io.StringIO(source).readline):
            if token.type != tokenize.NAME or keyword.iskeyword(token.string):
                continue
            if NAMES.search(token.string.lower()) and token.string not in {*NAMED_BY_OTHERS, *_OPTIONS}:
                found.append(f"{name}:{token.start[0]}: {token.string}")
    assert not found, f"{len(found)} names\n" + "\n".join(found)


def test_the_glossary_names_every_word_that_was_given_up():
    glossary = (ROOT / "docs/reference/glossary.md").read_text(encoding="utf-8")
    _, _, retired = glossary.partition("## Words that were given up")
    missing = [word.instead for word in RETIRED if word.instead not in retired]
    assert not missing, missing
