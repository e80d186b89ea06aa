"""What the reference firmware takes of a small chip: flash, RAM, deepest stack, instructions a sample.

::

    make firmware-sizes

The machine code for a Cortex-M3 runs in QEMU, where an instruction takes 32 ns of the module's time, whatever
it is: what is counted are instructions, not cycles.
"""

from __future__ import annotations

import asyncio
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from devices.conformance.bench import Bench
from devices.emulators.firmware_memory import FirmwareMemory
from devices.emulators.local_broker import free_port
from devices.endpoints import link_from_url
from firmware_protocol.commands import Verb
from firmware_protocol.messages import LogLine

PROGRAM = Path(__file__).parents[1] / "build" / "firmware" / "module_qemu.elf"
_CROSS = "arm-none-eabi-size"
_EMULATOR = "qemu-system-arm"
_SHIFT = 5
"""An instruction takes 2^5 ns."""
_RATE_HZ = 100.0
_SETTLED_S = 4.0


def sections(program: Path) -> dict[str, int]:
    """Return bytes of text (with constants), data and bss of a program."""
    told = subprocess.run([_CROSS, str(program)], capture_output=True, text=True, check=True).stdout
    names, numbers = (line.split() for line in told.splitlines()[:2])
    return {name: int(number) for name, number in zip(names[:3], numbers[:3], strict=True)}


def started(program: Path, memory: FirmwareMemory, port: int) -> subprocess.Popen[bytes]:
    """Start the module, with its line on a TCP port."""
    backend = f"memory-backend-file,id=m,size=16M,mem-path={memory.path},share=on"
    machine = ["-M", "mps2-an385,memory-backend=m", "-object", backend, "-kernel", str(program)]
    serial = ["-display", "none", "-monitor", "none", "-serial", f"tcp:127.0.0.1:{port},server=on,wait=off"]
    return subprocess.Popen([_EMULATOR, *machine, *serial, "-icount", f"shift={_SHIFT}"])


async def told_by_module(program: Path, memory: FirmwareMemory) -> dict[str, int]:
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
            await bench.ask(Verb.GET_INFO)
            await bench.until(lambda: len(bench.of(LogLine, since)) >= 2)
            lines = [each.packet.text.rsplit(": ", 1) for each in bench.of(LogLine, since)]
    finally:
        process.kill()
        process.wait()
    return {line[0]: int(line[1]) for line in lines if len(line) == 2 and line[1].isdecimal()}


def main() -> None:
    """Print a table. Ends with a line that says what is missing where it cannot be measured."""
    if not (PROGRAM.exists() and shutil.which(_CROSS) and shutil.which(_EMULATOR)):
        sys.exit(f"not measured: {PROGRAM.name} was not built, or {_CROSS} or {_EMULATOR} is missing")
    with tempfile.TemporaryDirectory() as folder:
        memory = FirmwareMemory.fresh(Path(folder) / "memory", bytes(range(12)), settings={"module_id": 1})
        told = asyncio.run(told_by_module(PROGRAM, memory))
    size = sections(PROGRAM)
    awake_us = told["awake, us of the last second"]
    print(f"flash   {size['text'] + size['data']:6} bytes  text {size['text']}, data {size['data']}")
    print(f"RAM     {size['data'] + size['bss']:6} bytes  data {size['data']}, bss {size['bss']}")
    print(f"stack   {told['stack, most bytes in use']:6} bytes  the deepest until now")
    per_sample = awake_us * 1000 / 2**_SHIFT / _RATE_HZ
    print(f"awake   {awake_us / 1e4:6.2f} %      {per_sample:.0f} instructions a sample, with all else")


if __name__ == "__main__":
    main()
