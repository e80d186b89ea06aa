"""What the reference firmware takes of a small chip: flash, RAM, deepest stack, instructions a sample.

::

    make firmware-sizes      # prints
    make firmware-figures    # runs the tests that show figures, too, and writes docs/guide/firmware.md

The machine code for a Cortex-M3 runs in QEMU, where an instruction takes 32 ns of the module's time, whatever
it is: what is counted are instructions, not cycles.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from benchmarks.figures import replace_section
from devices.conformance.bench import Bench
from devices.emulators.device.firmware_memory import FirmwareMemory
from devices.endpoints import link_from_url
from devices.free_ports import free_port
from firmware_protocol.commands import Verb
from firmware_protocol.messages import LogLine

_BUILT = Path(__file__).parents[1] / "build" / "firmware"
PAGE = Path(__file__).parents[1] / "docs" / "guide" / "firmware.md"
_CROSS = "arm-none-eabi-size"
PROGRAMS = {
    "module_qemu.elf": _CROSS,
    "module_stm32f405.elf": _CROSS,
    "module_posix": "size",
    "module_posix_can": "size",
    "relay_posix": "size",
}
"""What is measured, where it was built, and what measures it."""
PROGRAM = _BUILT / "module_qemu.elf"
_EMULATOR = "qemu-system-arm"
_SHIFT = 5
"""An instruction takes 2^5 ns."""
_RATE_HZ = 100.0
_SETTLED_S = 4.0


def sections(program: Path) -> dict[str, int]:
    """Return bytes of text (with constants), data and bss of a program."""
    command = [PROGRAMS[program.name], str(program)]
    output = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    names, numbers = (line.split() for line in output.splitlines()[:2])
    return {name: int(number) for name, number in zip(names[:3], numbers[:3], strict=True)}


def started(program: Path, memory: FirmwareMemory, port: int) -> subprocess.Popen[bytes]:
    """Start the module, with its line on a TCP port."""
    backend = f"memory-backend-file,id=m,size=16M,mem-path={memory.path},share=on"
    machine = ["-M", "mps2-an385,memory-backend=m", "-object", backend, "-kernel", str(program)]
    serial = ["-display", "none", "-monitor", "none", "-serial", f"tcp:127.0.0.1:{port},server=on,wait=off"]
    return subprocess.Popen([_EMULATOR, *machine, *serial, "-icount", f"shift={_SHIFT},sleep=off"])


async def reported_by_module(program: Path, memory: FirmwareMemory) -> dict[str, int]:
    """Return the numbers that the module itself logs when it is asked for its info."""
    port = free_port()
    process = started(program, memory, port)
    try:
        await asyncio.sleep(1.0)
        bench = Bench(link_from_url(f"tcp://127.0.0.1:{port}", name="module"))
        async with bench.reading():
            await bench.find()
            await asyncio.sleep(_SETTLED_S)
            since = bench.mark()
            await bench.request(Verb.GET_INFO)
            await bench.until(lambda: len(bench.of(LogLine, since)) >= 2)
            lines = [each.packet.text.rsplit(": ", 1) for each in bench.of(LogLine, since)]
    finally:
        process.kill()
        process.wait()
    return {line[0]: int(line[1]) for line in lines if len(line) == 2 and line[1].isdecimal()}


def size_rows() -> list[str]:
    """Return a table of the sections of all programs that were built, bytes."""
    rows = ["| program | text | data | bss | flash | RAM |", "|---|---|---|---|---|---|"]
    for name, measured_by in PROGRAMS.items():
        if (_BUILT / name).exists() and shutil.which(measured_by):
            text, data, bss = sections(_BUILT / name).values()
            # a program of this computer brings the C library's start, and lies in memory as a whole
            in_chip = f"{text + data} | {data + bss}" if measured_by == _CROSS else "– | –"
            rows.append(f"| `{name}` | {text} | {data} | {bss} | {in_chip} |")
    return rows


def run_rows() -> list[str]:
    """Return what was measured while the Cortex-M3 runs: deepest stack, and how long it is awake."""
    with tempfile.TemporaryDirectory() as folder:
        memory = FirmwareMemory.fresh(Path(folder) / "memory", bytes(range(12)), settings={"module_id": 1})
        reported = asyncio.run(reported_by_module(PROGRAM, memory))
    awake_us = reported["awake, us of the last second"]
    per_us = 1000 / 2**_SHIFT
    per_sample = awake_us * per_us / _RATE_HZ
    return [
        f"| measured on `{PROGRAM.name}`, {_RATE_HZ:.0f} Hz | |",
        "|---|---|",
        f"| deepest stack until now | {reported['stack, most bytes in use']} bytes |",
        f"| processor awake | {awake_us / 1e4:.2f} % of {per_us:.0f} million instructions a second |",
        f"| a sample, with its packet and all else | {per_sample:.0f} instructions |",
    ]


def figure_rows(folder: Path) -> list[str]:
    """Return a table of what the tests kept in a folder (``figure`` of their conftest)."""
    kept = sorted(json.loads(path.read_text()) for path in folder.glob("*.json"))
    rows = [f"| {what} | {seen} |" for what, seen in kept]
    return ["| what | seen |", "|---|---|", *rows]


def main() -> None:
    """Print tables. Ends with a line that says what is missing where it cannot be measured."""
    parser = argparse.ArgumentParser(description="Measure the reference firmware.")
    parser.add_argument("--figures", type=Path, help="Folder in which the tests kept what they saw.")
    parser.add_argument("--write-docs", action="store_true", help=f"Put the tables into {PAGE.name}.")
    arguments = parser.parse_args()
    if not (PROGRAM.exists() and shutil.which(_CROSS) and shutil.which(_EMULATOR)):
        sys.exit(f"not measured: {PROGRAM.name} was not built, or {_CROSS} or {_EMULATOR} is missing")
    sizes = "\n".join([*size_rows(), "", *run_rows(), ""])
    seen = "\n".join([*figure_rows(arguments.figures), ""]) if arguments.figures else ""
    print(sizes, seen, sep="\n")
    if arguments.write_docs:
        replace_section(PAGE, "firmware sizes", sizes)
        if seen:
            replace_section(PAGE, "firmware figures", seen)


if __name__ == "__main__":
    main()
