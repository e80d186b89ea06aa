"""Settings of other makers' modules: what a write that fails half-way says of what stands there."""

from __future__ import annotations

import asyncio
from types import SimpleNamespace

import pytest

from devices.commands.device_errors import DeviceError, NoAnswerError, UnfinishedError
from devices.emulators.makers.mti import MtiEmulator
from devices.emulators.makers.witmotion import WitMotionCanEmulator, WitMotionEmulator
from devices.emulators.makers.ximu3 import Ximu3Emulator
from devices.link import Chunk
from devices.vendor_protocols.mti import MtiDecoder
from devices.vendor_protocols.witmotion import IDENTIFIER, WitMotionCanDecoder, WitMotionDecoder
from devices.vendor_protocols.ximu3 import Ximu3Decoder
from firmware_protocol import CanFrame, pack_can_records
from gateway.body.rig import load_rig
from gateway.modules import makers
from gateway.modules.makers import MakersLine, MakersModule, changed
from gateway.sources.makers import Description
from gateway.sources.module_table import ModuleTable
from gateway.sources.mti import MtiCommands
from gateway.sources.source import SourceContext
from gateway.sources.witmotion import WitMotionCanCommands, WitMotionCommands, WitMotionSource
from gateway.sources.ximu3 import Ximu3Commands

DEVICE = SimpleNamespace(adopt=lambda _settings: None, blink=lambda _seconds: None)
"""What an emulator needs of the emulated module beside it."""


class Wire:
    """A way to one emulated device, which somebody unplugs after so many commands."""

    module = 3
    device = None

    def __init__(self, emulator, decoder, framed=lambda command: command):
        self.emulator, self._decoder, self._framed = emulator, decoder, framed
        self.commands_left = 10**6
        self.is_deaf_to = lambda _command: False

    async def send(self, data):
        self._said(data)

    async def request(self, data, meant, what):
        found = next((told for message in self._said(data) if (told := meant(message)) is not None), None)
        if found is None:
            raise NoAnswerError(f"the device does not answer '{what}'")
        return found

    def _said(self, data):
        self.commands_left -= 1
        if self.commands_left < 0 or self.is_deaf_to(data):
            return []
        return self._decoder.feed(self.emulator.receive(self._framed(data), DEVICE))


def module(wire, commands):
    return MakersModule(3, "link", Description("00"), wire, commands)


@pytest.fixture
def witmotion():
    return module(Wire(WitMotionEmulator(3), WitMotionDecoder()), WitMotionCommands())


@pytest.fixture
def witmotion_can():
    def framed(command):
        return pack_can_records([CanFrame(IDENTIFIER, command, is_extended=False)])

    wire = Wire(WitMotionCanEmulator(3), WitMotionCanDecoder(IDENTIFIER), framed)
    return module(wire, WitMotionCanCommands())


@pytest.fixture
def ximu3():
    return module(Wire(Ximu3Emulator(3), Ximu3Decoder()), Ximu3Commands())


@pytest.fixture
def mti():
    return module(Wire(MtiEmulator(3), MtiDecoder()), MtiCommands())


async def test_what_is_written_is_told_with_what_stood_there(witmotion, ximu3, mti):
    assert await changed(witmotion, {"rate": 50, "baud": 9600}) == (
        {"rate": 100, "baud": 115200},
        {"rate": 50, "baud": 9600},
    )
    divisor = "inertial_message_rate_divisor"
    assert await changed(ximu3, {divisor: 2}) == ({divisor: 4}, {divisor: 2})
    assert await changed(mti, {"acceleration": 50}) == ({"acceleration": 100}, {"acceleration": 50})


async def test_a_value_that_is_refused_before_anything_is_written_is_all_that_is_told(witmotion, mti):
    with pytest.raises(DeviceError, match=r"^rate=77: can be 0\.2, .* 200$"):
        await changed(witmotion, {"content": "acceleration", "rate": 77})
    with pytest.raises(DeviceError, match=r"^an MTi sends no 'colour'"):
        await changed(mti, {"acceleration": 50, "colour": 1})
    assert (await mti.commands.read(mti.line))["acceleration"] == 100


async def test_of_several_settings_those_written_before_one_was_refused_are_told(ximu3):
    divisor = "inertial_message_rate_divisor"
    with pytest.raises(UnfinishedError) as told:
        await changed(ximu3, {divisor: 2, "binary_mode_enabled": False, "nonsense": 1})
    said = str(told.value)
    assert "the device refuses 'nonsense': Unknown command" in said
    assert f"written all the same: {divisor}=2 binary_mode_enabled=false" in said
    back = f"mocap-gateway modules set 3 {divisor}=4 binary_mode_enabled=true --allow-writes"
    assert f"`{back}` takes that back" in said
    await changed(ximu3, {divisor: 4, "binary_mode_enabled": True})  # as it says
    assert ximu3.line.emulator.settings[divisor] == 4


async def test_a_device_that_falls_silent_in_the_middle_leaves_what_stood_there_before(witmotion):
    witmotion.line.commands_left = 8 + 4  # after its registers were read, and some of it was written
    with pytest.raises(UnfinishedError) as told:
        await changed(witmotion, {"rate": 50, "content": ["acceleration"]})
    said = str(told.value)
    assert "whether any of it was written is not known" in said
    assert "`mocap-gateway modules show 3` tells" in said
    assert "before, it was rate=100 content=acceleration,angular_rate,field" in said


async def test_a_line_that_falls_silent_once_leaves_what_was_written_and_how_to_go_back(witmotion):
    """Its answer to the read-back was lost; the registers are as they were written, and not kept."""
    lost = iter([True])
    reads = iter(range(100))
    witmotion.line.is_deaf_to = lambda data: data[2] == 0x27 and next(reads) == 8 and next(lost, False)
    with pytest.raises(
        UnfinishedError, match=r"written all the same: rate=50; `mocap-gateway modules set 3 "
    ):
        await changed(witmotion, {"rate": 50})


async def test_another_rate_of_the_line_after_which_it_is_not_heard_says_what_to_put(witmotion):
    moved = []
    witmotion.line.is_deaf_to = lambda data: moved or (data[2] == 0x04 and moved.append(1))
    with pytest.raises(UnfinishedError, match=r"^baud=9600 is written, and the device is not heard since: "):
        await changed(witmotion, {"baud": 9600, "rate": 50})
    assert witmotion.line.emulator.registers[0x03] == 8  # the rest of it came before


async def test_on_can_the_rate_of_the_bus_has_numbers_of_its_own(witmotion_can):
    before, after = await changed(witmotion_can, {"baud": 500_000})
    assert (before, after) == ({"baud": 250_000}, {"baud": 500_000})
    assert witmotion_can.line.emulator.registers[0x04] == 2
    with pytest.raises(DeviceError, match="baud=115200: can be 1000000, 800000, "):
        await changed(witmotion_can, {"baud": 115_200})


async def test_on_can_another_identifier_is_written_and_the_link_is_told_of(witmotion_can):
    with pytest.raises(UnfinishedError, match=r"address=81 is written.*put that identifier at the link"):
        await changed(witmotion_can, {"address": 0x51})
    assert witmotion_can.line.emulator.registers[0x1A] == 0x51


def test_a_bus_is_not_taken_for_a_slow_serial_line(witmotion_can):
    settings = {"content": ["acceleration", "angular_rate", "field"], "rate": 100, "baud": 250_000}
    assert not list(witmotion_can.commands.advice(3, settings, 100.0))
    (told,) = witmotion_can.commands.advice(3, settings | {"rate": 200, "baud": 50_000}, 100.0)
    assert told.found == "3 packets × 200 Hz take 162% of 50,000 bit/s: some are never sent"


async def test_an_mti_that_is_left_in_configuration_mode_is_told(mti):
    mti.line.commands_left = 5  # configuration mode, three reads; then it is unplugged
    with pytest.raises(UnfinishedError, match="it may still be in its configuration mode"):
        await changed(mti, {"acceleration": 50})


class LateLink:
    """A link whose device answers so late that every question is asked again."""

    name = "link"

    def __init__(self, source, emulator):
        self._source, self._emulator = source, emulator

    async def write(self, data, to=()):
        said = self._emulator.receive(data, DEVICE)
        if said:
            asyncio.get_running_loop().call_later(0.03, self._say, said)

    def _say(self, said):
        self._source.receive(Chunk(said, 10**18, self.name))


async def test_answers_to_a_question_that_was_repeated_are_not_taken_for_those_to_the_next(monkeypatch):
    monkeypatch.setattr(makers, "_ANSWER_S", 0.02)
    source = WitMotionSource(SourceContext(load_rig("arm_3"), ModuleTable()))
    source.add_link("link", "witmotion")
    line = MakersLine(LateLink(source, WitMotionEmulator(0)), source, 0, lambda _sent: None)
    expected = await WitMotionCommands().read(Wire(WitMotionEmulator(0), WitMotionDecoder()))
    assert await WitMotionCommands().read(line) == expected
