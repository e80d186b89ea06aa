"""What fails in the middle can be taken back, as far as it went and no further."""

from __future__ import annotations

import errno
import os

import pytest

from devices.commands.device_errors import (
    CommandRefusedError,
    DeviceError,
    UnfinishedError,
    WritesLockedError,
)
from devices.emulators.device.emulated_flash import PowerCut
from firmware_protocol.commands import Verb
from gateway.modules.journal import JournalError
from gateway.modules.operations import RequestError
from tests.simulated_time import SimulatedPolicy


@pytest.fixture
def event_loop_policy():
    """Nobody waits here for real."""
    return SimulatedPolicy()


def noted(journal):
    """Settings by unique id that the newest entry would write back."""
    entry = journal.last()
    return {} if entry is None else {change.unique_id: dict(change.before) for change in entry.changes}


async def test_a_refusal_in_the_middle_of_a_swap_is_told_and_can_be_taken_back(operated):
    async with operated() as (suit, operations, journal):
        zero, three = suit.unique_id(0), suit.unique_id(3)
        suit.traffic.device(3).is_locked = True
        with pytest.raises(UnfinishedError) as refused:
            await operations.perform("assign", {"ids": {zero.hex(): 3, three.hex(): 0}})
        held = suit.ids()[0]
        assert held not in {0, 3}  # it waits on a spare one
        said = str(refused.value)
        assert f"device {zero.hex()} has module id {held}, not 3" in said
        assert f"device {three.hex()} has module id 3, not 0" in said
        assert "writing is locked on the device itself" in said
        assert noted(journal) == {zero: {"module_id": 0}}

        done = await operations.perform("undo", {})
        assert [change["after"] for change in done["changes"]] == [{"module_id": 0}]
        assert suit.ids() == {n: n for n in range(4)}
        with pytest.raises(RequestError, match="no change to undo"):
            await operations.perform("undo", {})


async def test_a_refusal_that_changed_nothing_leaves_the_change_before_to_be_undone(operated):
    async with operated() as (suit, operations, journal):
        await operations.perform("set", {"device": "1", "settings": {"label": "one"}})
        suit.traffic.device(2).is_locked = True
        two = suit.unique_id(2)
        with pytest.raises(CommandRefusedError, match="writing is locked"):
            await operations.perform("set", {"device": "2", "settings": {"label": "two"}})
        with pytest.raises(CommandRefusedError, match="writing is locked"):
            await operations.perform("assign", {"ids": {two.hex(): 9}})
        assert noted(journal) == {suit.unique_id(1): {"label": ""}}


async def test_a_restore_that_one_module_refuses_is_taken_back_where_it_went_through(operated):
    async with operated() as (suit, operations, journal):
        await operations.perform("set", {"device": "0", "settings": {"label": "earlier"}})
        saved = {suit.unique_id(n).hex(): {"label": "new"} for n in range(4)}
        saved[suit.unique_id(2).hex()]["module_id"] = 9
        suit.traffic.device(1).is_locked = True
        done = await operations.perform("restore", {"modules": saved})
        assert list(done["failures"]) == [suit.unique_id(1).hex()]
        assert noted(journal) == {
            suit.unique_id(0): {"label": "earlier"},
            suit.unique_id(2): {"label": "", "module_id": 2},
            suit.unique_id(3): {"label": ""},
        }
        await operations.perform("undo", {})
        assert suit.ids() == {n: n for n in range(4)}
        labels = [suit.traffic.device(n).settings["label"] for n in range(4)]
        assert labels == ["earlier", "", "", ""]


async def test_ids_refused_after_settings_were_restored_are_failures_and_not_the_end(operated):
    async with operated() as (suit, operations, journal):
        zero, three = suit.unique_id(0), suit.unique_id(3)
        suit.traffic.device(3).is_locked = True
        wanted = {zero.hex(): {"label": "new", "module_id": 3}, three.hex(): {"module_id": 0}}
        done = await operations.perform("restore", {"modules": wanted})
        assert set(done["failures"]) == {zero.hex(), three.hex()}
        assert "has module id 3, not 0" in done["failures"][three.hex()]
        assert "writing is locked" in done["failures"][three.hex()]
        assert noted(journal) == {zero: {"label": "", "module_id": 0}}
        await operations.perform("undo", {})
        assert suit.ids()[0] == 0
        assert suit.traffic.device(0).settings["label"] == ""


async def test_ids_that_cannot_be_given_are_refused_before_any_setting_is_written(operated):
    async with operated() as (suit, operations, journal):
        wanted = {suit.unique_id(0).hex(): {"label": "new", "module_id": 2}}
        with pytest.raises(RequestError, match="module id 2 is held by"):
            await operations.perform("restore", {"modules": wanted})
        assert suit.traffic.device(0).settings["label"] == ""
        assert noted(journal) == {}


async def test_a_separation_of_ids_is_taken_back(operated):
    async with operated(stored_ids={2: 1}) as (suit, operations, journal):
        assert (await operations.perform("list", {"listen_s": 0.5}))["conflicts"]
        (change,) = (await operations.perform("separate", {}))["changes"]
        assert bytes.fromhex(change["unique_id"]) in {suit.unique_id(1), suit.unique_id(2)}
        done = await operations.perform("undo", {})
        assert [each["after"] for each in done["changes"]] == [{"module_id": 1}]
        assert len((await operations.perform("list", {"listen_s": 0.5}))["conflicts"]) == 1
        assert noted(journal) == {}


async def test_an_undo_that_one_module_refuses_can_be_asked_for_again(operated):
    async with operated() as (suit, operations, journal):
        ids = {suit.unique_id(n).hex(): n + 10 for n in range(3)}
        await operations.perform("assign", {"ids": ids})
        suit.traffic.device(1).is_locked = True
        done = await operations.perform("undo", {})
        one = suit.unique_id(1)
        assert one.hex() in done["failures"]
        assert suit.ids()[1] == 11
        assert set(noted(journal)) == {bytes.fromhex(uid) for uid in done["failures"]}
        suit.traffic.device(1).is_locked = False
        done = await operations.perform("undo", {})
        assert done["failures"] == {}
        assert suit.ids() == {n: n for n in range(4)}
        assert noted(journal) == {}


async def test_a_module_that_falls_silent_while_written_is_kept_for_undo(operated):
    async with operated() as (suit, operations, journal):
        suit.traffic.device(2).power_cut = PowerCut(Verb.COMMIT, off_s=600.0)
        with pytest.raises(DeviceError, match=r"does not answer.*or perhaps"):
            await operations.perform("set", {"device": "2", "settings": {"label": "two"}})
        assert noted(journal) == {suit.unique_id(2): {"label": ""}}
        done = await operations.perform("undo", {})
        assert done["absent"] == [suit.unique_id(2).hex()]
        assert noted(journal) == {suit.unique_id(2): {"label": ""}}


async def test_what_changes_nothing_is_no_change_to_take_back(operated):
    async with operated() as (suit, operations, _):
        await operations.perform("set", {"device": "1", "settings": {"label": "one"}})
        await operations.perform("set", {"device": "1", "settings": {"label": "one"}})
        await operations.perform("undo", {})
        assert suit.traffic.device(1).settings["label"] == ""


@pytest.mark.parametrize(
    ("verb", "data"),
    [
        ("set", {"device": "1", "settings": {"label": "one"}}),
        ("assign", {"ids": {"{1}": 9}}),
        ("restore", {"modules": {"{1}": {"label": "one"}}}),
    ],
)
async def test_nothing_is_written_to_a_module_when_the_disk_is_full(operated, monkeypatch, verb, data):
    def full(_descriptor):
        raise OSError(errno.ENOSPC, "No space left on device")

    async with operated() as (suit, operations, journal):
        data = {
            key: {uid.format("", suit.unique_id(1).hex()): value for uid, value in part.items()}
            if isinstance(part, dict)
            else part
            for key, part in data.items()
        }
        with monkeypatch.context() as patch:
            patch.setattr(os, "fsync", full)
            with pytest.raises(JournalError, match="nothing was changed"):
                await operations.perform(verb, data)
        assert suit.ids() == {n: n for n in range(4)}
        assert suit.traffic.device(1).settings["label"] == ""
        await operations.perform(verb, data)  # there is room again
        assert noted(journal)


async def test_nothing_is_journaled_where_writing_is_not_allowed(operated):
    async with operated(allow_writes=False) as (suit, operations, journal):
        uid = suit.unique_id(1).hex()
        for verb, data in {
            "set": {"device": "1", "settings": {"label": "one"}},
            "assign": {"ids": {uid: 9}},
            "restore": {"modules": {uid: {"label": "one"}}},
        }.items():
            with pytest.raises(WritesLockedError):
                await operations.perform(verb, data)
        assert noted(journal) == {}
