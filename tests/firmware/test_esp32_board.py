"""What stands beside the board for an ESP32: two ways to build it, and the table of its flash.

Espressif's tools are not here. That the board compiles, and does what the gateway and the protocol's rules
ask of it, is seen with a stand-in for its SDK (``esp_idf``), by the tests of all boards.
"""

from __future__ import annotations

import csv
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from devices.commands.setting_values import SETTING_KEYS, encoded_setting
from devices.conformance.bench import Bench
from devices.endpoints import link_from_url
from firmware_protocol import InertialSample
from firmware_protocol.commands import Result, Verb
from tests.firmware.machines import (
    ESP32,
    ESP_IDF,
    REFERENCE,
    SECTOR_SIZE,
    SECTORS_SIZE,
    Machine,
    NotHere,
    SectorMemory,
    broken_copy,
    build,
    host_compiler,
    sketch_of,
    switched_on,
)
from tests.patience import PATIENCE_S

BOARD = REFERENCE / "boards" / "esp32"
FLASH_SIZE = 2 << 20
"""Bytes that ESP-IDF takes to be there; modules have 4 MB and more."""
UNITS = {"K": 1 << 10, "M": 1 << 20}


def compiled(*words: str) -> None:
    done = subprocess.run(words, capture_output=True, text=True, timeout=100, check=False)
    assert done.returncode == 0, done.stderr


def test_the_sketch_compiles_against_the_declarations(tmp_path: Path) -> None:
    sketch = sketch_of(tmp_path)
    try:
        compiler = host_compiler().split()
    except NotHere as missing:
        pytest.skip(str(missing))
    strict = ["-fsyntax-only", "-Wall", "-Wextra", "-Werror", f"-I{sketch}", f"-I{ESP_IDF / 'include'}"]
    sources = [str(each) for each in sorted(sketch.glob("*.c"))]
    compiled(*compiler, "-std=gnu11", "-DARDUINO=10607", *strict, *sources)
    if (c_plus_plus := shutil.which("g++")) is None:
        pytest.skip("no C++ compiler: apt install g++")
    arduino = ["-DARDUINO=10607", "-include", "freertos/task.h"]  # of which Arduino.h has all
    compiled(c_plus_plus, "-std=gnu++17", *arduino, *strict, "-x", "c++", str(sketch / "mocap_module.ino"))


def test_it_compiles_where_integers_are_those_of_the_chip(tmp_path: Path) -> None:
    """Where 32 bits are a ``long``, as on the ESP32: what mixes it up with ``int`` is seen on no PC."""
    if (compiler := shutil.which("arm-none-eabi-gcc")) is None:
        pytest.skip("apt install gcc-arm-none-eabi")
    sketch = sketch_of(tmp_path)
    folders = (sketch, ESP_IDF / "include", REFERENCE / "boards" / "freestanding")
    strict = ["-std=gnu17", "-ffreestanding", "-fsyntax-only", "-Wall", "-Wextra", "-Werror"]
    sources = sorted(sketch.glob("*.c"))
    compiled(compiler, *strict, *(f"-I{each}" for each in folders), *map(str, sources))


def test_both_ways_build_the_same_sources(tmp_path: Path) -> None:
    text = (BOARD / "main" / "CMakeLists.txt").read_text()
    named = [word.replace("${reference}", str(REFERENCE)) for word in re.findall(r"[^\s()]+\.c\b", text)]
    paths = [(BOARD / "main" / name).resolve() for name in named]
    assert all(path.is_file() for path in paths)
    assert sorted(path.name for path in paths) == sorted(
        path.name for path in sketch_of(tmp_path).glob("*.c")
    )


@pytest.mark.system
@pytest.mark.timeout(200)
async def test_without_its_partition_it_samples_and_says_that_nothing_is_kept(tmp_path: Path) -> None:
    source = broken_copy(
        tmp_path, "boards/esp32/board.c", '#define PARTITION "module"', '#define PARTITION "-"'
    )
    try:
        program = build(ESP32, tmp_path / "built", source)
    except NotHere as missing:
        pytest.skip(str(missing))
    memory = SectorMemory.fresh(tmp_path / "m.img", bytes(range(12)), settings={"module_id": 3})
    with switched_on(Machine(program, memory, tmp_path / "m")) as machine:
        bench = Bench(link_from_url(machine.url))
        async with bench.reading():
            await bench.find()
            assert bench.module == 0
            assert await bench.until(lambda: bool(bench.of(InertialSample)), PATIENCE_S)
            key = SETTING_KEYS["label"]
            await bench.request(Verb.WRITE_SETTING, key, encoded_setting("label", "new"))
            answer = await bench.request(Verb.COMMIT)
    assert answer is not None
    assert answer.result == Result.FLASH_FAILED


def size_of(text: str) -> int:
    return int(text[:-1]) * UNITS[text[-1]] if text[-1] in UNITS else int(text, 0)


def test_the_table_of_partitions_has_room_for_the_slots() -> None:
    lines = (BOARD / "partitions.csv").read_text().splitlines()
    rows = [[cell.strip() for cell in row] for row in csv.reader(lines) if row and not row[0].startswith("#")]
    extents = {row[0]: (size_of(row[3]), size_of(row[3]) + size_of(row[4])) for row in rows}
    ends = 0x9000  # the bootloader and the table itself stand before it
    for begin, end in extents.values():
        assert begin >= ends
        assert begin % SECTOR_SIZE == end % SECTOR_SIZE == 0
        ends = end
    assert ends <= FLASH_SIZE
    begin, end = extents["module"]
    assert end - begin == SECTORS_SIZE
    assert '#define PARTITION "module"' in (BOARD / "board.c").read_text()
    assert extents["factory"][0] == 0x10000  # where Arduino writes its program
