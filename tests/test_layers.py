"""Imports run one way: firmware_protocol <- devices <- gateway."""

import ast
import pathlib
import sys

ROOT = pathlib.Path(__file__).parent.parent
LAYERS = ["firmware_protocol", "devices", "gateway"]  # each may import those before it


def imported_roots(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield node.lineno, node.module.split(".")[0]
        elif isinstance(node, ast.Import):
            for alias in node.names:
                yield node.lineno, alias.name.split(".")[0]


def test_packages_import_only_downwards():
    for level, package in enumerate(LAYERS):
        for path in (ROOT / package).rglob("*.py"):
            for line, name in imported_roots(path):
                assert name not in LAYERS[level + 1 :], f"{path}:{line} imports {name}"


def test_the_wire_needs_only_the_standard_library():
    allowed = set(sys.stdlib_module_names) | {"firmware_protocol"}
    for path in (ROOT / "firmware_protocol").rglob("*.py"):
        for line, name in imported_roots(path):
            assert name in allowed, f"{path}:{line} imports {name}"


def test_nothing_below_the_shell_reads_a_clock():
    sans_io = [*(ROOT / "firmware_protocol").rglob("*.py")]
    for part in ("geometry", "body", "clocks", "reconstruction"):
        sans_io += (ROOT / "gateway" / part).rglob("*.py")
    sans_io += [
        ROOT / "gateway" / f"{name}.py"
        for name in ("pipeline", "stream", "assembly", "despiking", "statistics", "frames")
    ]
    for path in sans_io:
        for line, name in imported_roots(path):
            assert name not in {"time", "asyncio", "socket", "threading"}, f"{path}:{line} imports {name}"


def test_only_tests_of_benchmarks_import_benchmarks():
    """What tests and benchmarks share belongs to the emulators and to gateway/emulation."""
    for path in (ROOT / "tests").rglob("*.py"):
        if path.is_relative_to(ROOT / "tests" / "benchmarks"):
            continue
        for line, name in imported_roots(path):
            assert name != "benchmarks", f"{path}:{line} imports {name}"
