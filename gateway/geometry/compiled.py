"""The one way in which kernels are compiled, and where they are kept.

They are compiled for the target of ``gateway.support.processor``. What was compiled lies on the disk, in a
folder of the target, under the kernel's fingerprint (``kernel_fingerprint``): an edit compiles those kernels
anew whose machine code it changes, and no others. What is not there is copied from the kernels that came with
the installation (``SHIPPED``), and compiled only where these do not fit either.
"""

from __future__ import annotations

import contextlib
import functools
import importlib
import os
import shutil
import tempfile
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, TypeVar, cast

from gateway.geometry.kernel_fingerprint import COMPILATION, fingerprint
from gateway.support.processor import CPU_FEATURES, CPU_NAME, target_name

F = TypeVar("F", bound=Callable[..., object])

PACKAGE = Path(__file__).resolve().parents[1]
KEPT_STATES = 5
"""Of each kernel: for going back to an older state of it, or for a process that is still on it."""
COMPILER_OPTIONS = {"error_model": COMPILATION["error_model"]}


def cache_directory(package: Path) -> Path:
    """Return ``NUMBA_CACHE_DIR`` where it is set, else a folder beside the package or in the user's cache."""
    if chosen := os.environ.get("NUMBA_CACHE_DIR"):
        return Path(chosen)
    if os.access(package, os.W_OK):
        return package / "__pycache__" / "kernels"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "mocap-gateway" / "kernels"


CACHE_DIRECTORY = cache_directory(PACKAGE)
SHIPPED = PACKAGE / "ready_kernels"
"""Kernels that came with the installation (a wheel, a layer of an image); never written to."""


def kept(folder: Path | None = None) -> Path:
    """Return where kernels of this process's target lie, below ``folder``; none: ``CACHE_DIRECTORY``."""
    return (folder or CACHE_DIRECTORY) / target_name()


def prune(directory: Path, kept: int = KEPT_STATES) -> None:
    """Delete all but the newest states of each kernel below ``directory``.

    Files are called ``module.kernel-fingerprint.python.nbi`` (which signatures there are) and ``….1.nbc``
    (the code of each); a state is as old as its newest file.
    """
    states: dict[str, dict[str, list[Path]]] = defaultdict(lambda: defaultdict(list))
    for path in directory.glob("*/*/*.nb[ic]"):
        kernel, _, rest = path.name.rpartition("-")
        states[f"{path.parent}/{kernel}"][rest.partition(".")[0]].append(path)
    with contextlib.suppress(OSError):  # another process deletes, too
        for by_fingerprint in states.values():
            files = sorted(by_fingerprint.values(), key=lambda paths: max(p.stat().st_mtime for p in paths))
            for path in (path for paths in files[:-kept] for path in paths):
                path.unlink(missing_ok=True)


class KernelLocator:
    """Where Numba finds a kernel on the disk, by content; has the methods of its cache locators."""

    def __init__(self, function: Callable[..., object]) -> None:
        self._directory = kept() / function.__module__
        self._fingerprint = fingerprint([function])
        _take_shipped(function.__module__, self._fingerprint)

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
        """Return the part of the file's name that is of this state of the kernel alone."""
        return self._fingerprint


def _take_shipped(module: str, state: str) -> None:
    """Copy what was shipped of a state of a kernel, where nothing of it is kept."""
    own = kept() / module
    if next(own.glob(f"*-{state}.*.nbi"), None) is not None:
        return
    with contextlib.suppress(OSError):  # then it is compiled
        # The code (.1.nbc) before the index (.nbi) that names it: another process may be reading.
        for source in sorted((kept(SHIPPED) / module).glob(f"*-{state}.*")):
            own.mkdir(parents=True, exist_ok=True)
            part = own / f"{source.name}.{os.getpid()}"
            shutil.copyfile(source, part)
            part.replace(own / source.name)


class KernelState(NamedTuple):
    """A kernel as it is now, named so that another process finds it."""

    module: str
    name: str
    fingerprint: str

    @property
    def is_kept(self) -> bool:
        """Whether its machine code for this target is on the disk, in any signature."""
        pattern = f"{self.module}/*-{self.fingerprint}.*.nbi"
        return any(
            next(kept(folder).glob(pattern), None) is not None for folder in (CACHE_DIRECTORY, SHIPPED)
        )

    @property
    def is_current(self) -> bool:
        """Whether the kernel is still what it was when this was noted."""
        try:
            kernel = getattr(importlib.import_module(self.module), self.name, None)
        except ImportError:
            return False
        return isinstance(kernel, Kernel) and fingerprint([kernel.kernel_function]) == self.fingerprint


def called() -> list[KernelState]:
    """Return the kernels that this process has called from Python, all of them at the top of a module."""
    return sorted(
        KernelState(function.__module__, function.__qualname__, fingerprint([function]))
        for function in (kernel.kernel_function for kernel in _CALLED)
    )


def origins() -> tuple[int, int]:
    """Return how many of the kernels that this process has called lay compiled on the disk, and how many it
    had to compile, in one signature or more."""
    statistics = [kernel.dispatcher.stats for kernel in _CALLED]
    compiled = sum(bool(each.cache_misses) for each in statistics)
    return len(statistics) - compiled, compiled


_KERNEL_FUNCTIONS: set[Callable[..., object]] = set()
_CALLED: set[Kernel] = set()


@functools.cache
def _compiler() -> Any:
    """Return Numba, which takes a second to import: when the first kernel is called."""
    import numba  # noqa: PLC0415 - takes a second

    prune(CACHE_DIRECTORY)
    for name in (CPU_NAME, CPU_FEATURES):  # read at its import, which may have been before ours
        setattr(numba.config, name.removeprefix("NUMBA_"), os.environ.get(name))
    numba.config.SLP_VECTORIZE = COMPILATION["slp_vectorize"]  # type: ignore[attr-defined]  # set by name
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
        _CALLED.add(self)
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


def for_types_of(kernel: F, *arguments: Any) -> F:
    """Return a kernel's machine code for arguments of the types of these, compiled now and not called.

    A call of it looks at no types, which of a structured array takes longer than many a kernel. So each must
    be of the same type, number of dimensions and layout as here: that is for the caller to see to.
    What is no kernel, in the place of one, stays as it is.
    """
    if not isinstance(kernel, Kernel):
        return kernel
    dispatcher = kernel.dispatcher
    types = tuple(map(dispatcher.typeof_pyval, arguments))
    dispatcher.compile(types)
    return cast(F, dispatcher.get_overload(types))


def compiled(function: F) -> F:
    """Return the function as a kernel; see ``Kernel``."""
    return cast(F, Kernel(function))
