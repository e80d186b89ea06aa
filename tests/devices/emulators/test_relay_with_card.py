"""A relay that records: everything it gathers, whether or not the host receives it."""

from __future__ import annotations

import itertools
from dataclasses import replace
from zlib import crc32

import pytest

from devices.emulators.device.emulated_card import EmulatedCard
from devices.emulators.imperfections import Imperfections
from firmware_protocol import (
    BROADCAST,
    RELAY,
    Acknowledgement,
    Command,
    FrameDecoder,
    InertialSample,
    LogLine,
    PacketDecoder,
)
from firmware_protocol.commands import ALL_FILES, MAX_CARD_READ, Result, Verb, decode_payload


@pytest.fixture
def host(arm_host):
    return arm_host(has_relay=True)


def card_list(host, first=0):
    return decode_payload(Verb.CARD_LIST, host.ask(Verb.CARD_LIST, first, module=RELAY).payload)


def fetch(host, file):
    content = b""
    while True:
        answer = host.ask(Verb.CARD_READ, file, len(content), MAX_CARD_READ, module=RELAY)
        of_file, offset, data = decode_payload(Verb.CARD_READ, answer.payload)
        assert (of_file, offset) == (file, len(content))
        if not data:
            return content
        content += data


def test_a_file_holds_what_was_heard_between_start_and_stop(host):
    host.send(Command(1, Verb.START), RELAY, 1.0)
    host.send(Command(2, Verb.STOP), RELAY, 1.2)
    host.listen(2.0)
    total, ((file, size, start_us, checksum),) = card_list(host)
    assert (total, file, start_us) == (1, 1, 1_000_000)
    host._step_s = 0.2
    content = fetch(host, 1)
    assert (len(content), crc32(content)) == (size, checksum)
    decoder = PacketDecoder(FrameDecoder())
    kept = decoder.feed(content)
    assert not decoder.dropped
    assert kept == sorted(kept, key=lambda p: p.module_time_us)
    during = [p for p in host.packets if 1_000_000 <= p.module_time_us < 1_200_000]
    heard = [replace(p, relayed_us=None) for p in during if p.module != RELAY]
    assert sorted(kept, key=str) == sorted(heard, key=str)


def test_recording_goes_on_while_the_host_is_out_of_range(host):
    host.traffic.lose_host(1.0, 2.0)
    host.send(Command(1, Verb.START), RELAY, 0.5)
    host.send(Command(2, Verb.STOP), RELAY, 1.5)  # never arrives
    host.listen(3.0)
    assert host.answers(Command(2, Verb.STOP), host.packets) == []
    heard = [p.module_time_us for p in host.of(InertialSample, 1)]
    assert max(b - a for a, b in itertools.pairwise(heard)) == pytest.approx(1e6, abs=2e4)
    host.ask(Verb.STOP, module=RELAY)
    content = host.traffic.device(RELAY).card.read(1, 0, 10**9)
    kept = [
        p.module_time_us
        for p in PacketDecoder(FrameDecoder()).feed(content)
        if p.module == 1 and isinstance(p.packet, InertialSample)
    ]
    assert kept == list(range(500_000, kept[-1] + 1, 10_000))
    assert kept[-1] >= 2_990_000


def test_files_are_listed_as_they_fit_and_erased(host):
    for _ in range(20):
        host.ask(Verb.START, module=RELAY)
    host.ask(Verb.STOP, module=RELAY)
    total, entries = card_list(host)
    assert total == 20
    listed = list(entries)
    assert len(listed) < 20
    while len(listed) < total:
        listed += card_list(host, len(listed))[1]
    assert [entry[0] for entry in listed] == list(range(1, 21))
    assert card_list(host, 25) == (20, ())
    assert host.ask(Verb.CARD_ERASE, 3, module=RELAY).result == Result.DONE
    assert [entry[0] for entry in card_list(host)[1]][:3] == [1, 2, 4]
    assert host.ask(Verb.CARD_ERASE, ALL_FILES, module=RELAY).result == Result.DONE
    assert card_list(host) == (0, ())


def test_what_a_card_refuses(host):
    host.ask(Verb.START, module=RELAY)
    (file,) = [entry[0] for entry in card_list(host)[1]]
    size = host.traffic.device(RELAY).card.entries()[0].size
    for verb, values, result in (
        (Verb.CARD_READ, (9, 0, 10), Result.NO_SUCH_FILE),
        (Verb.CARD_READ, (file, size + 10**6, 10), Result.BAD_ARGUMENTS),
        (Verb.CARD_ERASE, (9,), Result.NO_SUCH_FILE),
        (Verb.CARD_ERASE, (file,), Result.BUSY),
        (Verb.CARD_ERASE, (ALL_FILES,), Result.BUSY),
        (Verb.WRITE_SETTING, (1, b"\x05"), Result.NOT_SUPPORTED),  # a relay's id is fixed
    ):
        assert host.ask(verb, *values, module=RELAY).result == result
    assert host.ask(Verb.STOP, module=RELAY).result == Result.DONE
    assert host.ask(Verb.CARD_ERASE, file, module=RELAY).result == Result.DONE


def test_a_full_card_is_told_once(host):
    host.traffic.device(RELAY).card = EmulatedCard(capacity=2000)
    host.ask(Verb.START, module=RELAY)
    host.listen(1.0)
    assert [p.module for p in host.of(LogLine)] == [RELAY]
    assert host.traffic.device(RELAY).card.recording is None


def test_without_a_card_nothing_is_recorded(arm_host):
    host = arm_host(has_relay=True, has_card=False)
    assert host.ask(Verb.START, module=RELAY).result == Result.DONE
    assert host.ask(Verb.CARD_LIST, 0, module=RELAY).result == Result.NOT_SUPPORTED


def test_a_broadcast_reaches_modules_and_relay_and_answers_do_not_wait_for_a_batch(host):
    host.listen(1.0)
    command = host.command(Verb.HELLO, 1, 1)
    host.send(command, BROADCAST)
    assert len(host.answers(command, host.listen(1.0))) == 5
    for received, at_s in zip(host.packets, host.arrived_s, strict=True):
        if isinstance(received.packet, Acknowledgement) and received.module != RELAY:
            assert at_s == pytest.approx(1.0 + 0.002 * received.module, abs=0.001)


def test_a_relay_that_loses_power_loses_what_it_gathers_but_no_file(arm_host):
    host = arm_host(Imperfections(has_random_clock_start=True), has_relay=True)
    host.ask(Verb.START, module=RELAY)
    host.traffic.cut_power(RELAY, 1.0, off_s=0.5)
    host.listen(2.0)
    times = [p.module_time_us for p in host.of(InertialSample, 1)]
    gaps = [(b - a) % 2**32 for a, b in itertools.pairwise(times)]
    assert max(gaps) == pytest.approx(5e5, abs=2e4)
    assert sorted(gaps)[-2] == 10_000
    card = host.traffic.device(RELAY).card
    assert card.recording is None
    assert card.entries()[0].size > 1000
