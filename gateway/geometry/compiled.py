"""The one way in which kernels are compiled, and where they are kept.

What was compiled lies on the disk under the kernel's fingerprint (``kernel_fingerprint``): an edit compiles
those kernels anew whose machine code it changes, and no others.
"""

from __future__ import annotations

import contextlib
import functools
import os
import tempfile
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

from gateway.geometry.kernel_fingerprint import fingerprint

F = TypeVar("F", bound=Callable[..., object])

PACKAGE = Path(__file__).resolve().parents[1]
KEPT_STATES = 5
"""Of each kernel: for going back to an older state of it, or for a process that is still on it."""
COMPILER_OPTIONS = {"error_model": "numpy"}
"""IEEE division (x / 0 is inf or NaN, never an exception). Reassociation of sums stays off: the same input
gives the same bits."""


def cache_directory(package: Path) -> Path:
    """Return ``NUMBA_CACHE_DIR`` where it is set, else a folder beside the package or in the user's cache."""
    if chosen := os.environ.get("NUMBA_CACHE_DIR"):
        return Path(chosen)
    if os.access(package, os.W_OK):
        return package / "__pycache__" / "kernels"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "mocap-gateway" / "kernels"


CACHE_DIRECTORY = cache_directory(PACKAGE)


def prune(directory: Path, kept: int = KEPT_STATES) -> None:
    """Delete all but the newest states of each kernel below ``directory``.

    Files are called ``module.kernel-fingerprint.python.nbi`` (which signatures there are) and ``….1.nbc``
    (the code of each); a state is as old as its newest file.
    """
    states: dict[str, dict[str, list[Path]]] = defaultdict(lambda: defaultdict(list))
    for path in directory.glob("*/*.nb[ic]"):
        kernel, _, rest = path.name.rpartition("-")
        states[f"{path.parent.name}/{kernel}"][rest.partition(".")[0]].append(path)
    with contextlib.suppress(OSError):  # another process deletes, too
        for by_fingerprint in states.values():
            files = sorted(by_fingerprint.values(), key=lambda paths: max(p.stat().st_mtime for p in paths))
            for path in (path for paths in files[:-kept] for path in paths):
                path.unlink(missing_ok=True)


class KernelLocator:
    """Where Numba finds a kernel on the disk, by content; has the methods of its cache locators."""

    def __init__(self, function: Callable[..., object]) -> None:
        self._directory = CACHE_DIRECTORY / function.__module__
        self._fingerprint = fingerprint([function])

    @classmethod
    def from_function(cls, function: Callable[..., object], file: str) -> KernelLocator | None:
        """Return the locator of one of our kernels; None for functions that other packages compile."""
        return cls(function) if function in _KERNEL_FUNCTIONS else None

    def ensure_cache_path(self) -> None:
        """Create the folder. Raises ``OSError`` if it cannot be."""
        self._directory.mkdir(parents=True, exist_ok=True)

    def get_cache_path(self) -> str:
        """Return the folder of the kernel's module."""
        return str(self._directory)

    def get_source_stamp(self) -> str:
        """Return what an index must carry to be believed."""
        return self._fingerprint

    def get_disambiguator(self) -> str:
        """Return what tells this state of the kernel from others in the file's name."""
        return self._fingerprint


_KERNEL_FUNCTIONS: set[Callable[..., object]] = set()


@functools.cache
def _compiler() -> Any:
    """Return Numba, which takes a second to import: when the first kernel is called."""
    import numba  # noqa: PLC0415 - takes a second

    prune(CACHE_DIRECTORY)
    locators = (f"{__name__}.{KernelLocator.__name__}", "UserWideCacheLocator")
    numba.config.CACHE_LOCATOR_CLASSES = ",".join(locators)  # type: ignore[attr-defined]  # set by name
    return numba


@functools.cache
def _is_kept(directory: Path) -> bool:
    """Return whether kernels can be written there; else every process compiles its own."""
    try:
        directory.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=directory).close()
    except OSError:
        return False
    return True


class Kernel:
    """A function that is compiled when it is first called, with one argument type after another."""

    def __init__(self, function: Callable[..., object]) -> None:
        functools.update_wrapper(self, function)
        self.kernel_function = function
        _KERNEL_FUNCTIONS.add(function)

    @functools.cached_property
    def dispatcher(self) -> Any:
        """Numba's side, kept on the disk."""
        return _compiler().njit(cache=_is_kept(CACHE_DIRECTORY), **COMPILER_OPTIONS)(self.kernel_function)

    @functools.cached_property
    def _within(self) -> Any:
        """The same as part of other kernels: without what Python and the disk would need of it, which takes
        as long to compile as the kernel."""
        inner = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
        return _compiler().njit(**COMPILER_OPTIONS, **inner)(self.kernel_function)

    @property
    def _numba_type_(self) -> Any:
        """What kernels that call this one see."""
        return _compiler().types.Dispatcher(self._within)

    def __call__(self, *arguments: Any) -> Any:
        return self.dispatcher(*arguments)


def compiled(function: F) -> F:
    """The function as a kernel; see ``Kernel``."""
    return cast(F, Kernel(function))
