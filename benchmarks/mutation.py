"""``python -m benchmarks.mutation --count 50 --seed 20``: how many small faults in the core the tests find.

A sample of single tokens of the core is changed, one at a time, in a copy of the tree: an operator becomes
its neighbour, a comparison turns round, a number becomes another, a truth value the opposite. Tests run until
the first that fails, those nearest to the change first; a change that all pass survives, and wants a test, or
is no fault: say why. (Tools for this change everything, and run all tests for each: here a kernel takes half
a minute to compile, so a sample is drawn, and the order of the tests matters.)
"""

from __future__ import annotations

import argparse
import ast
import io
import json
import keyword
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
import tokenize
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[1]
CORE = (
    "gateway/reconstruction/inertial",
    "gateway/clocks",
    "gateway/stages/frame_assembler.py",
    "gateway/stages/fused_assembler.py",
    "firmware_protocol",
)
NEAR = {
    "gateway/reconstruction": ("tests/golden", "tests/gateway/reconstruction", "tests/accuracy"),
    "gateway/clocks": ("tests/gateway/clocks", "tests/golden"),
    "gateway": ("tests/golden", "tests/gateway/test_*.py"),
    "firmware_protocol": ("tests/firmware_protocol", "tests/golden", "tests/devices"),
}
"""Where the tests stand that know most of a change, by the beginning of the changed file's path."""
OPERATORS = {
    "+": "-", "-": "+", "*": "/", "/": "*", "//": "*", "%": "*", "**": "*", "@": "*",
    "<": ">", "<=": ">=", ">": "<", ">=": "<=", "==": "!=", "!=": "==",
    "+=": "-=", "-=": "+=", "*=": "/=", "/=": "*=", "|": "&", "&": "|", "^": "|", "<<": ">>", ">>": "<<",
    "and": "or", "or": "and", "True": "False", "False": "True", "min": "max", "max": "min",
}  # fmt: skip
FOR_THE_READER = ("frozen=", "slots=", "kw_only=", "strict=")
"""Arguments that guard against faults yet to be made: nothing that runs today depends on them."""
TIMEOUT_S = 1500


@dataclass(frozen=True, slots=True)
class Mutation:
    """One token and what it becomes."""

    file: str
    line: int
    column: int
    old: str
    new: str

    def __str__(self) -> str:
        return f"{self.file}:{self.line}:{self.column} {self.old} → {self.new}"


def changed(token: tokenize.TokenInfo) -> str | None:
    """Return what a token becomes; None where it is none that is changed."""
    if token.type == tokenize.NUMBER:
        value = complex(token.string) if token.string[-1] in "jJ" else ast.literal_eval(token.string)
        return repr(value + 1) if isinstance(value, int) else repr(1.5 * value or 1.0)
    if token.type == tokenize.OP or keyword.iskeyword(token.string) or token.string in ("min", "max"):
        return OPERATORS.get(token.string)
    return None


def mutations(path: Path) -> Iterator[Mutation]:
    """Yield all changes of a file; none in imports, signatures and types, where they mean something else."""
    name, depth = str(path.relative_to(REPOSITORY)), 0
    is_passed_over = False
    for token in tokenize.generate_tokens(io.StringIO(path.read_text()).readline):
        if token.type == tokenize.NAME and depth == 0 and token.string in ("import", "from", "def", "class"):
            is_passed_over = True
        if token.type == tokenize.OP:
            depth += (token.string in "([{") - (token.string in ")]}")
        if token.type == tokenize.NEWLINE or (token.string == ":" and depth == 0):
            is_passed_over = False
        new = None if is_passed_over or _is_declaration(token) else changed(token)
        if new is not None:
            yield Mutation(name, *token.start, token.string, new)


def _is_declaration(token: tokenize.TokenInfo) -> bool:
    """Whether a token only hands arguments on, decorates, names a type, or guards against later faults."""
    before = token.line[: token.start[1]].rstrip()
    is_first = not before or before[-1] in "([{,="
    return (
        (token.string in ("*", "**") and is_first)
        or (token.string == "@" and not before)
        or before.endswith(FOR_THE_READER)
        or (token.string == "|" and " | None" in token.line)
    )


def sample(count: int, seed: int) -> list[Mutation]:
    """Draw changes at random from all of the core."""
    files = (path for place in CORE for path in _sources(REPOSITORY / place))
    everything = [mutation for path in files for mutation in mutations(path)]
    return random.Random(seed).sample(everything, count)


def _sources(place: Path) -> list[Path]:
    return sorted(place.rglob("*.py")) if place.is_dir() else [place]


def stages(file: str, is_near_only: bool) -> Iterator[list[str]]:
    """Yield arguments of pytest: the tests near a file, then the others, those in real time last."""
    near = next(tests for begin, tests in NEAR.items() if file.startswith(begin))
    seen = []
    for pattern in near:
        places = sorted(str(path.relative_to(REPOSITORY)) for path in REPOSITORY.glob(pattern))
        seen += [f"--ignore={place}" for place in places]
        yield places
    if not is_near_only:
        yield [*seen, "--ignore=tests/system", "tests"]
        yield ["tests/system"]


def judge(mutation: Mutation, tree: Path, is_near_only: bool) -> str | None:
    """Run the tests on a changed copy of the tree; return the first that fails, None if all pass."""
    path = tree / mutation.file
    text = path.read_text()
    lines = text.splitlines(keepends=True)
    line = lines[mutation.line - 1]
    end = mutation.column + len(mutation.old)
    lines[mutation.line - 1] = line[: mutation.column] + mutation.new + line[end:]
    path.write_text("".join(lines))
    try:
        for arguments in stages(mutation.file, is_near_only):
            failed = _first_failure(tree, arguments)
            if failed is not None:
                return failed
        return None
    finally:
        path.write_text(text)


def _first_failure(tree: Path, arguments: list[str]) -> str | None:
    """Return the first test that fails in a run of pytest, as it names it."""
    command = [sys.executable, "-m", "pytest", "-x", "-p", "no:cacheprovider", "--no-header", *arguments]
    environment = os.environ | {"PYTHONPATH": str(tree), "PYTHONDONTWRITEBYTECODE": "1"}
    try:
        done = subprocess.run(
            command, cwd=tree, env=environment, capture_output=True, text=True, timeout=TIMEOUT_S, check=False
        )
    except subprocess.TimeoutExpired:
        return f"no end within {TIMEOUT_S} s"
    if done.returncode in (0, 5):  # 5: nothing to run there
        return None
    named = [line for line in done.stdout.splitlines() if line.startswith(("FAILED ", "ERROR "))]
    return named[0] if named else f"pytest ended with {done.returncode}"


def copy_of_the_tree(parent: Path) -> Path:
    """Copy what git tracks; what lies beside the repository is found beside the copy."""
    tree = parent / "tree"
    names = subprocess.run(["git", "ls-files"], cwd=REPOSITORY, capture_output=True, text=True, check=True)
    for name in names.stdout.splitlines():
        (tree / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(REPOSITORY / name, tree / name)
    if (REPOSITORY.parent / "shared").is_dir():
        (parent / "shared").symlink_to(REPOSITORY.parent / "shared")
    return tree


def main() -> None:
    """Judge a sample, print each change with the test that found it, and how many were found."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.mutation", description=__doc__)
    parser.add_argument("--count", type=int, default=50, help="how many changes (default 50)")
    parser.add_argument("--seed", type=int, default=20, help="of the sample (default 20)")
    parser.add_argument("--part", default="1/1", help="K/N: the K-th of N parts, to run several side by side")
    parser.add_argument(
        "--near", action="store_true", help="only the tests near a change: quick, finds fewer"
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the outcomes to FILE, one a line")
    arguments = parser.parse_args()
    part, parts = (int(number) for number in arguments.part.split("/"))
    drawn = sample(arguments.count, arguments.seed)[part - 1 :: parts]
    survived = 0
    with tempfile.TemporaryDirectory(prefix="mutation-") as folder:
        tree = copy_of_the_tree(Path(folder))
        for number, mutation in enumerate(drawn, 1):
            begun_s = time.monotonic()
            found = judge(mutation, tree, arguments.near)
            survived += found is None
            taken = f"{time.monotonic() - begun_s:.0f} s"
            print(f"{number}/{len(drawn)} {mutation}  {found or 'SURVIVED'}  ({taken})", flush=True)
            if arguments.json:
                with arguments.json.open("a") as file:
                    file.write(json.dumps(asdict(mutation) | {"found_by": found}) + "\n")
    print(f"{len(drawn) - survived} of {len(drawn)} found, seed {arguments.seed}")


if __name__ == "__main__":
    main()
