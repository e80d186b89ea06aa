"""All processors of an architecture compute with the same instructions, where they have them."""

import os
import platform
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from gateway.support.processor import (
    BLAS_KERNELS,
    BLAS_THREADS,
    CPU_FEATURES,
    CPU_NAME,
    NATIVE,
    NUMPY_WITHOUT,
    TARGETS,
    processor_flags,
    settle,
    target_name,
)

ONE_THREAD = {BLAS_THREADS: "1"}
HASWELL = "fpu sse4_2 ssse3 popcnt avx avx2 bmi1 bmi2 f16c fma abm movbe"


@pytest.fixture
def cpuinfo(tmp_path):
    def write(flags, heading="flags"):
        path = tmp_path / "cpuinfo"
        path.write_text(f"processor\t: 0\nmodel name\t: some\n{heading}\t\t: {flags}\n\nprocessor\t: 1\n")
        return path

    return write


@pytest.mark.parametrize("more", ["", "avx512f avx512vl avx512bw", "sse4a clzero"])
def test_processors_of_all_makers_are_settled_alike(cpuinfo, more):
    environment = {}
    settle(environment, "x86_64", cpuinfo(f"{HASWELL} {more}"))
    assert environment == TARGETS["x86_64"].environment | ONE_THREAD
    assert target_name(environment) == "x86-64-v3"


@pytest.mark.parametrize("lacks", ["avx2", "fma", "bmi2", "abm"])
def test_a_processor_that_lacks_an_instruction_takes_what_it_has(cpuinfo, lacks):
    environment = {}
    settle(environment, "x86_64", cpuinfo(HASWELL.replace(f" {lacks}", "")))
    assert environment == ONE_THREAD
    assert target_name(environment) == NATIVE


def test_arm_and_unknown_machines(cpuinfo, tmp_path):
    raspberry, unknown, unreadable = {}, {}, {}
    settle(raspberry, "aarch64", cpuinfo("fp asimd evtstrm crc32 cpuid", "Features"))
    settle(unknown, "riscv64", cpuinfo("rv64gc", "isa"))
    settle(unreadable, "x86_64", tmp_path / "absent")
    assert raspberry[CPU_NAME] == "generic"
    assert unknown == unreadable == ONE_THREAD


def test_what_the_user_chose_stays(cpuinfo):
    environment = {CPU_NAME: "znver5"}
    settle(environment, "x86_64", cpuinfo(HASWELL))
    assert environment == {CPU_NAME: "znver5"} | ONE_THREAD
    environment = {BLAS_KERNELS: "Zen", BLAS_THREADS: "4"}
    settle(environment, "x86_64", cpuinfo(HASWELL))
    assert (environment[BLAS_KERNELS], environment[BLAS_THREADS]) == ("Zen", "4")
    assert CPU_FEATURES in environment


CODE = """
from gateway.geometry.compiled import compiled

@compiled
def scaled(x, y):
    total = 0.0
    for k in range(len(x)):
        total += x[k] * y[k]
    return total

import numpy as np
scaled(np.ones(9), np.ones(9))
(code,) = scaled.dispatcher.inspect_asm().values()
print(np.show_config(mode="dicts")["SIMD Extensions"]["found"])
print("zmm" in code, "vfmadd" in code, "fmadd" in code)
"""


@pytest.mark.skipif(
    platform.machine() != "x86_64" or not TARGETS["x86_64"].flags <= processor_flags(Path("/proc/cpuinfo")),
    reason="needs a processor with AVX2",
)
@pytest.mark.parametrize("first", ["", "import numba\nfrom numba.core import event\n"])
def test_libraries_and_kernels_take_what_is_settled(tmp_path, first):
    """Products and sums stay apart, as IEEE says: a fused one would have other bits."""
    inherited = {k: v for k, v in os.environ.items() if k not in (CPU_NAME, CPU_FEATURES, NUMPY_WITHOUT)}
    script = tmp_path / "script.py"
    script.write_text(first + CODE)
    done = subprocess.run(
        [sys.executable, script],
        env=inherited | {"NUMBA_CACHE_DIR": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    found, code = done.stdout.splitlines()
    assert code == "False False False"
    if not first:
        assert found == "['X86_V3']"


def test_here_numpy_is_settled():
    """This process of the tests imported the gateway before NumPy."""
    if target_name() == "x86-64-v3":
        assert "X86_V4" not in np.show_config(mode="dicts")["SIMD Extensions"]["found"]
