"""The counter that wraps, samples of a fast module, and what restarts a firmware that hangs."""

from __future__ import annotations

import asyncio
import itertools
import signal
import subprocess
import time

import pytest

from devices.conformance import RuleOutcome, check_module
from devices.conformance.bench import Bench
from devices.emulators.device.firmware_memory import FirmwareMemory
from devices.endpoints import link_from_url
from firmware_protocol import Health, InertialSample, LogLine
from firmware_protocol.commands import Verb
from tests.firmware.machines import (
    MEMORIES,
    POSIX,
    QEMU,
    Machine,
    NotHere,
    broken_copy,
    build,
    command_of,
    switched_on,
)
from tests.patience import PATIENCE_S

pytestmark = [pytest.mark.system, pytest.mark.timeout(200)]

WRAP = 2**32
HANGS_AT = 77


async def test_the_counter_goes_through_its_wrap(module, board):
    machine = module(board, first_count_us=WRAP - 9_000_000)
    rules = ("health", "stamps_rise", "counter_in_microseconds", "even_sampling", "time_reported_truly")
    found = [each async for each in check_module(link_from_url(machine.url), only=rules)]
    assert {each.rule: each.detail for each in found if each.outcome is not RuleOutcome.KEPT} == {}
    bench = Bench(link_from_url(machine.url))
    async with bench.reading():
        assert await bench.until(lambda: bool(bench.of(InertialSample)), PATIENCE_S)
    assert bench.of(InertialSample)[0].received.module_time_us < WRAP // 2


async def test_a_magnetometer_slower_than_the_rest_is_left_out_between(module):
    machine = module(POSIX, settings={"sampling_rate": 200.0})
    bench = Bench(link_from_url(machine.url))
    async with bench.reading():
        assert await bench.until(lambda: len(bench.of(InertialSample)) > 400, PATIENCE_S)
    has_field = [each.packet.magnetic_field is not None for each in bench.of(InertialSample)]
    assert 0.4 < sum(has_field) / len(has_field) < 0.6
    assert bench.of(InertialSample)[-1].packet.specific_force is not None


async def test_what_nobody_reads_is_lost_and_numbers_go_on(module):
    machine = module(POSIX)
    bench = Bench(link_from_url(machine.url))
    async with bench.reading():
        assert await bench.until(lambda: len(bench.of(InertialSample)) > 20, PATIENCE_S)
    await asyncio.sleep(1.0)
    before = len(bench.packets)
    async with bench.reading():
        assert await bench.until(lambda: len(bench.of(InertialSample, before)) > 20, PATIENCE_S)
    numbers = [each.received.sequence for each in bench.of(InertialSample)]
    assert numbers == sorted(set(numbers))
    stamps = [each.received.module_time_us for each in bench.of(InertialSample)]
    assert max(b - a for a, b in itertools.pairwise(stamps)) > 900_000  # nothing old was kept for later


@pytest.mark.parametrize("how", [signal.SIGTERM, signal.SIGINT])
def test_a_process_that_is_ended_takes_its_link_away_but_not_another_s(program_of, tmp_path, how):
    memory, link = FirmwareMemory.fresh(tmp_path / "m.img", bytes(range(12))), tmp_path / "port"
    command = command_of(program_of(POSIX), memory, str(link))
    for is_laid_anew in (False, True):
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None
            assert process.stdout.readline().strip() == str(link.readlink())
            if is_laid_anew:
                link.unlink()
                link.symlink_to("/dev/null")
            process.send_signal(how)
            assert process.wait(PATIENCE_S) == -how
        assert link.is_symlink() is is_laid_anew


async def test_a_firmware_that_hangs_is_restarted_by_its_watchdog(tmp_path, board):
    hangs = (
        f"if (arguments.seconds == {HANGS_AT}u) {{ for (;;) {{ }} }}\n    module_blink(arguments.seconds);"
    )
    source = broken_copy(tmp_path, "commands.c", "module_blink(arguments.seconds);", hangs)
    try:
        program = build(board, tmp_path / "built", source)
    except NotHere as missing:
        pytest.skip(str(missing))
    kind = MEMORIES.get(board, FirmwareMemory)
    memory = kind.fresh(tmp_path / "m.img", bytes(range(12)), settings={"module_id": 3})
    with switched_on(Machine(program, memory, tmp_path / "m")) as machine:
        bench = Bench(link_from_url(machine.url))
        async with bench.reading():
            await bench.find()
            await bench.send_command(Verb.IDENTIFY, bytes([HANGS_AT]))
            end = time.monotonic() + PATIENCE_S
            while memory.starts < 2 and time.monotonic() < end:
                await asyncio.sleep(0.05)
            assert memory.starts == 2
            if board != QEMU:
                return  # it has another pseudo-terminal now
            since = bench.mark()
            assert await bench.until(lambda: bool(bench.of(Health, since)), PATIENCE_S)
            reason = "restarted by the watchdog"
            assert await bench.until(
                lambda: reason in {each.packet.text for each in bench.of(LogLine)}, PATIENCE_S
            )
        assert bench.of(Health)[-1].packet.resets == 1
