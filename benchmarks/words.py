"""``python -m benchmarks.words``: measure how code and documents are written.

``--write-docs`` puts the figures into docs/figures/words.md; ``--worst N`` prints N places of a kind.
Only functions are asked to begin with a verb; properties name what they are. A function within another and
what is overridden need no docstring.

Reading ease is Flesch's: 206.835 − 1.015 words a sentence − 84.6 syllables a word; 60 is plain English, 30 an
article of science. Tables, code and headings are left out, so are pages with fewer words beside these than
``FEWEST``: so few sentences say nothing of a page. A name in code counts as one short word.
"""

from __future__ import annotations

import argparse
import ast
import io
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from benchmarks.figures import replace_section, table

REPOSITORY = Path(__file__).resolve().parents[1]
PAGE = REPOSITORY / "docs" / "figures" / "words.md"
PACKAGES = ("firmware_protocol", "devices", "gateway")
FEWEST = 100
_NO_VERBS = frozenset(
    re.findall(
        r"\w+",
        """a about after all also an and any around as at back before beside between both by each earlier
        every everybody everything first five for four from how if in its last least less most no not nothing
        of off on one only our over r so some something than that the their there these those three to two
        under unit until what when where whether which who whoever whole whose why with within without""",
    )
)
"""First words that are no verbs, beside plurals, terms in brackets and verbs in the third person."""
_DIRECTIVE = re.compile(r"#\s*(noqa|type:|fmt:|pragma|mypy:|ruff:)|#!")
_VERBS_IN_S = {"address", "bias", "compress", "express", "guess", "miss", "pass", "press", "process", "toss"}


class Code(NamedTuple):
    """What a package counts."""

    lines: int
    comments: int
    blank: int
    docstrings: int
    no_verb: list[str]
    missing: list[str]


def counted(package: str) -> Code:
    """Count one package; places are ``file:line name``."""
    lines = comments = blank = docstrings = 0
    no_verb: list[str] = []
    missing: list[str] = []
    for path in sorted((REPOSITORY / package).rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        lines += text.count("\n")
        blank += sum(not line.strip() for line in text.splitlines())
        comments += sum(
            token.type == tokenize.COMMENT and not _DIRECTIVE.match(token.string)
            for token in tokenize.generate_tokens(io.StringIO(text).readline)
        )
        for function in _functions(ast.parse(text)):
            place = f"{path.relative_to(REPOSITORY)}:{function.lineno} {function.name}"
            docstring = ast.get_docstring(function)
            if docstring is None:
                if not function.name.startswith("_"):
                    missing.append(place)
                continue
            docstrings += 1
            if not begins_with_verb(docstring):
                no_verb.append(f"{place}: {docstring.splitlines()[0]}")
    return Code(lines, comments, blank, docstrings, no_verb, missing)


def _functions(node: ast.AST) -> Iterator[ast.FunctionDef | ast.AsyncFunctionDef]:
    """Yield functions and methods, without those inside others, properties and overloads."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.ClassDef):
            yield from _functions(child)
        elif isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef):
            marks = " ".join(ast.unparse(mark) for mark in child.decorator_list)
            if not re.search(r"property|overload|override|\.setter", marks):
                yield child


def begins_with_verb(docstring: str) -> bool:
    """Judge by the first word whether a docstring begins with a verb in the imperative."""
    word = re.match(r"[A-Z][a-z]+(?=[\s,;.]|$)", docstring)
    if word is None:
        return False
    first = word[0].lower()
    return first not in _NO_VERBS and (not first.endswith("s") or first in _VERBS_IN_S)


def reading_ease(text: str) -> tuple[int, float, float]:
    """Return words, words a sentence, and Flesch's reading ease of a page in markdown."""
    text = re.sub(r"(?s)```.*?```|<!--.*?-->|\$\$.*?\$\$", "", text)
    text = re.sub(r"(?m)^\s*(\|.*|#.*|:.*|!\[.*)$", "", text)
    text = re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", text)
    text = re.sub(r"`[^`]*`|\$[^$]*\$", "it", text)
    sentences = [
        one for one in re.split(r"[.!?](?:\s|$)|\n\s*\n|\n\s*[-*\d]+\.?\s", text) if re.search(r"[a-z]", one)
    ]
    words = re.findall(r"[A-Za-z']+", text)
    if not words or not sentences:
        return 0, 0.0, 100.0
    a_sentence = len(words) / len(sentences)
    return (
        len(words),
        a_sentence,
        206.835 - 1.015 * a_sentence - 84.6 * sum(map(_syllables, words)) / len(words),
    )


def _syllables(word: str) -> int:
    """Count the groups of vowels of an English word, without a silent e."""
    return max(1, len(re.findall(r"[aeiouy]+", re.sub(r"(?<=[^l])e$|es$|ed$", "", word.lower()))))


def documents() -> dict[str, tuple[int, float, float]]:
    """Return the measures of each page that people write, by its path; hardest first."""
    pages = [REPOSITORY / "README.md", REPOSITORY / "CONTRIBUTING.md"]
    pages += [
        page
        for folder in ("guide", "reference", "explanation", "diary", ".")
        for page in (REPOSITORY / "docs" / folder).glob("*.md")
        if page.name not in {"commands.md", "configuration.md", "index.md"}
    ]
    found = {
        str(page.relative_to(REPOSITORY)): reading_ease(page.read_text(encoding="utf-8")) for page in pages
    }
    judged = {page: measures for page, measures in found.items() if measures[0] >= FEWEST}
    return dict(sorted(judged.items(), key=lambda each: each[1][2]))


def section() -> str:
    """Return the tables of the page."""
    rows = []
    for package in PACKAGES:
        code = counted(package)
        shares = [f"{count / code.lines:.1%}" for count in (code.comments, code.blank)]
        verbs = f"{1 - len(code.no_verb) / max(1, code.docstrings):.0%}"
        cells = [
            f"`{package}/`",
            str(code.lines),
            *shares,
            str(code.docstrings),
            verbs,
            str(len(code.missing)),
        ]
        rows.append(cells)
    heads = ["package", "lines", "comments", "blank lines", "docstrings", "begin with a verb", "missing"]
    pages = [
        [page, str(n), f"{a_sentence:.0f}", f"{ease:.0f}"]
        for page, (n, a_sentence, ease) in documents().items()
    ]
    return (
        f"\n## Code\n\n{table(heads, rows)}\n\n## Documents, hardest first\n\n"
        + table(["page", "words", "words a sentence", "reading ease"], pages)
        + "\n\n"
    )


def main() -> None:
    """Print the tables or the worst places, or write the page."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.words", description=__doc__)
    parser.add_argument("--write-docs", action="store_true", help="put the tables into docs/figures/words.md")
    parser.add_argument("--worst", type=int, metavar="N", help="print N places of each kind")
    arguments = parser.parse_args()
    if arguments.worst is not None:
        for package in PACKAGES:
            code = counted(package)
            print(*code.missing[: arguments.worst], *code.no_verb[: arguments.worst], sep="\n")
    elif arguments.write_docs:
        replace_section(PAGE, "words", section())
    else:
        print(section())


if __name__ == "__main__":
    main()
