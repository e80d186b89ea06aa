"""Devices that lose their power, and what they are when they have it back."""

from __future__ import annotations

import itertools

import pytest

from devices.emulators.device.emulated_flash import Moment, PowerCut
from devices.emulators.imperfections import Imperfections
from firmware_protocol import DeviceInfo, Event, Health, InertialSample
from firmware_protocol.commands import Result, Verb

FROM_FACTORY = 8


def test_a_module_restarts_its_clock_and_its_counts(arm_host):
    host = arm_host(Imperfections(has_random_clock_start=True, clock_skew_ppm=50.0))
    host.traffic.cut_power(1, 2.0, off_s=0.4)
    host.listen(5.0)
    before = [p for p in host.of(InertialSample, 1) if host.arrived_s[host.packets.index(p)] < 2.0]
    after = host.of(InertialSample, 1)[len(before) :]
    assert len(before) == pytest.approx(200, abs=1)
    assert host.arrived_s[host.packets.index(after[0])] == pytest.approx(2.4, abs=0.01)
    assert after[0].module_time_us < 10_000
    assert [p.sequence for p in after] == list(range(len(after)))
    assert len(after) == pytest.approx(260, abs=1)
    infos = [host.arrived_s[host.packets.index(p)] for p in host.of(DeviceInfo, 1)]
    assert infos == pytest.approx([0.0, 2.4])
    healths = host.of(Health, 1)
    assert [h.packet.resets for h in healths] == [0, 0, 1, 1, 1][: len(healths)]
    assert healths[-1].packet.uptime_s == 1
    assert not host.of(Event)
    assert len(host.of(InertialSample, 2)) == pytest.approx(500, abs=1)


def test_a_device_without_power_hears_nothing_and_forgets_what_was_staged(arm_host):
    host = arm_host()
    host.write("label", "x", module=1)
    host.traffic.cut_power(1, host.now_s, off_s=0.5)
    assert host.tell(Verb.HELLO, 1, 1, module=1) == []
    host.listen(1.0)
    assert host.ask(Verb.COMMIT, module=1).result == Result.NOTHING_STAGED
    assert host.traffic.device(1).boots == 2


def test_answers_under_way_are_lost_with_the_power(arm_host):
    host = arm_host(stored_ids={1: 60})
    command = host.command(Verb.HELLO, 1, 1)
    host.send(command, 0xFF, at_s=0.1)
    host.traffic.cut_power(1, 0.15)
    assert len(host.answers(command, host.listen(1.0))) == 3  # it was its turn at 0.22 s


@pytest.mark.parametrize(
    ("moment", "step", "boots_as"),
    [
        (Moment.BEFORE, 0, 1),
        (Moment.IN_FLASH, 0, 1),
        (Moment.IN_FLASH, 100, 1),
        (Moment.AFTER, 0, 30),
    ],
)
def test_a_module_that_reboots_in_the_middle_of_an_assignment(arm_host, moment, step, boots_as):
    host = arm_host()
    device = host.traffic.device(1)
    device.power_cut = PowerCut(Verb.COMMIT, moment=moment, flash_step=step)
    host.write("module_id", 30, module=1)
    commit = host.command(Verb.COMMIT)
    host.send(commit, 1)
    assert host.answers(commit, host.listen(0.2)) == []
    assert not device.is_on
    host.listen(1.0)
    assert device.module_id == boots_as
    (answer,) = host.tell(Verb.HELLO, 1, 1, unique_id=device.unique_id)
    assert answer.result == Result.DONE
    host.write("module_id", 31, unique_id=device.unique_id)  # the second try goes well
    assert host.ask(Verb.COMMIT, unique_id=device.unique_id).result == Result.DONE
    assert device.module_id == 31


def test_the_cut_strikes_at_the_chosen_command_once(arm_host):
    host = arm_host()
    host.traffic.device(2).power_cut = PowerCut(Verb.WRITE_SETTING, skips=1, moment=Moment.AFTER)
    assert host.write("label", "a", module=2).result == Result.DONE
    host.ask(Verb.HELLO, 1, 1, module=2)
    command = host.command(Verb.WRITE_SETTING, 10, b"b".ljust(16, b"\x00"))
    host.send(command, 2)
    assert host.answers(command, host.listen(1.0)) == []
    assert host.write("label", "c", module=2).result == Result.DONE


def test_whatever_step_is_cut_a_module_comes_back_old_or_new(arm_host):
    ids = []
    for step in itertools.count(0, 29):
        host = arm_host()
        device = host.traffic.device(1)
        device.power_cut = PowerCut(Verb.COMMIT, moment=Moment.IN_FLASH, flash_step=step, off_s=0.05)
        host.write("module_id", 30, module=1)
        host.send(host.command(Verb.COMMIT), 1)
        host.listen(0.3)
        ids.append(device.module_id)
        assert device.boots == 2
        if device.module_id == 30:
            break
    assert set(ids[:-1]) == {1}
    assert len(ids) > 5


def test_fresh_modules_say_so_at_every_start(arm_host):
    host = arm_host(fresh=frozenset({2, 3}))
    host.traffic.cut_power(3, 0.5)
    host.listen(1.5)
    events = [(p.module, p.packet.event) for p in host.of(Event)]
    assert events == [(0, FROM_FACTORY)] * 3
    assert {p.packet.unique_id for p in host.of(DeviceInfo, 0)} == {
        host.traffic.device(n).unique_id for n in (0, 2, 3)
    }
