"""Every command that a document shows is one that the program, the Makefile or the tree has.

A line of ``mocap-gateway`` is parsed by the program's own command line, as if typed; it is not run, and files
that it names need not exist. What commands do is tested where they are.
"""

from __future__ import annotations

import contextlib
import importlib.util
import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import typer

from gateway.cli.main import app

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted(
    page
    for pattern in ("*.md", "docs/**/*.md", "docker/**/*.md", "examples/**/*.md", "firmware_protocol/**/*.md")
    for page in ROOT.glob(pattern)
    if "_build" not in page.parts and page.name != "CHANGELOG.md"
)
BLOCK = re.compile(r"(?ms)^[ \t]*```(?:sh|bash|console)\n(.*?)^[ \t]*```")
SPAN = re.compile(r"`((?:\.venv/bin/)?mocap-gateway [^`]+|make [a-z][^`]*|python -m [^`]+)`")
LEFT_OUT = re.compile(r"…|\.\.\.|[<\[][A-Za-z ]+[>\]]")
"""What stands for something that the reader puts in."""
PROGRAM = ("mocap-gateway", ".venv/bin/mocap-gateway", "/opt/mocap-gateway/bin/mocap-gateway")


class Shown(NamedTuple):
    """One command of a page."""

    page: str
    words: list[str]
    is_typed: bool
    """It stands in a block, for readers to type; not within a sentence."""


def lines_of(block: str) -> Iterator[str]:
    """Yield the commands of a block, continued lines joined, prompts and answers of a console left out."""
    whole = block.replace("\\\n", " ")
    has_prompts = re.search(r"(?m)^\s*\$ ", whole) is not None
    for line in map(str.strip, whole.splitlines()):
        if line.startswith("$ ") or not has_prompts:
            yield from re.split(r"\s(?:&&|\|\|?|;|&)\s|\s&$", line.removeprefix("$ "))


def words_of(line: str, variables: dict[str, str]) -> list[str]:
    """Split a line as a shell does, variables of the page put in; without what is set before the command."""
    if set_here := re.match(r'(\w+)="?([^"#$(]*)"?\s*(?:#.*)?$', line):
        variables[set_here[1]] = set_here[2]
        return []
    line = re.sub(r"\$\{?(\w+)\}?", lambda match: variables.get(match[1], "x"), line)
    line = re.sub(r"\$\([^)]*\)|\$\(.*", "x", line)
    try:
        words = shlex.split(line, comments=True)
    except ValueError:
        return []
    while words and (re.match(r"[A-Z_]+=", words[0]) or words[0] in {"sudo", "env", "exec"}):
        words = words[1:]
    ends = [place for place, word in enumerate(words) if re.fullmatch(r"[12]?>>?|<|2>&1|&", word)]
    return words[: ends[0]] if ends else words


def shown() -> list[Shown]:
    """Give all commands of all pages, each once a page."""
    found: dict[tuple[str, str], Shown] = {}
    for page in PAGES:
        text, variables = page.read_text(encoding="utf-8"), dict[str, str]()
        blocks = [line for block in BLOCK.findall(text) for line in lines_of(block)]
        spans = SPAN.findall(re.sub(r"(?s)```.*?```", "", text))
        name = str(page.relative_to(ROOT))
        lines = [(line, True) for line in blocks] + [(" ".join(span.split()), False) for span in spans]
        for line, is_typed in lines:
            words = words_of(line, variables)
            if words and not LEFT_OUT.search(" ".join(words)):
                found.setdefault((name, " ".join(words)), Shown(name, words, is_typed))
    return list(found.values())


SHOWN = shown()
TYPED = [each for each in SHOWN if each.words[0] in PROGRAM]


def named(each: Shown) -> str:
    return f"{each.page}: {' '.join(each.words)}"


def check(command: Any, name: str, words: list[str], patch: pytest.MonkeyPatch, parent: Any = None) -> None:
    """Raise what the program raises for words that it does not take."""
    if not hasattr(command, "commands"):
        for parameter in command.params:
            parameter.callback = None  # it may look at files
            parameter.required = False  # of a span that names an option the rest is left to the reader
            information = parameter.type_descriptor.parameter_info
            patch.setattr(information, "exists", False, raising=False)
        command.make_context(name, list(words), parent=parent)
        return
    context = command.context_class(command, parent=parent, info_name=name)
    if not words or words[0].startswith("-"):
        assert not words or words[0] in {"--help", "-h", "--version", "--install-completion"}, words
        return
    below = command.get_command(context, words[0])
    assert below is not None, f"there is no '{words[0]}' among the commands of {name}"
    check(below, words[0], words[1:], patch, context)


@pytest.mark.parametrize("each", TYPED, ids=named)
def test_the_program_takes_what_is_shown(each, monkeypatch):
    with contextlib.suppress(typer.Exit):  # of --help and --version
        check(typer.main.get_command(app), "mocap-gateway", each.words[1:], monkeypatch)


NEED_A_SUIT = ("calibrate body", "calibrate sensors", "calibrate clocks", "modules list", "modules assign")


@pytest.mark.parametrize("each", TYPED, ids=named)
def test_what_is_typed_says_where_the_suit_is(each):
    """The program takes the line without it, and ends with an error: a newcomer types what stands there."""
    if each.is_typed and " ".join(each.words[1:3]) in NEED_A_SUIT:
        assert {"-c", "--config", "--link", "--mqtt", "--help", "x"} & set(each.words), named(each)


def test_the_makefile_has_what_is_shown():
    targets = set(re.findall(r"(?m)^([a-z][\w-]*(?: [a-z][\w-]*)*):", (ROOT / "Makefile").read_text()))
    targets = {word for target in targets for word in target.split()}
    wanted = {
        (each.page, word)
        for each in SHOWN
        if each.words[0] == "make" and "-C" not in each.words
        for word in each.words[1:]
        if re.fullmatch(r"[a-z][a-z-]*", word)
    }
    assert wanted
    assert not [f"{page}: make {word}" for page, word in sorted(wanted) if word not in targets]


def test_modules_that_are_run_are_there():
    wanted = {
        (each.page, each.words[2])
        for each in SHOWN
        if each.words[0].endswith("python") and each.words[1:2] == ["-m"] and len(each.words) > 2
    }
    ours = [
        one
        for one in wanted
        if one[1].split(".")[0] in {"benchmarks", "devices", "firmware_protocol", "tests", "gateway"}
    ]
    assert ours
    assert not [
        f"{page}: python -m {name}" for page, name in sorted(ours) if importlib.util.find_spec(name) is None
    ]


def test_files_that_are_run_or_copied_are_there():
    missing = [
        f"{each.page}: {word}"
        for each in SHOWN
        for word in (each.words[:-1] if each.words[0] in {"cp", "mv"} else each.words)
        if re.fullmatch(r"(config|examples|docker|benchmarks|devices|gateway|tests)/[\w./-]+", word)
        if not (ROOT / word).exists() and (ROOT / word).parent.name != "dist"
    ]
    assert not missing


def test_every_example_of_the_help_is_a_command():
    """The reference has them a line each; they are parsed above."""
    of_help = [each.words for each in SHOWN if each.page == "docs/reference/commands.md" and each.is_typed]
    assert of_help
    assert not [" ".join(words) for words in of_help if words[0] != PROGRAM[0]]


def test_documents_show_commands():
    assert len(TYPED) > 150
