"""``python -m benchmarks.fuzzing.coverage TARGET [KEPT NEW]``: what inputs reach, as the interpreter tells.

Prints JSON: lines of functions in the watched modules, how many of them are reached by what once broke
something, by what is generated and by the files of the folder KEPT; and which files of the folder NEW would
reach more (a line, or a line after another one), shortest first.
"""

from __future__ import annotations

import importlib.util
import json
import sys
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

from benchmarks.fuzzing.targets import ROOT, TARGETS, Target

Step = tuple[str, int, int]
"""File, line, and the line before it in the same call."""


class Tracer:
    """Notes the steps taken in some files."""

    def __init__(self, files: Iterable[str]) -> None:
        self.steps: set[Step] = set()
        self._files = frozenset(files)

    def run(self, call: Callable[[], object]) -> set[Step]:
        """The steps that nothing before has taken."""
        before = set(self.steps)
        sys.settrace(self._enter)
        try:
            call()
        finally:
            sys.settrace(None)
        return self.steps - before

    def _enter(self, frame: FrameType, _event: str, _argument: Any) -> Any:
        name = frame.f_code.co_filename
        if name not in self._files:
            return None
        last = frame.f_lineno

        def step(inner: FrameType, event: str, _argument: Any) -> Any:
            nonlocal last
            if event == "line":
                self.steps.add((name, inner.f_lineno, last))
                last = inner.f_lineno
            return step

        return step


def function_lines(path: str) -> set[tuple[str, int]]:
    """Lines inside functions of a source file: those of the module's own body run at import."""
    whole = compile(Path(path).read_text(encoding="utf-8"), path, "exec")
    found: set[tuple[str, int]] = set()
    waiting: list[CodeType] = [whole]
    while waiting:
        code = waiting.pop()
        waiting += [each for each in code.co_consts if isinstance(each, CodeType)]
        if "__qualname__" not in code.co_names and code is not whole:  # neither a class nor the module
            lines = {line for _, _, line in code.co_lines() if line is not None}
            found |= {(path, line) for line in lines - {code.co_firstlineno}}
    return found


def source_of(module: str) -> str:
    """The file of a module, without importing it where it is our own."""
    own = ROOT / f"{module.replace('.', '/')}.py"
    return str(own if own.is_file() else importlib.util.find_spec(module).origin)  # type: ignore[union-attr]


def survey(target: Target, kept: Path | None = None, new: Path | None = None) -> dict[str, Any]:
    """Return what the module's page says; the target must not be imported yet."""
    files = [source_of(name) for name in target.watched]
    tracer = Tracer(files)
    tracer.run(target.check)
    check = target.check()
    from benchmarks.fuzzing.seeds import generated  # noqa: PLC0415 - imports the target

    old = [path.read_bytes() for path in (*target.found, *_files(kept))]
    for data in (*old, *(data for _, data in generated(target))):
        tracer.run(partial(check, data))
    reached = {(name, line) for name, line, _ in tracer.steps}
    lines = set().union(*map(function_lines, files))
    adding = [path.name for path in _files(new) if tracer.run(partial(check, path.read_bytes()))]
    return {"lines": len(lines), "reached": len(reached & lines), "adding": adding}


def _files(folder: Path | None) -> list[Path]:
    """Return the files of a folder, the shortest first."""
    return sorted(folder.iterdir(), key=lambda path: path.stat().st_size) if folder is not None else []


def main() -> None:
    """Survey one target."""
    name, *folders = sys.argv[1:]
    print(json.dumps(survey(TARGETS[name], *map(Path, folders))))


if __name__ == "__main__":
    main()
