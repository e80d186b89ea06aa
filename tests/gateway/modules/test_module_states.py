"""What is published of each module, and when."""

import numpy as np
import pytest

from devices.link import Chunk, Framing
from firmware_protocol import DeviceInfo, Health, InertialSample, wire_frame
from firmware_protocol.framing import encode_frame
from gateway.body.rig import load_rig
from gateway.contract.messages import ModuleAvailability, ModuleState
from gateway.modules.summary import ModuleStates
from gateway.sources.suit import SuitSource

SECOND_NS = 10**9
SAMPLE = InertialSample((0.0, 0.0, 9.8), (0.0, 0.0, 0.0), (20.0, 0.0, -40.0))
INFO = DeviceInfo(bytes(range(12)), (2, 1), (1, 4, 12), 156.9, 34.9, None, 100.0, 100.0, None)
HEALTH = Health(81, 3.9, 31.25, -57, 100, 200, 0, 0, 3)


class Suit:
    """Modules that send at 100 Hz, and their states looked at four times a second."""

    def __init__(self, **params):
        self.stream = SuitSource()
        self.stream.add_link("suit", Framing.BYTE_STREAM)
        timing = {"silent_after_ns": 2 * SECOND_NS, "interval_ns": 5 * SECOND_NS} | params
        self.states = ModuleStates(self.stream, load_rig("robot_arm_4"), **timing)
        self.now_ns = 7 * SECOND_NS
        self.sequence = 0
        self.said = []

    def send(self, packet, module, sequence=None):
        number = self.sequence if sequence is None else sequence
        frame = wire_frame(packet, module, number % 65536, self.now_ns // 1000 % 2**32)
        self.stream.receive(Chunk(encode_frame(frame), self.now_ns, "suit"))

    def run(self, seconds, modules=(0, 1, 2, 3)):
        """All that is said meanwhile."""
        said = []
        for n in range(round(seconds * 100)):
            for module in modules:
                self.send(SAMPLE, module)
            self.sequence += 1
            self.now_ns += SECOND_NS // 100
            if n % 25 == 24:
                said += self.states.look(self.now_ns)
        return said


def availability(said):
    return [
        (topic.split("/")[1], message.state)
        for topic, message in said
        if isinstance(message, ModuleAvailability)
    ]


def states_of(said, module):
    return [m for _, m in said if isinstance(m, ModuleState) and m.module == module]


def test_every_module_comes_online_once_and_is_told_of_at_most_so_often():
    suit = Suit()
    said = suit.run(20)
    assert availability(said) == [("0", "online"), ("1", "online"), ("2", "online"), ("3", "online")]
    told = states_of(said, 2)
    assert len(told) == 4
    assert np.diff([m.t_ns for m in told]).min() >= 5 * SECOND_NS
    assert (told[-1].segment, told[-1].availability, told[-1].rate_hz) == ("link_3", "online", 100.0)
    assert told[0].clock.state == "measuring"
    assert told[0].clock.ppm is None
    assert told[-1].clock.state == "settled"
    assert told[-1].clock.ppm == pytest.approx(0, abs=5)


def test_silence_and_return_are_told_at_once_whatever_the_interval():
    suit = Suit(interval_ns=3600 * SECOND_NS)
    suit.run(1)
    last_ns = suit.stream.modules[1].last_arrival_ns
    said = suit.run(2.5, modules=(0, 2, 3))
    assert availability(said) == [("1", "offline")]
    (silent,) = states_of(said, 1)
    assert silent.silent_since_ns == silent.last_arrival_ns == last_ns
    assert silent.t_ns - last_ns <= 2.3 * SECOND_NS
    back = suit.run(0.25)
    assert availability(back) == [("1", "online")]
    assert states_of(back, 1)[0].silent_since_ns is None


def test_a_module_of_the_rig_that_was_never_heard_is_offline_after_a_while():
    suit = Suit()
    assert availability(suit.run(1, modules=(0, 1, 2))) == [("0", "online"), ("1", "online"), ("2", "online")]
    said = suit.run(2, modules=(0, 1, 2))
    assert availability(said) == [("3", "offline")]
    (never,) = states_of(said, 3)
    assert (never.received, never.clock, never.last_arrival_ns, never.rate_hz) == (0, None, None, None)


def test_a_module_that_the_rig_does_not_name_is_told_of_too():
    suit = Suit()
    said = suit.run(1, modules=(0, 9))
    assert states_of(said, 9)[0].segment is None


def test_counts_and_what_the_module_says_of_itself():
    suit = Suit(late={1: 4})
    suit.run(1)
    suit.sequence += 3  # lost in a row
    suit.run(1)
    suit.send(SAMPLE, 1, sequence=suit.sequence - 1)
    suit.send(HEALTH, 1, sequence=0)
    suit.send(INFO, 1, sequence=0)
    state = suit.states.state(1, suit.now_ns)
    assert (state.lost, state.gaps, state.duplicates, state.late, state.resets) == (3, {"3-4": 1}, 1, 4, 0)
    assert (state.battery_percent, state.temperature_celsius, state.rssi_dbm) == (81, 31.25, -57)
    assert (state.unique_id, state.firmware) == ("000102030405060708090a0b", "1.4.12")


def test_nothing_new_is_not_said_again():
    suit = Suit(interval_ns=SECOND_NS)
    suit.run(1)
    suit.run(4, modules=())
    assert suit.run(10, modules=()) == []


def test_at_the_end_all_are_offline():
    suit = Suit()
    suit.run(1)
    said = list(suit.states.farewell(suit.now_ns))
    assert availability(said) == [(str(module), "offline") for module in range(4)]
    assert {m.availability for _, m in said if isinstance(m, ModuleState)} == {"offline"}
    topics = [topic for topic, _ in said]
    assert topics[:2] == ["module/0/availability", "module/0/state"]


def test_a_new_doubt_is_told_at_once_and_so_is_its_end():
    doubts = {}
    suit = Suit(doubts=lambda: doubts)
    assert states_of(suit.run(3), 2)[-1].doubt is None
    doubts[2] = "worn upside down: turn it"
    assert [m.doubt for m in states_of(suit.run(0.5), 2)] == ["worn upside down: turn it"]
    doubts.clear()
    assert [m.doubt for m in states_of(suit.run(0.5), 2)] == [None]


def test_a_clock_that_begins_anew_again_and_again_is_a_reason_for_doubt_until_it_stops():
    suit = Suit()
    suit.run(3)
    record = suit.stream.modules[1]
    for k in range(4):
        for _ in range(60):  # a jump is believed when it lasts
            suit.now_ns += SECOND_NS // 100
            suit.sequence += 1
            stamp = (k * 10**9 + suit.now_ns // 1000) % 2**32
            frame = wire_frame(SAMPLE, 1, suit.sequence % 65536, stamp)
            suit.stream.receive(Chunk(encode_frame(frame), suit.now_ns, "suit"))
    assert record.clock.restarts >= 3
    assert "began its clock anew" in record.restlessness
    for _ in range(1100):
        suit.now_ns += SECOND_NS // 100
        suit.sequence += 1
        frame = wire_frame(SAMPLE, 1, suit.sequence % 65536, (3 * 10**9 + suit.now_ns // 1000) % 2**32)
        suit.stream.receive(Chunk(encode_frame(frame), suit.now_ns, "suit"))
    assert record.restlessness is None
