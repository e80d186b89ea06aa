"""Settings and ids of an emulated suit, through everything that can come between."""

from __future__ import annotations

import asyncio
import contextlib

import pytest

from devices.commands.command_client import CommandClient
from devices.commands.configure import Configurator
from devices.commands.device_backup import read_backup, restore_backup
from devices.commands.device_errors import (
    CommandRefusedError,
    NoAnswerError,
    UnfinishedError,
    UnknownDeviceError,
    WritesLockedError,
)
from devices.emulators.device.emulated_flash import Moment, PowerCut
from firmware_protocol.commands import Verb
from firmware_protocol.device_settings import encode_value
from tests.simulated_time import SimulatedPolicy

LABEL, RATE = 10, 2
OFF_S = 0.1
"""Of a module that loses power: back before it is asked again."""


@pytest.fixture
def event_loop_policy():
    """Nobody waits here for real."""
    return SimulatedPolicy()


@pytest.fixture
def configured(commanded_suit):
    """``async with configured(...) as (suit, configurator)``."""

    @contextlib.asynccontextmanager
    async def start(allow_writes=True, **settings):
        async with commanded_suit(**settings) as suit:
            client = CommandClient([suit.link], allow_writes=allow_writes)
            async with client.reading():
                yield suit, Configurator(client)

    return start


async def test_discovery_describes_every_device(configured):
    async with configured() as (suit, configurator):
        roster = await configurator.discover()
    assert [(device.module, device.unique_id) for device in roster.devices] == [
        (number, suit.unique_id(number)) for number in range(4)
    ]
    for device in roster.devices:
        assert device.version == 1
        assert device.info is not None
        assert device.info.unique_id == device.unique_id
        assert device.health is not None
    assert roster.conflicts == ()


async def test_who_was_there_is_asked_once_and_again_only_when_one_is_missing(configured):
    async with configured() as (suit, configurator):
        sent = []
        configurator.client.on_sent = sent.append
        counts = []
        for looks in range(3):
            if looks == 2:
                suit.traffic.cut_power(3, suit.soon_s(), off_s=60.0)
                await asyncio.sleep(0.1)
            before = len(sent)
            await configurator.discover()
            counts.append(len(sent) - before)
    assert counts == [6, 2, 6]  # each time of both questions


async def test_two_modules_with_one_id_are_a_named_conflict(configured):
    async with configured(stored_ids={2: 1}) as (suit, configurator):
        roster = await configurator.discover()
    (conflict,) = roster.conflicts
    assert (conflict.module, conflict.unique_ids) == (1, (suit.unique_id(1), suit.unique_id(2)))
    assert suit.unique_id(1).hex() in str(conflict)
    # Whose health it is cannot be told, so none has it.
    assert [device.health is None for device in roster.devices] == [False, True, True, False]
    with pytest.raises(UnknownDeviceError, match="name one by its unique id"):
        roster.find("1")
    assert roster.find(suit.unique_id(2).hex()).unique_id == suit.unique_id(2)
    with pytest.raises(UnknownDeviceError, match=r"no device '2' answers; there are: 0 \("):
        roster.find("2")


async def test_what_is_written_is_committed_and_reads_back(configured):
    async with configured() as (suit, configurator):
        one = suit.unique_id(1)
        change = await configurator.write(one, {"label": "left shank", "sampling_rate": 50.0})
        assert change.before == {"label": "", "sampling_rate": 100.0}
        assert change.after == {"label": "left shank", "sampling_rate": 50.0}
        assert suit.traffic.device(1).settings.staged == {}
        assert suit.traffic.device(1).settings["label"] == "left shank"
        await configurator.write(one, change.before)  # undo
        assert await configurator.read(one, change.before) == change.before


async def test_who_is_there_is_looked_for_anew_after_an_id_was_changed_and_not_after_a_label(configured):
    async with configured() as (suit, configurator):
        roster = await configurator.discover()
        await configurator.write(suit.unique_id(1), {"label": "left shank"})
        assert configurator.roster is roster
        await configurator.write(suit.unique_id(1), {"label": "shank", "module_id": 9})
        assert configurator.roster is None


async def test_what_somebody_else_has_staged_is_neither_believed_nor_committed(configured):
    async with configured() as (suit, configurator):
        one = suit.unique_id(1)
        ask = configurator.client.request
        await ask(one, Verb.WRITE_SETTING, RATE, encode_value(RATE, 200.0))
        change = await configurator.write(one, {"sampling_rate": 50.0})
        assert change.before == {"sampling_rate": 100.0}
        await ask(one, Verb.WRITE_SETTING, RATE, encode_value(RATE, 200.0))
        await configurator.write(one, {"label": "x"})
        assert await configurator.read(one, ["sampling_rate"]) == {"sampling_rate": 50.0}


@pytest.mark.parametrize(
    ("wanted", "message"),
    [
        ({"samplingrate": 1}, "did you mean 'sampling_rate'"),
        ({"sampling_rate": 5000}, "a number from 1 to 4000 Hz"),
        ({"mode": 9}, r"1 \(orientation fused"),
        ({"label": "x" * 17}, "up to 16 bytes"),
        ({"calibration": [1.0, 2.0]}, "30 numbers"),
        ({"module_id": "three"}, "a number from 0 to 63"),
    ],
)
async def test_values_that_cannot_be_are_refused_before_anything_is_sent(configured, wanted, message):
    async with configured() as (suit, configurator):
        with pytest.raises(ValueError, match=message):
            await configurator.write(suit.unique_id(0), wanted)
        assert suit.suit.counts.received_bytes == 0


async def test_writes_are_refused_unless_allowed(configured):
    async with configured(allow_writes=False) as (suit, configurator):
        with pytest.raises(WritesLockedError):
            await configurator.write(suit.unique_id(0), {"label": "x"})
        with pytest.raises(WritesLockedError):
            await configurator.assign_ids({suit.unique_id(0): 9})
        assert suit.ids() == {n: n for n in range(4)}


@pytest.mark.parametrize("verb", [Verb.WRITE_SETTING, Verb.COMMIT, Verb.DISCARD, Verb.READ_SETTING])
@pytest.mark.parametrize("moment", [Moment.BEFORE, Moment.AFTER])
async def test_a_module_that_restarts_while_it_is_written_ends_right(configured, verb, moment):
    async with configured() as (suit, configurator):
        device = suit.traffic.device(1)
        device.power_cut = PowerCut(verb, moment=moment, off_s=OFF_S)
        await configurator.write(suit.unique_id(1), {"label": "left", "sampling_rate": 50.0})
        assert device.boots == 2
        assert (device.settings["label"], device.settings["sampling_rate"]) == ("left", 50.0)
        assert device.settings.staged == {}


@pytest.mark.parametrize("step", [0, 1, 2, 5, 20, 80])
async def test_power_lost_inside_the_flash_ends_right(configured, step):
    async with configured() as (suit, configurator):
        device = suit.traffic.device(1)
        device.power_cut = PowerCut(Verb.COMMIT, moment=Moment.IN_FLASH, flash_step=step, off_s=OFF_S)
        await configurator.write(suit.unique_id(1), {"label": "left"})
        assert device.boots == 2
        assert device.settings["label"] == "left"
        assert device.settings["module_id"] == 1


async def test_swapped_modules_are_set_right_and_never_share_an_id(configured):
    async with configured(stored_ids={0: 3, 3: 0}) as (suit, configurator):
        seen = []
        write = configurator.write

        async def watched(unique_id, wanted):
            change = await write(unique_id, wanted)
            seen.append(sorted(suit.ids().values()))
            return change

        configurator.write = watched
        changes = await configurator.assign_ids({suit.unique_id(0): 0, suit.unique_id(3): 3})
        assert suit.ids() == {n: n for n in range(4)}
        assert len(seen) == 3
        assert all(len(set(ids)) == 4 for ids in seen)
        assert [(c.before, c.after) for c in changes] == [
            ({"module_id": 3}, {"module_id": 0}),
            ({"module_id": 0}, {"module_id": 3}),
        ]


@pytest.mark.parametrize("victim", [0, 3])
@pytest.mark.parametrize("verb", [Verb.DISCARD, Verb.WRITE_SETTING, Verb.COMMIT])
@pytest.mark.parametrize("moment", [Moment.BEFORE, Moment.IN_FLASH, Moment.AFTER])
async def test_a_swap_ends_right_whenever_a_module_restarts(configured, victim, verb, moment):
    async with configured() as (suit, configurator):
        suit.traffic.device(victim).power_cut = PowerCut(verb, moment=moment, flash_step=12, off_s=OFF_S)
        await configurator.assign_ids({suit.unique_id(0): 3, suit.unique_id(3): 0})
        assert suit.ids() == {0: 3, 1: 1, 2: 2, 3: 0}
        # It is in the flash, not only in the memory of the device.
        assert [suit.traffic.device(n).settings["module_id"] for n in (0, 3)] == [3, 0]


async def test_a_module_that_does_not_come_back_leaves_a_named_state_that_can_be_put_right(configured):
    async with configured() as (suit, configurator):
        device = suit.traffic.device(3)
        device.power_cut = PowerCut(Verb.COMMIT, off_s=30.0)
        a, b = suit.unique_id(0), suit.unique_id(3)
        with pytest.raises((NoAnswerError, UnfinishedError)) as failed:
            await configurator.assign_ids({a: 3, b: 0})
        assert b.hex() in str(failed.value)
        present = (await configurator.discover()).ids
        assert a in present  # nothing is lost, and no two share an id
        assert len(set(present.values())) == len(present)


async def test_flash_that_is_worn_out_is_named_and_the_old_settings_stand(configured, monkeypatch):
    async with configured() as (suit, configurator):
        device = suit.traffic.device(1)
        monkeypatch.setattr(type(device.settings), "commit", lambda self: None)
        with pytest.raises(Exception, match="still holds label="):
            await configurator.write(suit.unique_id(1), {"label": "left"})
        assert device.settings["label"] == ""


async def test_a_relays_id_is_not_to_be_changed(configured):
    async with configured(has_relay=True) as (suit, configurator):
        roster = await configurator.discover()
        assert roster.find("relay").unique_id == suit.unique_id(0xFE)
        assert suit.unique_id(0xFE) not in roster.ids
        with pytest.raises(CommandRefusedError, match="cannot do that"):
            await configurator.write(suit.unique_id(0xFE), {"module_id": 5})


async def test_a_backup_puts_back_settings_and_crosswise_ids(configured):
    async with configured() as (suit, configurator):
        saved = await read_backup(configurator, await configurator.discover())
        assert list(saved) == [suit.unique_id(n).hex() for n in range(4)]
        assert saved[suit.unique_id(2).hex()]["module_id"] == 2
        assert len(saved[suit.unique_id(2).hex()]["calibration"]) == 30
        await configurator.assign_ids({suit.unique_id(n): (n + 1) % 4 for n in range(4)})
        await configurator.write(suit.unique_id(2), {"label": "changed", "sampling_rate": 50.0})
        restored = await restore_backup(configurator, saved)
        assert suit.ids() == {n: n for n in range(4)}
        assert await read_backup(configurator, await configurator.discover()) == saved
        assert (restored.absent, restored.failures) == ([], {})
        absent = "00" * 11 + "01"
        again = await restore_backup(configurator, saved | {absent: {"label": "gone"}})
        assert (again.absent, again.failures) == ([bytes.fromhex(absent)], {})
        assert again.changes == []
        assert len(again.unchanged) == 4


async def test_one_locked_device_does_not_keep_a_backup_from_the_others(configured):
    async with configured() as (suit, configurator):
        saved = await read_backup(configurator, await configurator.discover())
        for settings in saved.values():
            settings["label"] = "new"
        suit.traffic.device(1).is_locked = True
        restored = await restore_backup(configurator, saved)
        assert list(restored.failures) == [suit.unique_id(1)]
        assert {change.unique_id for change in restored.changes} == {suit.unique_id(n) for n in (0, 2, 3)}
