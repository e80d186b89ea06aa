"""``python -m benchmarks.structure``: how the tree stands: files, rooms, knots of imports, kinds of source.

A room is a folder or a module directly in ``gateway/``. Every import counts, those inside functions too, but
not those for types alone. A knot is a set of rooms each of which imports, by way of others, all of the rest.

Named too is what tests and benchmarks alone use; what they share belongs to the emulators.

A maker of modules is a protocol, a source and an emulator; ``--write-docs`` puts their lines into
docs/architecture.md.

A frame of the emulated suit is followed from ``Pipeline.feed`` to its MQTT payload, by the calls of Python
functions and the files they stand in.
"""

from __future__ import annotations

import argparse
import ast
import re
import statistics
import sys
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from types import FrameType
from typing import NamedTuple

from benchmarks.figures import replace_section, table
from devices.emulators import Imperfections, SuitSettings, SuitTraffic
from devices.emulators.motion.motions import generic_motion
from devices.link import Chunk, Framing
from gateway.body.rig import load_rig
from gateway.contract.topics import Topics
from gateway.emulation.rig import dress
from gateway.outputs.pose_encoding import PosePublications
from gateway.outputs.settings import MqttSettings
from gateway.pipeline import Pipeline
from gateway.sources.makers import OthersLinkSettings
from gateway.sources.registry import SOURCES
from gateway.stages.frame_assembler import AssemblyParams

REPOSITORY = Path(__file__).resolve().parents[1]
PACKAGES = ("firmware_protocol", "devices", "gateway", "benchmarks", "tests")
PRODUCTION = ("firmware_protocol", "devices", "gateway")
SHARED = ("devices/emulators", "gateway/emulation", "firmware_protocol/__init__.py")
"""What tests share, and what is offered to authors of firmware: whatever these name is in use."""
OWN = tuple(f"{REPOSITORY / package}/" for package in PACKAGES[:3])
"""Where functions of ours stand; the libraries in a virtual environment are none."""
HUB = ("pipeline.py", "service.py", "accounting.py", "observability.py")
"""Where nothing should ask for the kind of a source (in ``gateway/`` or a room of that name)."""
NAMING = re.compile(r"[\w.:\[\], |]{1,200}")
"""A text that may name a function or a type."""
MOST_PARAMETERS = 6
READ_BESIDE_EQUATIONS = ("inertial", "optical", "video")
"""Rooms of ``gateway/reconstruction/``."""
KINDS = re.compile(r"gnss|marker|heat_map|hip|sun|light|fused|camera|trigger|optical|video", re.IGNORECASE)


def imports(path: Path) -> Iterator[str]:
    """Yield the dotted names that a file imports at run time."""
    yield from _imports(ast.parse(path.read_text()))


def _imports(node: ast.AST) -> Iterator[str]:
    if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
        return
    if isinstance(node, ast.ImportFrom) and node.module and not node.level:
        yield from (f"{node.module}.{alias.name}" for alias in node.names)
    elif isinstance(node, ast.Import):
        yield from (alias.name for alias in node.names)
    for child in ast.iter_child_nodes(node):
        yield from _imports(child)


def room(path: Path) -> str:
    """Name the room of a file in ``gateway/``."""
    return path.relative_to(REPOSITORY / "gateway").parts[0].removesuffix(".py")


def rooms() -> dict[str, dict[str, set[str]]]:
    """Return, by room, the rooms that it imports, each with the places where."""
    found: dict[str, dict[str, set[str]]] = {}
    for path in _sources("gateway"):
        own = found.setdefault(room(path), defaultdict(set))
        for name in imports(path):
            parts = name.split(".")
            if parts[0] == "gateway" and len(parts) > 1 and parts[1] != room(path):
                own[parts[1]].add(str(path.relative_to(REPOSITORY)))
    return {name: {to: at for to, at in edges.items() if to in found} for name, edges in found.items()}


def knots(graph: Mapping[str, Mapping[str, object]]) -> list[list[str]]:
    """Return the strongly connected components of a graph that have more than one member, largest first."""
    reach = {name: _reachable(graph, name) for name in graph}
    left, found = set(graph), []
    while left:
        name = min(left)
        knot = {name} | {other for other in reach[name] if name in reach[other]}
        left -= knot
        found.append(sorted(knot))
    return sorted((knot for knot in found if len(knot) > 1), key=len, reverse=True)


def _reachable(graph: Mapping[str, Mapping[str, object]], start: str) -> set[str]:
    seen: set[str] = set()
    waiting = [start]
    while waiting:
        for name in graph[waiting.pop()]:
            if name not in seen:
                seen.add(name)
                waiting.append(name)
    return seen


def kind_tests() -> Counter[str]:
    """Count, by file of the hub, the conditions that name a kind of source."""
    found: Counter[str] = Counter()
    for path in _sources("gateway"):
        if path.name in HUB:
            for node in ast.walk(ast.parse(path.read_text())):
                test = getattr(node, "test", None) if isinstance(node, ast.If | ast.IfExp) else None
                found[path.name] += test is not None and bool(KINDS.search(ast.unparse(test)))
    return found


class Bulk(NamedTuple):
    """What somebody has to read who wants to know a room."""

    files: int
    lines: int
    many_parameters: int
    """Functions that take more than ``MOST_PARAMETERS``, ``self`` not counted."""
    constants: int
    """Numbers with a name at the top of a file."""
    tuned: int
    """Numbers in a table, with unit and origin (``gateway.geometry.records.constant``)."""
    settings: int
    """Fields of a class that have a number for a default."""


def bulk(folder: Path) -> Bulk:
    """Count what lies in a folder."""
    found = Counter[str]()
    for path in folder.rglob("*.py"):
        text = path.read_text()
        found["files"] += 1
        found["lines"] += text.count("\n")
        tree = ast.parse(text)
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                names = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
                counted = [name for name in names if name.arg not in ("self", "cls")]
                found["many_parameters"] += len(counted) > MOST_PARAMETERS
            elif isinstance(node, ast.ClassDef):
                defaults = [
                    each.value for each in node.body if isinstance(each, ast.AnnAssign) and each.value
                ]
                found["settings"] += sum(_is_number(value) for value in defaults)
                found["tuned"] += sum(
                    isinstance(value, ast.Call) and getattr(value.func, "id", "") == "constant"
                    for value in defaults
                )
        for node in tree.body:
            if isinstance(node, ast.Assign):
                values = node.value.elts if isinstance(node.value, ast.Tuple) else [node.value]
                found["constants"] += sum(_is_number(value) for value in values)
    return Bulk(**{name: found[name] for name in Bulk._fields})


def _is_number(value: ast.expr) -> bool:
    """Whether it is one, with a sign, a product or a power of them too."""
    if isinstance(value, ast.UnaryOp):
        return _is_number(value.operand)
    if isinstance(value, ast.BinOp):
        return _is_number(value.left) and _is_number(value.right)
    return isinstance(value, ast.Constant) and type(value.value) in (int, float)


class _Definition(NamedTuple):
    name: str
    path: Path
    first: int
    last: int


def used_by_tests_alone() -> list[str]:
    """Return the functions, methods and classes that only tests and benchmarks name, as ``path: name``.

    What only such a one names is one too. A definition goes by its name alone: one that shares it with
    another in use is not found.
    """
    definitions: list[_Definition] = []
    uses: defaultdict[str, set[tuple[Path, int]]] = defaultdict(set)
    for path in (path for package in PRODUCTION for path in _sources(package)):
        is_shared = str(path.relative_to(REPOSITORY)).startswith(SHARED)
        tree = ast.parse(path.read_text())
        for name, line in _names(tree, with_exports=is_shared):
            uses[name].add((path, line))
        definitions += [] if is_shared else _definitions(tree, path)
    tested = {
        name
        for package in ("tests", "benchmarks")
        for path in _sources(package)
        for name, _ in _names(ast.parse(path.read_text()), with_exports=False)
    }
    definitions = [each for each in definitions if each.name in tested]
    alone: list[_Definition] = []
    while found := [
        each
        for each in definitions
        if each not in alone and all(_is_within(use, [each, *alone]) for use in uses[each.name])
    ]:
        alone += found
    return sorted(f"{each.path.relative_to(REPOSITORY)}: {each.name}" for each in alone)


def _definitions(tree: ast.AST, path: Path) -> list[_Definition]:
    """Return functions, classes and methods; of the wire no methods, which come with its classes."""
    is_wire = path.is_relative_to(REPOSITORY / "firmware_protocol")
    return [
        _Definition(node.name, path, node.lineno, node.end_lineno or node.lineno)
        for node in (ast.iter_child_nodes(tree) if is_wire else ast.walk(tree))
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef) and node.name[:2] != "__"
    ]


def _names(tree: ast.AST, with_exports: bool) -> Iterator[tuple[str, int]]:
    """Yield each name that is read, and the words of texts that may name something, with their lines."""
    exports = {
        id(part)
        for node in ast.walk(tree)
        if isinstance(node, ast.Assign) and any(ast.unparse(target) == "__all__" for target in node.targets)
        for part in ast.walk(node)
    }
    for node in ast.walk(tree):
        if id(node) in exports and not with_exports:
            continue
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load):
            yield node.id, node.lineno
        elif isinstance(node, ast.Attribute):
            yield node.attr, node.lineno
        elif isinstance(node, ast.alias) and node.asname:
            yield node.name, node.lineno
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and NAMING.fullmatch(node.value):
            yield from ((word, node.lineno) for word in re.findall(r"\w+", node.value))


def _is_within(use: tuple[Path, int], definitions: list[_Definition]) -> bool:
    path, line = use
    return any(path == each.path and each.first <= line <= each.last for each in definitions)


def _sources(package: str) -> list[Path]:
    return sorted((REPOSITORY / package).rglob("*.py"))


class Maker(NamedTuple):
    """What one maker's modules take, in lines."""

    carries: str
    """Words of the configuration for it."""
    protocol: int
    """Bytes to values and back."""
    source: int
    """Values to readings, settings of the link, commands, advice of the doctor."""
    emulator: int
    """The emulator."""
    registered: int
    """In the lists of sources, of emulators and of what campaigns damage."""
    tests: int
    """Beside those that go through all makers."""


MAKERS_SHARE = (
    *("devices/vendor_protocols/plausibility.py", "devices/vendor_protocols/rotations.py"),
    *("gateway/sources/makers.py", "gateway/modules/makers.py", "gateway/cli/emulate_makers.py"),
    *(
        "devices/emulators/makers/vendor_emulator.py",
        "devices/emulators/makers/registry.py",
        "devices/emulators/faults/makers_campaign.py",
    ),
)
"""What all makers have in common."""
_ONE_FILE = "tests/system/test_another_makers_module.py"
_LISTS = (
    "gateway/sources/registry.py",
    "devices/emulators/makers/registry.py",
    "devices/emulators/faults/makers_campaign.py",
)


def makers() -> list[Maker]:
    """Return what each maker takes, the largest first."""
    found: defaultdict[str, list[str]] = defaultdict(list)
    for carries, kind in SOURCES.items():
        if issubclass(kind.settings, OthersLinkSettings):
            found[kind.settings.__module__.rpartition(".")[2]].append(carries)
    counted = [_maker(name, words) for name, words in found.items()]
    return sorted(counted, key=lambda each: -(each.protocol + each.source + each.emulator))


def _maker(name: str, words: Sequence[str]) -> Maker:
    protocols = REPOSITORY / "devices" / "vendor_protocols"
    sources = [REPOSITORY / "gateway" / "sources" / f"{name}.py"]
    sources += [REPOSITORY / "gateway" / "sources" / "unfused.py"] * (name == "slimevr")
    own = re.compile(rf"\b_?(of_)?{name}|{name.replace('_', '')}", re.IGNORECASE)
    listed = sum(len(own.findall(line)) > 0 for path in _LISTS for line in _lines(REPOSITORY / path))
    tests = (REPOSITORY / "tests").rglob(f"test_{name}*.py")
    return Maker(
        ", ".join(words),
        _count(protocols.glob(f"{name}*.py")),
        _count(sources),
        _count((REPOSITORY / "devices" / "emulators" / "makers").glob(f"{name}.py")),
        listed,
        _count(tests),
    )


def _lines(path: Path) -> list[str]:
    return path.read_text().splitlines()


def _count(paths: Iterable[Path]) -> int:
    return sum(len(_lines(path)) for path in paths)


def makers_table() -> str:
    """Return the lines that each maker takes, as Markdown."""
    rows = [[each.carries, *map(str, each[1:])] for each in makers()]
    shared = _count(REPOSITORY / path for path in MAKERS_SHARE)
    heads = ["carries", "protocol", "source", "emulator", "lines that name it in lists", "tests of its own"]
    alone = f"{_lines_of_class(_ONE_FILE, 'TextSource')} lines, and one in `SOURCES` (`{_ONE_FILE}`)"
    common = f"What all have in common: {shared} lines. A module that only sends, in one file: {alone}."
    return f"{table(heads, rows)}\n\n{common}\n"


def _lines_of_class(path: str, name: str) -> int:
    tree = ast.parse((REPOSITORY / path).read_text())
    found = next(node for node in tree.body if isinstance(node, ast.ClassDef) and node.name == name)
    return (found.end_lineno or found.lineno) - found.lineno + 1


def calls_of_a_frame() -> tuple[float, int]:
    """Count calls per frame of the project's functions, and their files, from bytes to the MQTT payload.

    Of 17 modules at 100 Hz over one serial line, ``joint``, in the fourth second.
    """
    suit = load_rig(REPOSITORY / "config" / "rigs" / "suit_17.yaml")
    pipeline = Pipeline(suit, AssemblyParams(10e6, 30_000_000, 100_000_000, 500_000_000), "joint")
    pipeline.add_link("suit", Framing.BYTE_STREAM)
    publications = PosePublications(MqttSettings(), suit.skeleton, Topics("mocap", "demo"))
    traffic = SuitTraffic(generic_motion(dress(suit), 1), SuitSettings(), Imperfections(), 1)
    calls: Counter[str] = Counter()
    n_frames = 0

    def note(frame: FrameType, event: str, _: object) -> None:
        name = frame.f_code.co_filename
        if event == "call" and name.startswith(OWN):
            calls[name] += 1

    for sent in traffic.transmissions(4.0):
        chunk = Chunk(sent.data, round(sent.time_s * 1e9), "suit")
        is_counted = sent.time_s > 3.0
        sys.setprofile(note if is_counted else None)
        poses = pipeline.feed(chunk)
        for pose in poses:
            list(publications.of(pose))
        sys.setprofile(None)
        n_frames += len(poses) * is_counted
    return calls.total() / n_frames, len(calls)


def main() -> None:
    """Print how the tree stands."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.structure", description=__doc__)
    parser.add_argument(
        "--write-docs", action="store_true", help="Put the makers' lines into docs/architecture.md, and end."
    )
    if parser.parse_args().write_docs:
        replace_section(REPOSITORY / "docs" / "architecture.md", "makers", f"\n{makers_table()}\n")
        return
    for package in PACKAGES:
        lines = [len(path.read_text().splitlines()) for path in _sources(package)]
        print(
            f"{package}: {len(lines)} files, {sum(lines)} lines, "
            f"median {statistics.median(lines):.0f}, longest {max(lines)}"
        )
    graph = rooms()
    print(f"gateway/: {len(list((REPOSITORY / 'gateway').glob('*.py')))} modules at its root")
    for knot in knots(graph) or [[]]:
        print(f"knot of {len(knot)} rooms: {', '.join(knot)}" if knot else "no knot of imports")
    for name, count in kind_tests().items():
        print(f"{name}: {count} conditions name a kind of source")
    for found in used_by_tests_alone():
        print(f"used by tests alone: {found}")
    print(makers_table())
    for name in READ_BESIDE_EQUATIONS:
        counts = bulk(REPOSITORY / "gateway" / "reconstruction" / name)
        print(
            f"reconstruction/{name}: {counts.files} files, {counts.lines} lines, {counts.many_parameters} "
            f"functions of more than {MOST_PARAMETERS} parameters, {counts.constants} constants, "
            f"{counts.tuned} in tables, {counts.settings} settings"
        )
    calls, files = calls_of_a_frame()
    print(f"a frame: {calls:.0f} calls in {files} files from bytes to payload")


if __name__ == "__main__":
    main()
