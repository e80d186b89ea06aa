"""Modules of the reference firmware on a CAN bus of the kernel: told apart, given ids, off the bus and back.

Run by `make test-socketcan`, which builds `module_posix_can` before.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
import struct
import subprocess
from pathlib import Path

import pytest

from devices.commands.command_client import CommandClient
from devices.commands.configure import Configurator
from devices.conformance import RuleOutcome, check_module
from devices.conformance.bench import Bench
from devices.emulators.device.firmware_memory import FirmwareMemory
from devices.endpoints import link_from_url
from devices.links.socketcan_link import can_interfaces
from firmware_protocol import InertialSample, LogLine

PROGRAM = Path(__file__).parents[2] / "build" / "firmware" / "module_posix_can"
BUS = "can://socketcan/vcan1"
BUS_OFF = 0x040

pytestmark = [
    pytest.mark.system,
    pytest.mark.timeout(400),
    pytest.mark.skipif(
        not {"vcan0", "vcan1"} <= set(can_interfaces()),
        reason="this kernel has no vcan0 and vcan1: `make test-socketcan` brings its own",
    ),
    pytest.mark.skipif(not PROGRAM.exists(), reason=f"{PROGRAM.name} is not built: make firmware"),
]


@contextlib.contextmanager
def modules_on_bus(folder: Path, ids: list[int]):
    """Run modules with these ids stored; their unique ids are twelve times 1, 2, ..."""
    with contextlib.ExitStack() as stack:
        memories = []
        for number, module_id in enumerate(ids, start=1):
            settings = {"module_id": module_id, "sampling_rate": 20.0}
            path = folder / f"chip{number}"
            memories.append(FirmwareMemory.fresh(path, bytes([number] * 12), settings=settings))
            process = subprocess.Popen([PROGRAM, path, "vcan1"], stdout=subprocess.DEVNULL)
            stack.callback(process.wait)
            stack.callback(process.kill)
        yield memories


def send_error(identifier: int) -> None:
    """An error frame as a controller's driver makes it."""
    with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as bus:
        bus.bind(("vcan1",))
        bus.send(struct.pack("=IB3x8s", identifier | 1 << 29, 8, bytes(8)))


async def listened(seconds: float = 0.0) -> Bench:
    bench = Bench(link_from_url(BUS))
    async with bench.reading():
        await asyncio.sleep(seconds)
    return bench


async def test_the_rules_are_kept_on_a_bus_of_several(tmp_path):
    with modules_on_bus(tmp_path, [1, 2, 3]):
        found = [each async for each in check_module(link_from_url(BUS), "02020202", allow_writes=True)]
    told = {each.rule: each.detail for each in found if each.outcome is RuleOutcome.BROKEN}
    # A machine that is emulated without help of the hardware is too slow for evenness.
    assert not told.keys() - {"even_sampling", "sequence_of_samples", "acts_by_settings"}, told


async def test_two_of_one_id_are_told_and_told_apart(tmp_path):
    with modules_on_bus(tmp_path, [1, 2, 2]) as memories:
        bench = await listened(4.0)
        said = {each.packet.text for each in bench.of(LogLine)}
        assert "another module on the bus sends under id 2" in said
        client = CommandClient([link_from_url(BUS)], allow_writes=True)
        async with client.reading():
            wanted = {bytes([number] * 12): number for number in (1, 2, 3)}
            await Configurator(client).assign_ids(wanted)
        assert [memory.settings["module_id"] for memory in memories] == [1, 2, 3]
        bench = await listened(3.0)
        assert {each.received.module for each in bench.of(InertialSample)} == {1, 2, 3}
        assert not bench.decoder.dropped


async def test_a_module_that_left_the_bus_comes_back(tmp_path):
    with modules_on_bus(tmp_path, [5]):
        await asyncio.sleep(1.0)
        bench = Bench(link_from_url(BUS))
        async with bench.reading():
            assert await bench.until(lambda: bool(bench.of(InertialSample)), 60.0)
        send_error(BUS_OFF)  # no link of this process listens: it is the module that learns of it
        bench = Bench(link_from_url(BUS))
        async with bench.reading():
            assert await bench.until(lambda: len(bench.of(InertialSample)) > 5, 60.0)
            assert {each.received.module for each in bench.of(InertialSample)} == {5}
