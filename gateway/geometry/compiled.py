"""The one way in which kernels are compiled.

Numba caches a kernel beside the source it stands in and compiles it anew when that file changes, but not
when another file changes whose kernels it calls: after an edit it would go on running the old code. The cache
therefore lies in a directory named after the state of the whole package.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

F = TypeVar("F", bound=Callable[..., object])

PACKAGE = Path(__file__).resolve().parents[1]
KEPT_CACHES = 5
"""Older states of the package whose kernels are kept: for going back to one, or for a process still on it."""


def source_fingerprint(package: Path) -> str:
    """Sixteen hexadecimal digits that change with any source file of kernels below ``package``.

    Those are the files that name this module or Numba, and ``frames.py``, whose constants kernels freeze.
    """
    digest = hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        source = path.read_bytes()
        names_compiler = b"geometry.compiled" in source or b"from numba" in source
        if names_compiler or path.name in ("compiled.py", "frames.py"):
            digest.update(str(path.relative_to(package)).encode() + source)
    return digest.hexdigest()[:16]


def cache_directory(package: Path) -> Path:
    """Below ``NUMBA_CACHE_DIR`` where it is set, else beside the package, else in the user's cache."""
    if chosen := os.environ.get("NUMBA_CACHE_DIR"):
        base = Path(chosen)
    elif os.access(package, os.W_OK):
        base = package / "__pycache__"
    else:
        base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "mocap-gateway"
    return base / f"kernels-{source_fingerprint(package)}"


def prune(directory: Path, kept: int = KEPT_CACHES) -> None:
    """Removes kernels of older states of the package beside ``directory``, but the ``kept`` newest."""
    others = [path for path in directory.parent.glob("kernels-*") if path != directory and path.is_dir()]
    ages = {}
    for path in others:
        with contextlib.suppress(OSError):  # another process prunes too
            ages[path] = path.stat().st_mtime
    for path in sorted(ages, key=lambda path: ages[path])[: max(0, len(ages) - kept)]:
        shutil.rmtree(path, ignore_errors=True)


CACHE_DIRECTORY = cache_directory(PACKAGE)


@functools.cache
def _compiler() -> Any:
    """Numba, which takes a second to import: when the first kernel is called."""
    import numba  # noqa: PLC0415 - takes a second

    if not CACHE_DIRECTORY.exists():
        prune(CACHE_DIRECTORY)
    numba.config.CACHE_DIR = str(CACHE_DIRECTORY)  # type: ignore[attr-defined]  # set by name in numba
    return numba


class Kernel:
    """A function that is compiled when it is first called, with one argument type after another."""

    def __init__(self, function: Callable[..., object]) -> None:
        functools.update_wrapper(self, function)
        self._function = function

    @functools.cached_property
    def dispatcher(self) -> Any:
        """Numba's side: cached on disk, IEEE division (x / 0 is inf or NaN, never an exception).

        Reassociation of sums stays off: the same input gives the same bits.
        """
        return _compiler().njit(cache=True, error_model="numpy")(self._function)

    @functools.cached_property
    def _within(self) -> Any:
        """The same as part of other kernels: without what Python and the disk would need of it, which takes
        as long to compile as the kernel."""
        numba = _compiler()
        return numba.njit(error_model="numpy", no_cpython_wrapper=True, no_cfunc_wrapper=True)(self._function)

    @property
    def _numba_type_(self) -> Any:
        """What kernels that call this one see."""
        return _compiler().types.Dispatcher(self._within)

    def __call__(self, *arguments: Any) -> Any:
        return self.dispatcher(*arguments)


def compiled(function: F) -> F:
    """The function as a kernel; see ``Kernel``."""
    return cast(F, Kernel(function))
