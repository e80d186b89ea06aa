"""Who is listed: those that answer, and those that only send, by the unique id they tell of themselves."""

from __future__ import annotations

import asyncio
import io
import re

import pytest
from rich.console import Console

from devices.commands.roster import Roster
from devices.emulators import SuitSettings, SuitTraffic
from devices.link import Chunk, Framing
from firmware_protocol import RELAY
from gateway.body.rig import load_rig
from gateway.cli.modules_suit import WIDEST, modules_screen
from gateway.emulation.rig import dress, move
from gateway.modules.summary import count_samples, summarise
from gateway.sources.suit import SuitSource
from tests.patience import PATIENCE_S


async def test_one_that_answers_no_commands_is_listed_by_what_it_says_of_itself(operated):
    # The description comes after the time for measuring rates: it is waited for.
    async with operated(info_interval_s=2.0) as (suit, operations, _):
        suit.traffic.device(2).receive = lambda *_: None

        answering = 0
        async with asyncio.timeout(PATIENCE_S):
            # One that a busy machine kept from answering in time is no matter of this test.
            while answering != 3:
                listed = await operations.perform("list", {"listen_s": 0.5})
                answering = sum(module["answers"] for module in listed["modules"])
    modules = {module["module"]: module for module in listed["modules"]}
    assert [modules[n]["answers"] for n in range(4)] == [True, True, False, True]
    assert [modules[n]["unique_id"] for n in range(4)] == [suit.unique_id(n).hex() for n in range(4)]
    assert modules[2]["firmware"] == "1.0.0"


def test_rates_are_those_between_two_counts():
    suit, stream, counted = load_rig("robot_arm_4"), SuitSource(), []
    traffic = SuitTraffic(move(dress(suit), suit.skeleton.name, 1), SuitSettings(sampling_rate_hz=50.0))
    stream.add_link("suit", Framing.BYTE_STREAM)
    sent = list(traffic.transmissions(3.0))
    for from_s, to_s in ((0.0, 1.0), (1.0, 3.0)):
        for each in sent:
            if from_s <= each.time_s < to_s:
                stream.receive(Chunk(each.data, round(each.time_s * 1e9), "suit"))
        counted.append(count_samples(stream, round(to_s * 1e9)))
    found = summarise(Roster(()), stream, suit, *counted)
    assert {each.module: each.rate_hz for each in found.modules} == pytest.approx(
        dict.fromkeys(range(4), 50.0), abs=0.5
    )


def listed(n=17):
    clock = {"state": "settled", "ppm": -12.3, "residual_us": 250.0, "offset_ns": 1_795_384_855_015_205_000}
    module = {
        "answers": True,
        "firmware": "10.11.12",
        "battery_percent": 100,
        "rate_hz": 1000.0,
        "loss_percent": 12.34,
        "clock": clock,
        "resets": 12,
        "gaps": {"1": 123, "2-3": 45},
    }
    names = ["pelvis", "right_upper_arm", "right_shoulder_girdle", None]
    modules = [
        module | {"module": k, "unique_id": f"{k:024x}", "segment": names[k % len(names)]} for k in range(n)
    ]
    modules += [module | {"module": RELAY, "unique_id": "f" * 24, "segment": None}]
    modules += [
        module | {"module": 60, "unique_id": None, "segment": "pelvis (air_velocity)", "answers": False}
    ]
    return {"modules": modules, "conflicts": [], "segments": {"pelvis": 0, "head": 40}}


def lines_of(width, is_wide=False):
    console = Console(width=width, file=io.StringIO())
    console.print(modules_screen(listed(), is_wide))
    return console.file.getvalue().splitlines()


@pytest.mark.parametrize("width", [80, 100])
def test_what_people_look_for_stands_on_80_columns_whole(width):
    lines = lines_of(width)
    assert max(map(len, lines)) <= width
    for k in range(17):
        (line,) = [line for line in lines if f"{k:024x}" in line]
        assert re.match(rf" *{k} ", line)
        for value in ("100 %", " 1000 ", "12.34"):
            assert value in line
    assert any("right_shoulder_girdle" in line for line in lines)
    assert any("does not answer" in line for line in lines)
    assert any("no answer to commands: 60" in line for line in lines)


def test_the_rest_is_there_when_wide():
    lines = lines_of(WIDEST, is_wide=True)
    assert max(map(len, lines)) <= WIDEST
    (line,) = [line for line in lines if f"{3:024x}" in line]
    for value in ("not in the rig", "10.11.12", "1:123 2-3:45", "-12.3", "250", "1795384855.015205"):
        assert value in line
