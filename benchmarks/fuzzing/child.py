"""``python -m benchmarks.fuzzing.child TARGET [libFuzzer options] CORPUS``: one target under Atheris.

A process of its own: libFuzzer ends it, and modules must be imported while it watches.
"""

from __future__ import annotations

import sys

import atheris

from benchmarks.fuzzing.targets import TARGETS


def main() -> None:
    """Never returns: the fuzzer ends the process."""
    target = TARGETS[sys.argv[1]]
    with atheris.instrument_imports(include=list(target.watched), enable_loader_override=False):
        check = target.check()
    atheris.Setup([sys.argv[0], *sys.argv[2:]], check)
    atheris.Fuzz()


main()
