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
from collections.abc import AsyncIterator, Callable, Coroutine, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import yaml

from devices.commands.command_client import CommandClient
from devices.commands.configure import Configurator
from devices.commands.device_errors import DeviceError
from devices.commands.setting_values import SETTING_KEYS, encoded_setting
from devices.endpoints import link_from_url
from devices.link import LinkError
from firmware_protocol import MAX_MODULE
from firmware_protocol.commands import Verb
from firmware_protocol.flash_slots import SLOT_SIZE, decode_slot
from tests.firmware.machines import ESP32, POSIX, QEMU, Machine
from tests.fixtures.commands import Command
from tests.patience import PATIENCE_S

IS_FOR_FIGURES = "FIRMWARE_FIGURES" in os.environ
N_TYPED, N_ASSIGNED = (250, 250) if IS_FOR_FIGURES else (60, 90)
"""Cuts while commands are typed, each a program: the whole number is left to ``make firmware-figures``."""

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
            await client.request(unique_id, Verb.WRITE_SETTING, SETTING_KEYS[name], raw)
        committing = asyncio.create_task(client.request(unique_id, Verb.COMMIT))
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
"""Ids of the arm's first two modules in rig arm_3."""
SEGMENTS = ("right_upper_arm", "right_forearm")
"""That wear them."""
N_LANES = 6
"""Modules, or pairs of them, cut beside each other: commands wait more than they work."""
SPREADS_S = (0.0, 0.03, 0.1)
"""At most so long after a commit's begin or end: at once, as long as it takes, or several times that."""
N_COMMITS = 3
"""Of ``modules assign`` while two change places: one goes aside, the other moves, the first one follows."""
LOOK_S = 0.001
ATTEMPTS = 3
EACH = 10


def flash_of(machines: Iterable[Machine]) -> list[bytes]:
    """What stands in the slots of settings of each."""
    return [machine.memory.read(0, 2 * SLOT_SIZE) for machine in machines]


def is_torn(flash: bytes) -> bool:
    """Whether a slot is neither erased nor good."""
    slots = flash[:SLOT_SIZE], flash[SLOT_SIZE:]
    return any(set(slot) != {0xFF} and decode_slot(slot) is None for slot in slots)


def newest(flash: bytes) -> int:
    """Return the generation of the settings in two slots; 0: there are none."""
    slots = map(decode_slot, (flash[:SLOT_SIZE], flash[SLOT_SIZE:]))
    return max((slot.generation for slot in slots if slot is not None), default=0)


class Instant:
    """When the power is to go: mostly within a commit of the command's or soon after, else anywhere in it."""

    def __init__(self, rng: random.Random, n_commits: int) -> None:
        self.commit = 0 if rng.random() < 0.1 else rng.randint(1, n_commits)
        """Which, from 1; 0: none is waited for."""
        self.is_of_end = rng.random() < 1 / 3
        """Its end is waited for, else its begin."""
        self.after_s = rng.uniform(0.0, rng.choice(SPREADS_S) if self.commit else 2.0)
        """So long after that."""

    async def come(self, process: Command, machines: list[Machine]) -> Machine:
        """Wait for it, or for the command's end; which machine wrote last.

        No two commits in a row are of one machine's, so another one begins where another machine writes.
        """
        seen, n_begun, writing = flash_of(machines), 0, machines[0]
        first = sum(map(newest, seen))
        while process.returncode is None:
            n_ended = sum(map(newest, seen)) - first
            if self.commit <= (n_ended if self.is_of_end else n_begun):
                break
            await asyncio.sleep(LOOK_S)
            now = flash_of(machines)
            for machine, old, new in zip(machines, seen, now, strict=True):
                if new != old and (machine is not writing or not n_begun):
                    writing, n_begun = machine, n_begun + 1
            seen = now
        await asyncio.sleep(self.after_s)
        return writing


@contextlib.asynccontextmanager
async def speaking(machines: list[Machine]) -> AsyncIterator[None]:
    """Switch modules on and wait until they are heard: QEMU looks once a second whether a line was opened."""
    try:
        for machine in machines:
            await asyncio.to_thread(machine.switch_on)
        await asyncio.gather(*(asyncio.to_thread(wait_until_heard, machine) for machine in machines))
        yield
    finally:
        for machine in machines:
            machine.cut_power()


def wait_until_heard(machine: Machine) -> None:
    """Wait until it says something. The line is closed again: commands refuse one that another has open."""
    line = os.open(machine.url, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    try:
        assert select.select([line], [], [], PATIENCE_S)[0], "it says nothing"
    finally:
        os.close(line)


@pytest.fixture
def _state_of_its_own(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))


async def in_lanes(lanes: Iterable[Coroutine[Any, Any, Counter[str]]]) -> Counter[str]:
    """Run them beside each other; the sum of what they counted."""
    return sum(await asyncio.gather(*lanes), Counter())


async def cut_typed_settings(
    command: Callable[..., Command], machine: Machine, n: int, lane: int | None = None
) -> Counter[str]:
    """Type ``modules set``, and cut the power while it writes; how often the old and the new stood then.

    lane: one of several; the command is then killed with the module, as it would wait for it.
    """
    rng, ended = random.Random(SEED + (lane or 0)), Counter[str]()
    uid = machine.memory.read(0x1800, 12).hex()
    for turn in range(n):
        wanted = {"module_id": turn % 64, "sampling_rate": 50 + turn % 100, "label": f"turn {turn}"}
        new = {name: encoded_setting(name, value) for name, value in wanted.items()}
        old = kept(machine, new)
        words = [f"{name}={value}" for name, value in wanted.items()]
        typed = (uid, *words, "--allow-writes", "--link", machine.url, "--rig", "single")
        async with speaking([machine]):
            process = command("modules", "set", *typed)
            await Instant(rng, 1).come(process, [machine])
        now = kept(machine, new)
        assert now in (old, new), f"turn {turn}: neither {old} nor {new} but {now}"
        ended["new" if now == new else "old"] += 1
        ended["torn"] += is_torn(flash_of([machine])[0])
        code = await end_of(process, lane)
        assert now == new or code != 0, f"turn {turn}: it ended well"
    return ended


async def end_of(process: Command, lane: int | None) -> int:
    """Return how a command ended whose module lost its power."""
    if lane is not None:
        process.kill()
    code = await process.ended()
    assert "Traceback" not in process.errors
    return code


@pytest.mark.usefixtures("_state_of_its_own")
@pytest.mark.timeout(400)
@pytest.mark.parametrize("board", [POSIX, QEMU])
async def test_modules_set_leaves_the_old_or_the_new(module, board, command):
    machine = module(board, settings={"module_id": 63}, is_on=False)
    print(dict(await cut_typed_settings(command, machine, 2)))
    held = machine.memory.settings["module_id"]
    typed = (held, "label=well", "--allow-writes", "--link", machine.url, "--rig", "single")
    async with speaking([machine]):
        process = command("modules", "set", *typed)
        assert await process.ended() == 0, process.errors
    assert machine.memory.settings["label"] == "well"


@pytest.mark.slow(reason="dozens of commands take some minutes")
@pytest.mark.usefixtures("_state_of_its_own")
@pytest.mark.timeout(3000)
async def test_many_cuts_while_settings_are_typed(module, command, figure):
    machines = [module(QEMU, 1 + lane, settings={"module_id": 63}, is_on=False) for lane in range(N_LANES)]
    shares = [len(range(lane, N_TYPED, N_LANES)) for lane in range(N_LANES)]
    ended = await in_lanes(
        cut_typed_settings(command, machine, n, lane)
        for lane, (machine, n) in enumerate(zip(machines, shares, strict=True))
    )
    figure(
        f"Power cut {sum(shares)} times while `modules set` writes, {QEMU}",
        f"the old settings stood then {ended['old']} times, the new {ended['new']} times, never others; "
        f"a slot was half written {ended['torn']} times",
    )
    assert ended["old"] > N_TYPED // 10
    assert ended["new"] > N_TYPED // 10


@dataclass(frozen=True)
class Arm:
    """Two modules that ``modules assign`` is typed for."""

    pair: list[Machine]
    config: Path
    command: Callable[..., Command]

    def ids(self) -> list[int]:
        """Return what the flash of each holds."""
        return [machine.memory.settings["module_id"] for machine in self.pair]

    def assign(self, machine: Machine, module_id: int) -> Command:
        """Type that this module is to be the one of the segment that wears this id."""
        uid = machine.memory.read(0x1800, 12).hex()
        typed = ("--segment", SEGMENTS[PAIR.index(module_id)], "--device", uid, "--yes", "--allow-writes")
        return self.command("modules", "assign", *typed, "-c", self.config)


@pytest.fixture
def arm(module, command, tmp_path) -> Callable[[str, int], Arm]:
    """``arm(board, place)``: two modules with a configuration of their own, switched off."""

    def make(board: str, place: int = 0) -> Arm:
        pair = [
            module(board, 2 * place + k, settings={"module_id": number}, is_on=False)
            for k, number in enumerate(PAIR, start=1)
        ]
        links = [{"name": f"line {n}", "url": each.url} for n, each in zip(PAIR, pair, strict=True)]
        config = tmp_path / f"gateway{place}.yaml"
        config.write_text(yaml.safe_dump({"gateway": "lab", "rig": "arm_3", "links": links}))
        return Arm(pair, config, command)

    return make


async def cut_typed_ids(arm: Arm, n: int, lane: int | None = None) -> Counter[str]:
    """Type ``modules assign`` so that two change places, and cut one's power; who then had which id.

    lane: as of ``cut_typed_settings``; only each tenth time it is typed again then until both are right.
    """
    rng, ended = random.Random(SEED + (lane or 0)), Counter[str]()
    for turn in range(n):
        before = arm.ids()
        holder, stood = arm.pair[before.index(PAIR[1])], flash_of(arm.pair)
        async with speaking(arm.pair):
            process = arm.assign(holder, PAIR[0])
            writing = await Instant(rng, N_COMMITS).come(process, arm.pair)
            cut = writing if rng.random() < 0.8 else rng.choice(arm.pair)
            cut.cut_power()
            then = arm.ids()
            ended["torn"] += is_torn(flash_of([cut])[0])
            await end_of(process, lane)
        for ids in (then, arm.ids()):
            assert len(set(ids)) == 2, f"turn {turn}: both are {ids[0]}"
            assert set(ids) <= {*PAIR, MAX_MODULE}, f"turn {turn}: {ids} of ids that nobody assigned"
        ended[how_far(before, then)] += 1
        if lane is None or turn % EACH == 0:
            await assign_again(arm, holder)
        else:
            for machine, flash in zip(arm.pair, stood, strict=True):
                for slot in range(2):
                    machine.memory.erase(slot)
                machine.memory.program(0, flash)
    return ended


def how_far(before: list[int], then: list[int]) -> str:
    """Return how far two modules that change places have come: of the commits so many are done."""
    n_new = sum(now not in (old, MAX_MODULE) for now, old in zip(then, before, strict=True))
    return f"after {min(n_new + (MAX_MODULE in then) + (n_new == len(PAIR)), N_COMMITS)}"


async def assign_again(arm: Arm, first: Machine) -> None:
    """Type it until both have the ids that they were to have, of the two the displaced one last."""
    (other,) = [machine for machine in arm.pair if machine is not first]
    async with speaking(arm.pair):
        for machine, module_id in zip((first, other), PAIR, strict=True):
            process = None
            for _ in range(ATTEMPTS):  # a busy host may not have heard both
                if machine.memory.settings["module_id"] != module_id:
                    process = arm.assign(machine, module_id)
                    await process.ended()
                    assert "Traceback" not in process.errors
            assert machine.memory.settings["module_id"] == module_id, process and process.report()
    assert [machine.memory.settings["module_id"] for machine in (first, other)] == list(PAIR)


@pytest.mark.usefixtures("_state_of_its_own")
@pytest.mark.timeout(400)
@pytest.mark.parametrize("board", [POSIX, QEMU])
async def test_modules_assign_never_loses_or_doubles_an_id(arm, board):
    print(dict(await cut_typed_ids(arm(board), 1)))


@pytest.mark.slow(reason="dozens of commands take some minutes")
@pytest.mark.usefixtures("_state_of_its_own")
@pytest.mark.timeout(3000)
async def test_many_cuts_while_ids_are_typed(arm, figure):
    shares = [len(range(lane, N_ASSIGNED, N_LANES)) for lane in range(N_LANES)]
    ended = await in_lanes(cut_typed_ids(arm(QEMU, lane), n, lane) for lane, n in enumerate(shares))
    done = [ended[f"after {n}"] for n in range(N_COMMITS + 1)]
    figure(
        f"Power cut {sum(shares)} times while `modules assign` has two change places, {QEMU}",
        f"no id lost or doubled; both had their old ids then {done[0]} times, one waited under a spare id "
        f"{done[1]} times, the other had its new one then {done[2]} times, both {done[3]} times; a slot of "
        f"the one that was cut was half written {ended['torn']} times",
    )
    assert min(done) > N_ASSIGNED // 100
    assert ended["torn"] > N_ASSIGNED // 100  # a twelfth of all is usual, within what chance allows
