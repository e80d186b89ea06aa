"""What emulated devices answer: every verb, every result, who is meant and when it comes."""

from __future__ import annotations

import pytest

from devices.emulators.imperfections import Imperfections
from devices.emulators.motion.motions import walking_motion
from devices.emulators.suit_traffic import SuitTraffic
from firmware_protocol import (
    BROADCAST,
    RELAY,
    Acknowledgement,
    Command,
    DeviceInfo,
    Event,
    Health,
    InertialSample,
    SyncRequest,
    SyncResponse,
    wire_frame,
)
from firmware_protocol.commands import FACTORY_RESET_MAGIC, Result, Verb, decode_payload
from firmware_protocol.device_settings import decode_value, encode_value, factory_settings

MODULE_ID, RATE, LABEL = 1, 2, 10
COMMITTED, FROM_FACTORY = 7, 8


def payload(answer):
    return decode_payload(answer.verb, answer.payload)


@pytest.fixture
def host(arm_host):
    return arm_host()


@pytest.mark.parametrize(
    ("verb", "arguments", "result"),
    [
        (Verb.HELLO, b"\x01\x01", Result.DONE),
        (99, b"", Result.UNKNOWN_VERB),
        (Verb.HELLO, b"\x01", Result.BAD_ARGUMENTS),
        (Verb.IDENTIFY, b"", Result.BAD_ARGUMENTS),
        (Verb.START, b"x", Result.BAD_ARGUMENTS),
        (Verb.READ_SETTING, b"\x63", Result.NO_SUCH_SETTING),
        (Verb.WRITE_SETTING, b"\x63\x01", Result.NO_SUCH_SETTING),
        (Verb.WRITE_SETTING, b"\x01\x40", Result.BAD_ARGUMENTS),  # no module has id 64
        (Verb.WRITE_SETTING, b"\x02\x00", Result.BAD_ARGUMENTS),  # half a number
        (Verb.COMMIT, b"", Result.NOTHING_STAGED),
        (Verb.DISCARD, b"", Result.DONE),
        (Verb.FACTORY_RESET, b"\x00\x00\x00\x00", Result.BAD_ARGUMENTS),
        (Verb.CARD_LIST, b"\x00\x00", Result.NOT_SUPPORTED),
        (Verb.CARD_READ, b"", Result.NOT_SUPPORTED),
        (Verb.CARD_ERASE, b"\xff\xff", Result.NOT_SUPPORTED),
    ],
)
def test_results(host, verb, arguments, result):
    command = Command(7, verb, arguments=arguments)
    host.send(command, 2)
    (answer,) = host.answers(command, host.listen(0.05))
    assert answer.result == result
    assert answer.unique_id == host.traffic.device(2).unique_id
    assert bool(answer.payload) == (verb == Verb.HELLO and result == Result.DONE)


@pytest.mark.parametrize(("asked", "chosen"), [((1, 1), 1), ((1, 9), 1), ((2, 9), 0)])
def test_hello_agrees_on_a_version(host, asked, chosen):
    assert payload(host.ask(Verb.HELLO, *asked, module=1)) == (chosen, 1, 1)


def test_identify_blinks_for_a_while_or_until_told(host):
    device = host.traffic.device(1)
    host.ask(Verb.IDENTIFY, 3, module=1)
    assert device.is_blinking(host.now_s)
    host.listen(2.5)
    assert device.is_blinking(host.now_s)
    host.listen(0.5)
    assert not device.is_blinking(host.now_s)
    host.ask(Verb.IDENTIFY, 200, module=1)
    assert device.is_blinking(host.now_s)
    assert not host.traffic.device(2).is_blinking(host.now_s)
    host.ask(Verb.IDENTIFY, 0, module=1)
    assert not device.is_blinking(host.now_s)


def test_info_and_health_follow_the_answer(host):
    host.listen(0.95)
    command = host.command(Verb.GET_INFO)
    host.send(command, 3)
    heard = [p for p in host.listen(0.03) if p.module == 3 and not isinstance(p.packet, InertialSample)]
    assert [type(p.packet) for p in heard] == [Acknowledgement, DeviceInfo, Health]
    assert heard[1].packet.unique_id == host.traffic.device(3).unique_id
    assert heard[2].packet.samples_taken in (95, 96)


def test_stop_and_start(host):
    host.listen(0.5)
    assert host.ask(Verb.STOP, module=1).result == Result.DONE
    stopped = len(host.of(InertialSample, 1))
    host.listen(1.0)
    assert len(host.of(InertialSample, 1)) == stopped
    assert len(host.of(InertialSample, 0)) > stopped + 100
    host.ask(Verb.START, module=1)
    host.ask(Verb.START, module=1)  # once more changes nothing
    host.listen(1.0)
    samples = host.of(InertialSample, 1)
    assert [s.sequence for s in samples] == list(range(len(samples)))
    assert len(samples) - stopped == pytest.approx(139, abs=2)
    assert host.of(Health, 1)[-1].packet.samples_taken == pytest.approx(len(samples), abs=100)


def test_staged_settings_are_read_back_but_take_effect_on_commit(host):
    before = payload(host.ask(Verb.READ_SETTING, LABEL, module=1))
    assert decode_value(LABEL, before[1]) == ""
    assert decode_value(LABEL, payload(host.write("label", "left shank", module=1))[1]) == "left shank"
    assert host.traffic.device(1).settings["label"] == ""
    answer = payload(host.ask(Verb.READ_SETTING, LABEL, module=1))
    assert decode_value(LABEL, answer[1]) == "left shank"
    host.ask(Verb.DISCARD, module=1)
    assert decode_value(LABEL, payload(host.ask(Verb.READ_SETTING, LABEL, module=1))[1]) == ""
    assert host.ask(Verb.COMMIT, module=1).result == Result.NOTHING_STAGED
    host.write("label", "right shank", module=1)
    generation = payload(host.ask(Verb.COMMIT, module=1))[0]
    host.write("label", "pelvis", module=1)
    assert payload(host.ask(Verb.COMMIT, module=1)) == (generation + 1,)
    assert host.traffic.device(1).settings["label"] == "pelvis"
    assert [e.packet.event for e in host.of(Event, 1)] == [COMMITTED, COMMITTED]


def test_factory_reset(host):
    unique_id = host.traffic.device(3).unique_id
    answer = host.ask(Verb.FACTORY_RESET, FACTORY_RESET_MAGIC, module=3)
    assert (answer.result, answer.unique_id) == (Result.DONE, unique_id)
    device = host.traffic.device(3)
    assert device.module_id == factory_settings()[MODULE_ID]
    assert device.settings["sampling_rate"] == factory_settings()[RATE]


@pytest.mark.parametrize("verb", [v for v in Verb if v not in {Verb.CARD_LIST, Verb.CARD_READ}])
def test_a_locked_device_refuses_what_changes_it(arm_host, verb):
    host = arm_host(has_relay=True)
    for number in (1, RELAY):
        host.traffic.device(number).is_locked = True
    values = {
        Verb.HELLO: (1, 1),
        Verb.IDENTIFY: (1,),
        Verb.READ_SETTING: (1,),
        Verb.WRITE_SETTING: (LABEL, encode_value(LABEL, "x")),
        Verb.FACTORY_RESET: (FACTORY_RESET_MAGIC,),
        Verb.CARD_ERASE: (0xFFFF,),
    }.get(verb, ())
    module = RELAY if verb == Verb.CARD_ERASE else 1
    is_refused = verb in {Verb.WRITE_SETTING, Verb.COMMIT, Verb.FACTORY_RESET, Verb.CARD_ERASE}
    assert (host.ask(verb, *values, module=module).result == Result.REFUSED) == is_refused


def test_a_worn_out_flash_is_told(host):
    host.write("label", "x", module=1)
    host.traffic.device(1).flash.is_worn_out = True
    assert host.ask(Verb.COMMIT, module=1).result == Result.FLASH_FAILED
    assert host.ask(Verb.FACTORY_RESET, FACTORY_RESET_MAGIC, module=1).result == Result.FLASH_FAILED
    assert host.traffic.device(1).module_id == 1


def test_a_repeated_command_is_answered_but_not_obeyed_again(host):
    host.write("label", "one", module=1)
    commit = host.command(Verb.COMMIT)
    host.send(commit, 1)
    (first,) = host.answers(commit, host.listen(0.05))
    host.write("label", "two", module=1)
    host.send(commit, 1)
    (again,) = host.answers(commit, host.listen(0.05))
    assert again == first
    assert host.traffic.device(1).settings["label"] == "one"
    for _ in range(7):
        host.ask(Verb.HELLO, 1, 1, module=1)
    host.send(commit, 1)  # forgotten by now: a new command
    (third,) = host.answers(commit, host.listen(0.05))
    assert payload(third)[0] == payload(first)[0] + 1
    assert host.traffic.device(1).settings["label"] == "two"


def test_the_same_transaction_of_another_verb_is_another_command(host):
    for verb in (Verb.STOP, Verb.START):
        host.send(Command(5, verb), 1)
    verbs = [p.packet.verb for p in host.listen(0.05) if isinstance(p.packet, Acknowledgement)]
    assert verbs == [Verb.STOP, Verb.START]


def test_a_unique_id_names_one_device_whatever_ids_there_are(arm_host):
    host = arm_host(stored_ids={2: 1})  # two modules of id 1
    one, other = (host.traffic.device(n).unique_id for n in (1, 2))
    assert {a.unique_id for a in host.tell(Verb.HELLO, 1, 1, module=1)} == {one, other}
    assert [a.unique_id for a in host.tell(Verb.HELLO, 1, 1, unique_id=other)] == [other]
    assert host.tell(Verb.HELLO, 1, 1, module=1, unique_id=bytes(11) + b"\x01") == []
    host.write("module_id", 2, unique_id=other)
    host.ask(Verb.COMMIT, unique_id=other)
    assert [a.unique_id for a in host.tell(Verb.HELLO, 1, 1, module=1)] == [one]
    assert [a.unique_id for a in host.tell(Verb.HELLO, 1, 1, module=2)] == [other]


def test_on_broadcast_every_device_answers_in_its_turn(human17, host_of):
    host = host_of(SuitTraffic(walking_motion(human17, 1)))
    host.listen(1.0)
    host.send(host.command(Verb.HELLO, 1, 1), BROADCAST)
    host.listen(0.2)
    came = {
        p.module: at - 1.0
        for p, at in zip(host.packets, host.arrived_s, strict=True)
        if isinstance(p.packet, Acknowledgement)
    }
    assert set(came) == {*range(17), 40}
    for module, after_s in came.items():
        assert after_s == pytest.approx(0.002 * module, abs=0.001)


def test_sync_answers_with_the_modules_own_clock(arm_host):
    host = arm_host(Imperfections(clock_skew_ppm=3000.0, has_random_clock_start=True, latency=0.004), seed=3)
    host.listen(2.0)
    clock = host.traffic.senders[2].clock
    host.send(SyncRequest(77, 123), 2)
    host.listen(0.1)
    (response,) = host.of(SyncResponse)
    assert (response.module, response.packet.token) == (2, 77)
    arrived_s = host.arrived_s[host.packets.index(response)]
    received, sent = response.packet.received_us, response.packet.sent_us
    assert received == pytest.approx(clock.count_us(clock.elapsed(2.004)), abs=1)
    assert 0 < (sent - received) % 2**32 < 1000
    assert sent == pytest.approx(clock.count_us(clock.elapsed(arrived_s - 0.004)), abs=1)
    host.send(SyncRequest(78, 0), BROADCAST)
    host.listen(0.1)
    assert sorted(p.module for p in host.of(SyncResponse)) == [0, 1, 2, 2, 3]


def test_a_request_that_comes_late_to_the_computation_is_stamped_as_it_came(host):
    host.listen(1.0)
    host.send(SyncRequest(1, 0), 2, at_s=0.990)
    host.listen(0.05)
    (response,) = host.of(SyncResponse)
    assert response.packet.received_us == 990_000
    assert response.packet.sent_us >= 1_000_000


def test_answers_are_lost_delayed_and_repeated_like_samples(arm_host):
    host = arm_host(Imperfections(loss=0.2, duplication=0.1, latency=0.01, jitter=0.005), seed=4)
    commands = [host.command(Verb.HELLO, 1, 1) for _ in range(300)]
    for command in commands:
        host.send(command, 1)
        host.listen(0.02)
    host.listen(0.5)
    answered = [len(host.answers(command, host.packets)) for command in commands]
    assert 0.5 < sum(n > 0 for n in answered) / 300 < 0.78  # 0.8 there times 0.8 back, but for repetitions
    assert sum(n > 1 for n in answered) > 20
    assert not host.decoder.dropped


def test_damaged_commands_are_counted_and_not_obeyed(host):
    frame = host.traffic.settings.encoding.encode
    data = bytearray(frame(wire_frame(host.command(Verb.STOP), 1, 0, 0)))
    data[8] ^= 0x55
    host.traffic.receive(bytes(data), 0.0)
    host.traffic.receive(frame(wire_frame(InertialSample(specific_force=(0.0, 0.0, 1.0)), 1, 0, 0)), 0.0)
    host.listen(0.3)
    assert sum(host.traffic.from_host.decoder.dropped.values()) == 1
    assert len(host.of(InertialSample, 1)) == 30


def test_the_same_conversation_is_the_same_however_time_is_cut(arm_host):
    def talk(step_s):
        host = arm_host(Imperfections(loss=0.05, jitter=0.002, latency=0.002), seed=9)
        for at_s, verb in ((0.1234, Verb.GET_INFO), (0.31, Verb.STOP), (0.777, Verb.START)):
            host.send(Command(round(1e3 * at_s), verb), BROADCAST, at_s)
        host.traffic.shake(1, 0.9, 1.0)
        host._step_s = step_s
        host.listen(2.0)
        return host.packets, host.arrived_s

    packets, arrived_s = talk(0.005)
    again, again_s = talk(1.0)
    assert packets == again
    assert arrived_s == pytest.approx(again_s, abs=1e-9)
