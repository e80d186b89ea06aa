"""Power that goes at a random instant of a change of settings: old or new ones, no id lost or doubled.

The reference firmware is killed, and its memory, a file, is looked into before it starts again. Its flash
takes as long as a chip's: most of a commit is the erasing of a slot, so most cuts fall into that.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import random
import select
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator

import pytest
import yaml

from devices.command_client import CommandClient
from devices.configure import Configurator
from devices.device_errors import DeviceError
from devices.endpoints import link_from_url
from devices.link import LinkError
from devices.setting_values import SETTING_KEYS, encoded_setting
from firmware_protocol.commands import Verb
from tests.firmware.machines import ESP32, POSIX, QEMU, Machine
from tests.fixtures.commands import Command
from tests.patience import PATIENCE_S

pytestmark = [pytest.mark.system]

CUTS = {POSIX: 40, QEMU: 12, ESP32: 30}
SEED = int(os.environ.get("FIRMWARE_SEED", "28"))
LATEST = 1.3
"""Of the time that a commit takes: some cuts come after it."""
LABELS = ("one", "another", "ein dritter")


async def stage_and_cut(
    machine: Machine, settings: dict[str, bytes], cut_s: float | None
) -> tuple[bool, float]:
    """Write settings, and cut the power so long after COMMIT was sent (None: after its answer).

    Whether it was answered before, and after how long the power went, s."""
    link = link_from_url(machine.url, name="module")
    client = CommandClient([link], allow_writes=True)
    unique_id = machine.memory.read(0x1800, 12)
    async with client.reading():
        for name, raw in settings.items():
            await client.ask(unique_id, Verb.WRITE_SETTING, SETTING_KEYS[name], raw)
        committing = asyncio.create_task(client.ask(unique_id, Verb.COMMIT))
        begun = time.monotonic()
        await asyncio.wait([committing], timeout=PATIENCE_S if cut_s is None else cut_s)
        is_answered = committing.done()
        machine.cut_power()
        passed_s = time.monotonic() - begun
        committing.cancel()
        with contextlib.suppress(asyncio.CancelledError, DeviceError, LinkError):
            await committing
    return is_answered, passed_s


def kept(machine: Machine, names: Iterable[str]) -> dict[str, bytes]:
    """What a start would find of some settings."""
    held = machine.memory.settings
    return {name: encoded_setting(name, held[name]) for name in names}


async def cut_again_and_again(machine: Machine, n: int) -> Counter[str]:
    """Change settings of a module and cut its power, n times; how often the old and the new stood then."""
    rng = random.Random(SEED)
    ended: Counter[str] = Counter()
    commit_s = 0.0
    for turn in range(n):
        wanted = {"module_id": turn % 64, "sampling_rate": 50.0 + turn % 100, "label": LABELS[turn % 3]}
        new = {name: encoded_setting(name, value) for name, value in wanted.items()}
        machine.switch_on()
        old = kept(machine, new)
        cut_s = None if turn == 0 else 0.0 if turn == 1 else rng.uniform(0, LATEST * commit_s)
        is_answered, passed_s = await stage_and_cut(machine, new, cut_s)
        commit_s = passed_s if turn == 0 else commit_s
        now = kept(machine, new)
        assert now in (old, new), f"turn {turn}: neither {old} nor {new} but {now}"
        assert now == new or not is_answered, f"turn {turn}: it had answered"
        assert machine.memory.starts == turn + 1
        ended["new" if now == new else "old"] += 1
    return ended


@pytest.mark.timeout(250)
async def test_settings_are_the_old_or_the_new(module, board):
    ended = await cut_again_and_again(module(board, settings={"module_id": 63}, is_on=False), CUTS[board])
    print(f"{board}: {dict(ended)}")
    assert ended["old"]
    assert ended["new"]


@pytest.mark.slow(reason="500 cuts take some minutes")
@pytest.mark.timeout(3000)
@pytest.mark.parametrize("board", [POSIX, QEMU])
async def test_five_hundred_cuts(module, board, figure):
    ended = await cut_again_and_again(module(board, settings={"module_id": 63}, is_on=False), 500)
    figure(
        f"Power cut 500 times while settings are committed, {board}",
        f"the old settings stood then {ended['old']} times, the new {ended['new']} times, never others",
    )
    assert ended["old"] > 50
    assert ended["new"] > 50


async def cut_while_ids_change_places(pair: list[Machine], n: int) -> Counter[str]:
    """Assign two modules each other's ids, n times, and cut the power of one; how many then had theirs."""
    rng, ended, assign_s = random.Random(SEED), Counter[str](), 0.0
    for turn in range(n):
        wanted = {bytes([1] * 12): 2 - turn % 2, bytes([2] * 12): 1 + turn % 2}
        await assign_and_cut(pair, wanted, rng.uniform(0.0, LATEST * assign_s), rng.randrange(2))
        ids = [machine.memory.settings["module_id"] for machine in pair]
        assert len(set(ids)) == 2, f"turn {turn}: both are {ids[0]}"
        have = sum(i == id_then for i, id_then in zip(ids, wanted.values(), strict=True))
        ended[("neither", "one", "both")[have]] += 1
        for machine in pair:
            machine.switch_on()
        async with configurator_of(pair) as configurator:
            begun = time.monotonic()
            await configurator.assign_ids(wanted)
            assign_s = max(assign_s, time.monotonic() - begun) if turn < 3 else assign_s
        for machine in pair:
            machine.cut_power()
        assert [machine.memory.settings["module_id"] for machine in pair] == list(wanted.values())
    return ended


def pair_of(module: Callable[..., Machine], board: str) -> list[Machine]:
    return [module(board, number, settings={"module_id": number}, is_on=False) for number in (1, 2)]


@pytest.mark.timeout(250)
@pytest.mark.parametrize("board", [POSIX, QEMU])
async def test_ids_that_change_places_are_never_lost_or_doubled(module, board):
    """``modules assign`` of two modules that have each other's ids, cut at a random instant of it."""
    print(f"{board}: {dict(await cut_while_ids_change_places(pair_of(module, board), 4))}")


@pytest.mark.slow(reason="60 cuts take some minutes")
@pytest.mark.timeout(3000)
async def test_sixty_cuts_while_ids_change_places(module, figure):
    ended = await cut_while_ids_change_places(pair_of(module, QEMU), 60)
    figure(
        f"Power cut 60 times while two modules are assigned each other's ids, {QEMU}",
        f"no id lost or doubled; neither had its own yet {ended['neither']} times, one {ended['one']} times, "
        f"both {ended['both']} times",
    )


@contextlib.asynccontextmanager
async def configurator_of(pair):
    client = CommandClient([link_from_url(m.url, name=m.url) for m in pair], allow_writes=True)
    async with client.reading():
        yield Configurator(client, restart_patience_s=0.5)


async def assign_and_cut(pair, wanted, cut_s, which):
    for machine in pair:
        machine.switch_on()
    async with configurator_of(pair) as configurator:
        assigning = asyncio.create_task(configurator.assign_ids(wanted))
        await asyncio.wait([assigning], timeout=cut_s)
        pair[which].cut_power()
        assigning.cancel()
        await asyncio.gather(assigning, return_exceptions=True)
    for machine in pair:
        machine.cut_power()


# As somebody types it.

PAIR = (8, 9)
"""Ids of the arm's two modules in rig arm_3."""


def flash_of(machines: Iterable[Machine]) -> list[bytes]:
    """What stands in the slots of settings of each."""
    return [machine.memory.read(0, 0x1000) for machine in machines]


def cut_as_it_writes(
    process: Command, machines: list[Machine], which: int, after_s: float, n_changes: int
) -> None:
    """Cut the power of a module so long after flash was seen to change so often, or at the command's end."""
    seen, changes = flash_of(machines), 0
    while process.returncode is None and changes < n_changes:
        now = flash_of(machines)
        changes += now != seen
        seen = now
    time.sleep(after_s)
    machines[which].cut_power()


@contextlib.contextmanager
def speaking(machine: Machine) -> Iterator[None]:
    """Switch a module on and wait until it is heard: QEMU looks once a second whether its line was opened."""
    machine.switch_on()
    line = os.open(machine.url, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    try:
        assert select.select([line], [], [], PATIENCE_S)[0], "it says nothing"
        yield
    finally:
        os.close(line)


@pytest.fixture
def _state_of_its_own(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))


def cuts_of_typed_settings(command: Callable[..., Command], machine: Machine, n: int) -> Counter[str]:
    """Type ``modules set``, and cut the power while it writes; how often the old and the new stood then."""
    rng, ended = random.Random(SEED), Counter[str]()
    for turn in range(n):
        wanted = {"sampling_rate": 50 + turn % 100, "label": f"turn {turn}"}
        new = {name: encoded_setting(name, value) for name, value in wanted.items()}
        old = kept(machine, new)
        words = [f"{name}={value}" for name, value in wanted.items()]
        typed = ("01010101", *words, "--allow-writes", "--link", machine.url, "--rig", "single")
        with speaking(machine):
            process = command("modules", "set", *typed)
            cut_as_it_writes(process, [machine], 0, rng.uniform(0.0, 0.03), rng.randrange(1, 60))
        code = process.wait()
        assert "Traceback" not in process.errors
        now = kept(machine, new)
        assert now in (old, new), f"turn {turn}: neither {old} nor {new} but {now}"
        assert now == new or code != 0, f"turn {turn}: it ended well"
        ended["new" if now == new else "old"] += 1
    return ended


@pytest.mark.usefixtures("_state_of_its_own")
@pytest.mark.timeout(400)
@pytest.mark.parametrize("board", [POSIX, QEMU])
def test_modules_set_leaves_the_old_or_the_new(module, board, command):
    machine = module(board, settings={"module_id": 63}, is_on=False)
    print(dict(cuts_of_typed_settings(command, machine, 2)))
    typed = ("63", "label=well", "--allow-writes", "--link", machine.url, "--rig", "single")
    with speaking(machine):
        process = command("modules", "set", *typed)
        assert process.wait() == 0, process.errors


@pytest.mark.usefixtures("_state_of_its_own")
@pytest.mark.timeout(400)
def test_modules_assign_never_loses_or_doubles_an_id(module, command, tmp_path):
    rng = random.Random(SEED)
    pair = [module(POSIX, number, settings={"module_id": number}, is_on=False) for number in PAIR]
    config = tmp_path / "gateway.yaml"
    links = [{"name": f"line {n}", "url": each.url} for n, each in zip(PAIR, pair, strict=True)]
    config.write_text(yaml.safe_dump({"gateway": "lab", "rig": "arm_3", "links": links}))
    for turn in range(2):
        for machine in pair:
            machine.switch_on()
        holder = next(each for each in pair if each.memory.settings["module_id"] != PAIR[0])
        uid = holder.memory.read(0x1800, 12).hex()
        typed = ("modules", "assign", "--segment", "right_upper_arm", "--device", uid, "--yes",
                 "--allow-writes", "-c", config)  # fmt: skip
        process = command(*typed)
        cut_as_it_writes(process, pair, rng.randrange(2), rng.uniform(0.0, 0.03), rng.randrange(1, 150))
        process.wait()
        assert "Traceback" not in process.errors
        for machine in pair:
            machine.cut_power()
        ids = [machine.memory.settings["module_id"] for machine in pair]
        assert len(set(ids)) == 2, f"turn {turn}: both are {ids[0]}"
        for machine in pair:
            machine.switch_on()
        process = command(*typed)
        assert process.wait() == 0, process.errors
        assert holder.memory.settings["module_id"] == PAIR[0]
        assert len({machine.memory.settings["module_id"] for machine in pair}) == 2
        for machine in pair:
            machine.cut_power()
