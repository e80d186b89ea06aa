"""The instructions that results are computed with: the same on all processors of one architecture.

Three libraries choose instructions by the processor they find: Numba compiles for it, NumPy has variants of
its functions for AVX-512, and OpenBLAS (below NumPy and SciPy) has kernels for each family. Their results
differ in the last bits. ``settle`` has all three take the same on every processor that can, by environment
variables that they read when they are imported; so it runs when ``gateway`` is imported. What is set already
stays. A processor that lacks one of the instructions gets what the libraries choose for it.

OpenBLAS is held to one thread on any processor: matrices here are small, threads that wait for each other
took three times as long, and the order of sums would follow from their number.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, MutableMapping
from pathlib import Path
from typing import NamedTuple

CPU_NAME, CPU_FEATURES = "NUMBA_CPU_NAME", "NUMBA_CPU_FEATURES"
NUMPY_WITHOUT, BLAS_KERNELS = "NPY_DISABLE_CPU_FEATURES", "OPENBLAS_CORETYPE"
BLAS_THREADS = "OPENBLAS_NUM_THREADS"
NATIVE = "native"
"""Name of the target where kernels are compiled for the processor that runs them."""


class Target(NamedTuple):
    """What all processors of an architecture that have these instructions compute alike."""

    name: str
    """As LLVM calls it."""
    features: str
    """As LLVM calls them."""
    flags: frozenset[str]
    """As ``/proc/cpuinfo`` calls what a processor must have."""
    numpy_without: str
    """Features that NumPy is not to use."""
    blas_kernels: str
    """Of OpenBLAS."""

    @property
    def environment(self) -> dict[str, str]:
        """Return the variables that the libraries read."""
        return {
            CPU_NAME: self.name,
            CPU_FEATURES: self.features,
            NUMPY_WITHOUT: self.numpy_without,
            BLAS_KERNELS: self.blas_kernels,
        }


TARGETS = {
    "x86_64": Target(  # Intel from Haswell (2013), AMD from Excavator (2015) on
        "x86-64-v3",
        "+avx,+avx2,+bmi,+bmi2,+cmov,+crc32,+cx16,+cx8,+f16c,+fma,+fxsr,+lzcnt,+mmx,+movbe,+popcnt,+sahf,+sse,"
        "+sse2,+sse3,+sse4.1,+sse4.2,+ssse3,+xsave",
        frozenset(
            {"avx", "avx2", "bmi1", "bmi2", "f16c", "fma", "abm", "movbe", "popcnt", "sse4_2", "ssse3"}
        ),
        "X86_V4 AVX512_ICL AVX512_SPR",
        "Haswell",
    ),
    "aarch64": Target(  # all that run a 64-bit Linux, the Raspberry Pi 3 and later among them
        "generic", "+fp-armv8,+neon", frozenset({"fp", "asimd"}), "SVE", "ARMV8"
    ),
}
"""By architecture, as ``uname -m`` says it."""


def settle(
    environment: MutableMapping[str, str] = os.environ,
    machine: str | None = None,
    cpuinfo: Path = Path("/proc/cpuinfo"),
) -> None:
    """Set what the libraries read, where this processor has the target's instructions and no other target is
    asked for, and one thread of OpenBLAS. Has no effect on a library that was imported before."""
    environment.setdefault(BLAS_THREADS, "1")
    target = TARGETS.get(machine or os.uname().machine)
    if target is None or CPU_NAME in environment or not target.flags <= processor_flags(cpuinfo):
        return
    for name, value in target.environment.items():
        environment.setdefault(name, value)


def target_name(environment: Mapping[str, str] = os.environ) -> str:
    """Return what kernels are compiled for."""
    return environment.get(CPU_NAME) or NATIVE


_FLAGS = ("flags", "Features")
"""What the line of a processor's instructions is called, on x86-64 and on arm64."""


def processor_flags(cpuinfo: Path) -> frozenset[str]:
    """Return what the first processor says it has; nothing where it cannot be read."""
    try:
        lines = cpuinfo.read_text(errors="replace").splitlines()
    except OSError:  # other systems have no such file, and a sandbox may hide it
        return frozenset()
    named = (line.partition(":") for line in lines)
    return next((frozenset(flags.split()) for name, _, flags in named if name.strip() in _FLAGS), frozenset())
