"""Imports run one way: firmware_protocol <- devices <- gateway, and between the rooms of gateway."""

import ast
import pathlib
import sys

import pytest

from gateway.sources.makers import OthersLinkSettings
from gateway.sources.registry import SOURCES

ROOT = pathlib.Path(__file__).parent.parent
LAYERS = ["firmware_protocol", "devices", "gateway"]  # each may import those before it
ROOMS = [
    *("errors", "frames", "support", "geometry", "body", "clocks", "contract"),
    *("reconstruction", "sources", "stages", "outputs", "settings", "pipeline"),
    *("modules", "calibration", "recording", "imports", "agreement", "report", "analysis", "batch"),
    *("cameras", "service", "emulation", "doctor", "viewer", "fleet", "cli", "__main__"),
]
"""Folders and modules directly in ``gateway/``: each may import those before it."""


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


def rooms_imported(path):
    """Yield line and room of each import from the gateway, wherever it stands in a file."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == "gateway":
            inner = node.module.split(".")[1:]
            yield from ((node.lineno, inner[0] if inner else alias.name) for alias in node.names)
        elif isinstance(node, ast.Import):
            dotted = (alias.name.split(".") for alias in node.names)
            yield from ((node.lineno, name[1]) for name in dotted if name[0] == "gateway" and name[1:])


@pytest.mark.parametrize("room", ROOMS)
def test_rooms_import_only_those_before_them(room):
    folder = ROOT / "gateway" / room
    for path in folder.rglob("*.py") if folder.is_dir() else [folder.with_suffix(".py")]:
        for line, name in rooms_imported(path):
            assert name in ROOMS[: ROOMS.index(room) + 1], f"{path}:{line} imports {name}, which comes later"


def test_every_room_has_its_place():
    sources = (path.relative_to(ROOT / "gateway") for path in (ROOT / "gateway").rglob("*.py"))
    assert {path.parts[0].removesuffix(".py") for path in sources} - {"__init__"} == set(ROOMS)


def test_only_emulators_know_emulators_below_the_gateway():
    for path in (ROOT / "devices").rglob("*.py"):
        if path.is_relative_to(ROOT / "devices" / "emulators"):
            continue
        for node in ast.walk(ast.parse(path.read_text())):
            name = getattr(node, "module", None) or ""
            assert not name.startswith("devices.emulators"), f"{path}:{node.lineno} imports {name}"


def test_the_wire_needs_only_the_standard_library():
    allowed = set(sys.stdlib_module_names) | {"firmware_protocol"}
    for path in (ROOT / "firmware_protocol").rglob("*.py"):
        for line, name in imported_roots(path):
            assert name in allowed, f"{path}:{line} imports {name}"


def test_nothing_below_the_shell_reads_a_clock():
    sans_io = [*(ROOT / "firmware_protocol").rglob("*.py")]
    for part in ("geometry", "body", "clocks", "reconstruction", "sources", "stages"):
        sans_io += (ROOT / "gateway" / part).rglob("*.py")
    sans_io += [ROOT / "gateway" / f"{name}.py" for name in ("pipeline", "frames")]
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


MAKERS = [word for word, kind in SOURCES.items() if issubclass(kind.settings, OthersLinkSettings)]
"""Words of the configuration for other makers' modules."""
OF_MAKERS = {SOURCES[word].settings.__module__.removeprefix("gateway.sources.") for word in MAKERS}
LISTS = {
    "gateway/sources/registry.py",
    "devices/emulators/makers/registry.py",
    "devices/emulators/faults/makers_campaign.py",
}
"""Where they are entered: by the gateway, by ``emulate``, by what damages their messages."""


def is_own(path, word):
    """Whether a file is that maker's alone, or makes or reads something else of the same name."""
    elsewhere = ("outputs", "imports", "vendor_formats")
    return word.partition("_")[0] in path.stem or any(
        folder in path.relative_to(ROOT).parts for folder in elsewhere
    )


def test_a_maker_is_entered_in_one_place_of_the_gateway_one_of_the_emulator_and_one_of_the_campaign():
    listed = {word: set() for word in MAKERS}
    for package in LAYERS:
        for path in sorted((ROOT / package).rglob("*.py")):
            for node in ast.walk(ast.parse(path.read_text())):
                word = node.value if isinstance(node, ast.Constant) else None
                if word in listed and not is_own(path, word):
                    listed[word].add(path.relative_to(ROOT).as_posix())
    assert listed == dict.fromkeys(MAKERS, LISTS)


def test_only_the_registry_imports_the_source_of_a_maker():
    for path in (ROOT / "gateway").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            name = getattr(node, "module", None) or ""
            if name.startswith("gateway.sources.") and path.name != "registry.py":
                word = name.removeprefix("gateway.sources.")
                assert word not in OF_MAKERS or is_own(path, word), f"{path}:{node.lineno}"


def test_the_page_of_the_tree_names_every_room():
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    tree = page.partition("firmware_protocol/   THE WIRE")[2].partition("```")[0]
    rooms = {
        path.name
        for path in (ROOT / "gateway").iterdir()
        if path.is_dir() and (path / "__init__.py").exists()
    }
    assert len(rooms) > 15
    assert not sorted(room for room in rooms if f"{room}/" not in tree), "name it in docs/architecture.md"
