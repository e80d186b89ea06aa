"""Modules that run the reference firmware: as a process of this computer, or as machine code in QEMU."""

from __future__ import annotations

import contextlib
import ctypes
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

import pytest

from devices.emulators.device.emulated_flash import provision
from devices.emulators.device.firmware_memory import FirmwareMemory
from firmware_protocol.flash_slots import SLOT_SIZE
from tests.patience import PATIENCE_S

REFERENCE = Path(__file__).resolve().parents[2] / "firmware_protocol" / "reference"
ESP_IDF = Path(__file__).parent / "esp_idf"
"""A stand-in for the SDK of the ESP32, which cannot be installed here: its board runs on threads."""
POSIX, QEMU, ESP32, RELAY, STM32 = "posix", "qemu", "esp32", "relay", "stm32f405"
BOARDS = (POSIX, QEMU, ESP32)
SHOWN = {POSIX: POSIX, QEMU: QEMU, ESP32: "esp32 on threads"}
"""What a figure was seen on."""
PROGRAMS = {
    POSIX: "module_posix",
    QEMU: "module_qemu.elf",
    ESP32: "module_esp32",
    RELAY: "relay_posix",
    STM32: "module_stm32f405.elf",
}


class NotHere(Exception):
    """A board cannot be built or run on this computer; says what is missing."""


def host_compiler() -> str:
    """Return the command of a C compiler of this computer. Raises ``NotHere``."""
    for name in ("cc", "gcc", "clang"):
        if shutil.which(name):
            return name
    with contextlib.suppress(ImportError):
        import ziglang  # noqa: F401, PLC0415 - present only where there is no other

        return f"{sys.executable} -m ziglang cc"
    raise NotHere("no C compiler: apt install gcc, or pip install ziglang")


def shared_library(built: Path, folder: str, sources: Sequence[str], shim: str) -> ctypes.CDLL:
    """Build sources of the firmware, and a shim beside the tests, into ``built``; return it, loaded.

    Skips the test where there is no compiler.
    """
    try:
        compiler = host_compiler().split()
    except NotHere as missing:
        pytest.skip(str(missing))
    includes = [f"-I{each}" for each in (REFERENCE, REFERENCE / folder, REFERENCE.parent / "c")]
    parts = [*(REFERENCE / folder / name for name in sources), Path(__file__).parent / shim]
    strict = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-shared", "-fPIC"]
    command = [*compiler, *strict, *includes, *map(str, parts), "-o", str(built)]
    subprocess.run(command, check=True, timeout=100)
    return ctypes.CDLL(str(built))


def broken_copy(folder: Path, file: str, right: str, wrong: str) -> Path:
    """Copy the firmware's source with one thing changed; return where it can be built."""
    copied = folder / "firmware_protocol"
    shutil.copytree(REFERENCE, copied / "reference")
    shutil.copytree(REFERENCE.parent / "c", copied / "c", ignore=shutil.ignore_patterns("__pycache__"))
    source = copied / "reference" / file
    text = source.read_text()
    assert right in text, f"{file} has no {right}"
    source.write_text(text.replace(right, wrong))
    return copied / "reference"


class SectorMemory(FirmwareMemory):
    """The same with each slot at the begin of a sector of its own, as on the ESP32."""

    @classmethod
    def fresh(cls, path: Path, unique_id: bytes, **memory: Any) -> SectorMemory:
        """Make a chip from the factory. Its number is its MAC address: the last six bytes are 0."""
        settings = memory.pop("settings", None)
        FirmwareMemory.fresh(path, unique_id[:6] + bytes(6), **memory)
        page = path.read_bytes()[SLOTS_SIZE : SLOTS_SIZE + 20]
        with path.open("r+b") as file:
            file.write(bytes([0xFF]) * SECTORS_SIZE + page)
        made = cls(path)
        if settings is not None:
            provision(made, settings)
        return made

    def read(self, address: int, n: int) -> bytes:
        return super().read(_in_sectors(address), n)

    def _write(self, address: int, data: bytes) -> None:
        super()._write(_in_sectors(address), data)


SLOTS_SIZE, SECTOR_SIZE = 3 * SLOT_SIZE, 4096
SECTORS_SIZE = 3 * SECTOR_SIZE


def _in_sectors(address: int) -> int:
    if address >= SLOTS_SIZE:
        return address - SLOTS_SIZE + SECTORS_SIZE
    return address // SLOT_SIZE * SECTOR_SIZE + address % SLOT_SIZE


MEMORIES = {ESP32: SectorMemory}


def build(board: str, folder: Path, source: Path = REFERENCE, flags: str = "") -> Path:
    """Build the firmware for a board with its own Makefile; return the program. Raises ``NotHere``."""
    if shutil.which("make") is None:
        raise NotHere("no make: apt install make")
    if board == ESP32:
        return build_on_stand_in(folder, source)
    variables = [f"BUILD={folder}", f"CFLAGS={flags}"]
    needed = {QEMU: ("arm-none-eabi-gcc", "qemu-system-arm"), STM32: ("arm-none-eabi-gcc",)}.get(board)
    if needed is None:
        variables.append(f"CC={host_compiler()}")
    elif not all(map(shutil.which, needed)):
        raise NotHere("no Cortex-M here: apt install gcc-arm-none-eabi qemu-system-arm")
    command = ["make", "-s", "-C", str(source), board, *variables]
    done = subprocess.run(command, capture_output=True, text=True, timeout=250, check=False)
    assert done.returncode == 0, f"{' '.join(command)}\n{done.stdout}{done.stderr}"
    return folder / PROGRAMS[board]


def sketch_of(folder: Path, source: Path = REFERENCE) -> Path:
    """Lay the module for an ESP32 into one folder, as its Makefile does; return that."""
    subprocess.run(["make", "-s", "-C", str(source), "arduino", f"BUILD={folder}"], check=True, timeout=100)
    return folder / "mocap_module"


def build_on_stand_in(folder: Path, source: Path = REFERENCE) -> Path:
    """Build the module for an ESP32 with the stand-in for its SDK. Raises ``NotHere``."""
    sketch = sketch_of(folder, source)
    program = folder / PROGRAMS[ESP32]
    strict = ["-std=gnu11", "-Wall", "-Wextra", "-Werror", "-O1", "-g", "-pthread"]
    includes = [f"-I{sketch}", f"-I{ESP_IDF / 'include'}"]
    sources = [*map(str, sorted(sketch.glob("*.c"))), str(ESP_IDF / "stand_in.c")]
    command = [*host_compiler().split(), *strict, *includes, *sources, "-o", str(program)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=250, check=False)
    assert done.returncode == 0, f"{' '.join(command)}\n{done.stdout}{done.stderr}"
    return program


def command_of(program: Path, memory: FirmwareMemory, *more: str) -> list[str]:
    """Return what runs a program on a memory, with its line on a pseudo-terminal."""
    if program.suffix != ".elf":
        return [str(program), str(memory.path), *more]
    backend = f"memory-backend-file,id=m,size=16M,mem-path={memory.path},share=on"
    machine = ["-M", "mps2-an385,memory-backend=m", "-object", backend, "-kernel", str(program)]
    serial = [] if "-serial" in more else ["-serial", "pty"]
    return ["qemu-system-arm", *machine, "-display", "none", "-monitor", "none", *serial, *more]


@dataclass
class Machine:
    """A module that is switched on and off; its link stays the same path throughout."""

    program: Path
    memory: FirmwareMemory
    link: Path
    """Symbolic link to the pseudo-terminal."""
    more: tuple[str, ...] = ()
    environment: dict[str, str] = field(default_factory=dict)
    """Besides that of the tests."""
    _process: subprocess.Popen[str] | None = field(default=None, repr=False)
    _log: IO[str] | None = field(default=None, repr=False)

    @property
    def url(self) -> str:
        return str(self.link)

    @property
    def printed(self) -> str:
        """Return what it has printed since it was first switched on."""
        return self._log_path.read_text()

    @property
    def is_on(self) -> bool:
        return self._process is not None and self._process.poll() is None

    @property
    def _log_path(self) -> Path:
        return self.link.with_suffix(".log")

    def switch_on(self) -> None:
        """Start it, and wait until it has a line."""
        before = len(self.printed) if self._log_path.exists() else 0
        with self._log_path.open("a") as log:
            command = command_of(self.program, self.memory, *self.more)
            environment = {**os.environ, **self.environment}
            self._process = subprocess.Popen(command, stdout=log, stderr=log, text=True, env=environment)
        end = time.monotonic() + PATIENCE_S
        while (found := re.search(r"/dev/pts/\d+", self.printed[before:])) is None:
            assert time.monotonic() < end, self.printed
            assert self.is_on, self.printed
            time.sleep(0.002)
        new = self.link.with_suffix(".new")
        new.unlink(missing_ok=True)
        new.symlink_to(found[0])
        os.replace(new, self.link)

    def cut_power(self) -> None:
        """Off, at once and in the middle of whatever it does.

        Its link goes with it, as the name of a USB port does: left behind, it would soon lead whoever
        reconnects to another module, since the kernel gives the number of its pseudo-terminal away again.
        """
        self.link.unlink(missing_ok=True)
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None


@contextlib.contextmanager
def switched_on(machine: Machine) -> Iterator[Machine]:
    """Run it for as long as the block lasts."""
    machine.switch_on()
    try:
        yield machine
    finally:
        machine.cut_power()
