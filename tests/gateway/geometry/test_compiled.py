"""Kernels are compiled anew when what their machine code follows from has changed, and only then."""

import importlib
import os
import pkgutil
import subprocess
import sys

import numpy as np
import pytest

import gateway
from gateway.geometry import compiled as module
from gateway.geometry import quaternion
from gateway.geometry.compiled import Kernel, cache_directory, compiled, for_types_of, prune
from gateway.geometry.kernel_fingerprint import fingerprint

CONSTANTS = "GAIN = 2.0\n"
INNER = """
from gateway.geometry.compiled import compiled
from {package}.constants import GAIN

@compiled
def scaled(x: float) -> float:
    '''Scale.'''
    return GAIN * x
"""
OUTER = """
from typing import NamedTuple

from gateway.geometry.compiled import compiled
from {package} import inner

class Pair(NamedTuple):
    left: float
    right: float

@compiled
def total(pair: Pair) -> float:
    return inner.scaled(pair.left) - pair.right

def unused() -> int:
    return 1
"""


@pytest.fixture
def package(tmp_path, monkeypatch):
    """``package(inner=…)``: a package of two modules of kernels, read anew; returns the outer kernel."""
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    folder = tmp_path / "kernels_read_anew"
    folder.mkdir()

    def make(**texts):
        forget()
        texts = {"__init__": "", "constants": CONSTANTS, "inner": INNER, "outer": OUTER} | texts
        for file, text in texts.items():
            (folder / f"{file}.py").write_text(text.replace("{package}", folder.name))
        importlib.invalidate_caches()
        return importlib.import_module(f"{folder.name}.outer").total

    def forget():
        for name in [name for name in sys.modules if name.partition(".")[0] == folder.name]:
            del sys.modules[name]

    yield make
    forget()


@pytest.mark.parametrize(
    ("file", "old", "new", "changes"),
    [
        ("constants", "2.0", "2.5", True),
        ("inner", "GAIN * x", "GAIN + x", True),
        ("outer", "- pair", "+ pair", True),
        ("outer", "    left: float\n    right: float", "    right: float\n    left: float", True),
        ("outer", "return 1", "return 2", False),
        ("inner", "    return", "    # a reason\n\n    return", False),
        ("inner", "Scale.", "Return the scaled number.", False),
        ("constants", "GAIN", "# what it is\nGAIN", False),
    ],
)
def test_the_fingerprint_follows_what_the_machine_code_follows_from(package, file, old, new, changes):
    texts = {"constants": CONSTANTS, "inner": INNER, "outer": OUTER}
    assert old in texts[file]
    before = fingerprint([package().kernel_function])
    after = fingerprint([package(**{file: texts[file].replace(old, new, 1)}).kernel_function])
    assert (after != before) is changes


def test_a_kernel_whose_globals_cannot_be_followed_is_refused(package):
    kernel = package(inner=INNER.replace("import GAIN", "import GAIN\nGAIN = [GAIN]"))
    with pytest.raises(TypeError, match="a kernel uses GAIN, a list"):
        fingerprint([kernel.kernel_function])


def test_every_kernel_of_the_gateway_has_a_fingerprint():
    for found in pkgutil.walk_packages(gateway.__path__, "gateway."):
        if "reconstruction" in found.name or "geometry" in found.name:
            importlib.import_module(found.name)
    loaded = [vars(m) for name, m in list(sys.modules.items()) if name.startswith("gateway.")]
    kernels = [v for names in loaded for v in names.values() if isinstance(v, Kernel)]
    assert len(kernels) > 100
    assert all(fingerprint([kernel.kernel_function]) for kernel in kernels)


def test_another_installation_finds_what_was_compiled(tmp_path):
    """Moved, with lines and comments added above the kernel: nothing is compiled again."""
    counted = (
        "import numba.core.event as e\n"
        "with e.install_recorder('numba:compile') as compiled:\n"
        "    import thing\n"
        "    assert thing.doubled(4.0) == 8.0\n"
        "print(len(compiled.buffer))\n"
    )
    kernel = (
        "from gateway.geometry.compiled import compiled\n@compiled\ndef doubled(x):\n    return 2.0 * x\n"
    )
    counts = []
    for place, above in (("here", ""), ("there", "# another line\n\n")):
        (tmp_path / place).mkdir()
        (tmp_path / place / "thing.py").write_text(above + kernel)
        paths = os.pathsep.join([str(tmp_path / place), os.environ["PYTHONPATH"]])
        environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "cache"), "PYTHONPATH": paths}
        done = subprocess.run(
            [sys.executable, "-c", counted], env=environment, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
        counts.append(int(done.stdout))
    assert counts[0] > 0
    assert counts[1] == 0


def test_cache_lies_where_the_environment_says(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    assert cache_directory(tmp_path / "package") == tmp_path


def test_cache_of_a_read_only_package_lies_with_the_user(tmp_path, monkeypatch):
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(module.os, "access", lambda path, mode: False)
    assert cache_directory(tmp_path / "package") == tmp_path / "mocap-gateway" / "kernels"


def test_where_nothing_can_be_written_kernels_are_compiled_all_the_same(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setattr(module, "CACHE_DIRECTORY", tmp_path / "file" / "kernels")
    assert compiled(lambda x: x + 1.0)(1.0) == 2.0


def test_division_by_zero_does_not_raise():
    def quotient(a, b):
        return a / b

    assert compiled(quotient)(1.0, 0.0) == float("inf")


def test_only_the_newest_states_of_each_kernel_are_kept(tmp_path):
    folder = tmp_path / "x86-64-v3" / "gateway.module"
    folder.mkdir(parents=True)
    for age in range(4):
        for name in (f"module.first-{age}a.py311.nbi", f"module.first-{age}a.py311.1.nbc"):
            (folder / name).write_bytes(b"code")
            os.utime(folder / name, (1000 - age, 1000 - age))
    for name in ("module.second-0a.py311.nbi", "module.other-kernel-0a.py311.nbi"):
        (folder / name).write_bytes(b"code")
    (tmp_path / "ready-joint").touch()
    prune(tmp_path, kept=2)
    assert sorted(path.name for path in folder.iterdir()) == [
        "module.first-0a.py311.1.nbc",
        "module.first-0a.py311.nbi",
        "module.first-1a.py311.1.nbc",
        "module.first-1a.py311.nbi",
        "module.other-kernel-0a.py311.nbi",
        "module.second-0a.py311.nbi",
    ]
    assert (tmp_path / "ready-joint").exists()


def test_machine_code_for_given_types_does_what_the_kernel_does():
    a, b = np.array([0.5, -0.5, 0.5, 0.5]), np.array([0.1, 0.7, -0.7, 0.1])
    direct = for_types_of(quaternion.multiply, np.zeros(4), np.zeros(4))
    np.testing.assert_array_equal(direct(a, b), quaternion.multiply(a, b))


def test_machine_code_refuses_elements_of_another_size():
    direct = for_types_of(quaternion.multiply, np.zeros(4), np.zeros(4))
    with pytest.raises(TypeError):
        direct(np.zeros(4), np.zeros(4, np.float32))


def test_what_is_no_kernel_stays_what_it_is_in_the_place_of_one():
    assert for_types_of(len, "") is len
