"""Whether a method can start at once, or its kernels have to be compiled first, and the compiling beforehand.

The filters over the whole body take half a minute to a minute to compile, once after an installation. What is
compiled lies on the disk; a mark beside it says so. ``python -m gateway.reconstruction.readiness joint``
compiles in a process of its own: numba holds the interpreter while it does, and nothing else would run well.
"""

from __future__ import annotations

import contextlib
import functools
import os
import sys
from importlib.metadata import version
from pathlib import Path

from gateway.body.rig import load_rig
from gateway.geometry import compiled
from gateway.geometry.kernel_fingerprint import fingerprint
from gateway.reconstruction import RECONSTRUCTORS, create_reconstructor, whole_body
from gateway.reconstruction.inertial import joint

FALLBACK = "independent"
"""Compiles in seconds, and serves until then."""
LONG_COMPILED = frozenset({"joint", "outward"})
_RIG = "suit_17"


def is_ready(name: str) -> bool:
    """Whether a method starts within seconds."""
    return name not in LONG_COMPILED or _mark(name).exists()


def make_ready(name: str) -> None:
    """Compile it, if that is still to be done; takes up to a minute then."""
    if is_ready(name):
        return
    create_reconstructor(name, load_rig(_RIG), 0.01)
    with contextlib.suppress(OSError):  # then it will be looked up again, which does no harm
        _mark(name).touch()


def command(name: str) -> list[str]:
    """What does ``make_ready`` in a process of its own."""
    return [sys.executable, "-m", "gateway.reconstruction.readiness", name]


@functools.cache
def _chain_kernels() -> str:
    """Return the fingerprint of what the chain methods compile."""
    values = (*vars(joint).values(), *vars(whole_body).values())
    return fingerprint(value.kernel_function for value in values if isinstance(value, compiled.Kernel))


def _mark(name: str) -> Path:
    return compiled.CACHE_DIRECTORY / f"ready-{name}-{_chain_kernels()}-numba-{version('numba')}"


if __name__ == "__main__":
    with contextlib.suppress(OSError):
        os.nice(19)  # whoever waits for it runs meanwhile
    for wanted in sys.argv[1:]:
        if wanted not in RECONSTRUCTORS:
            sys.exit(f"no method is called '{wanted}'")
        make_ready(wanted)
