"""The relay unit: modules of several lines on one, commands and time requests through it."""

from __future__ import annotations

import asyncio
import json
from collections import Counter, defaultdict

import pytest

from devices.commands.card import Card, download
from devices.commands.command_client import CommandClient
from devices.commands.configure import Configurator
from devices.conformance import RuleOutcome, check_module
from devices.conformance.bench import Bench, steps
from devices.endpoints import link_from_url
from firmware_protocol import RELAY as RELAY_ID
from firmware_protocol import FrameDecoder, Health, InertialSample, PacketDecoder
from firmware_protocol.commands import Verb
from tests.firmware.machines import POSIX, RELAY, Machine
from tests.patience import PATIENCE_S

pytestmark = [pytest.mark.system, pytest.mark.timeout(200)]

MODULES = (1, 2, 3)
RULES = (
    *("hello", "get_info", "unknown_verb", "read_settings", "stop_and_start", "repeated_command"),
    *("by_module_id", "by_unique_id", "time_request", "time_reported_truly", "time_request_to_all"),
    *("staged", "limits", "commit", "triggers"),
)


@pytest.fixture
def relay(module) -> Machine:
    """A relay and three modules behind it."""
    behind = [module(POSIX, number, settings={"module_id": number}) for number in MODULES]
    relay = module(RELAY, 99, is_on=False)
    relay.environment["RELAY_PORTS"] = ":".join(str(each.link) for each in behind)
    relay.environment["RELAY_CARD"] = str(relay.memory.path.with_suffix(".card"))
    relay.switch_on()
    return relay


async def test_samples_of_all_modules_come_in_batches(relay):
    bench = Bench(link_from_url(relay.url))
    async with bench.reading():

        def is_enough() -> bool:
            counts = Counter(each.received.module for each in bench.of(InertialSample))
            well = {each.received.module for each in bench.of(Health)}
            return len(well) > len(MODULES) and min(counts[number] for number in MODULES) > 200

        enough = await bench.until(is_enough, PATIENCE_S)
    assert enough
    samples = bench.of(InertialSample)
    assert {each.received.module for each in samples} == set(MODULES)
    assert all(each.received.relayed_us is not None for each in samples)
    for number in MODULES:
        sequences = [each.received.sequence for each in samples if each.received.module == number]
        assert Counter(steps(sequences, 2**16))[1] > 0.9 * (len(sequences) - 1)
    assert bench.decoder.dropped.total() <= 1  # of the line that was opened in the middle of a wire frame


async def test_a_module_behind_the_relay_keeps_the_rules(relay):
    link = link_from_url(relay.url)
    found = [each async for each in check_module(link, "02020202", allow_writes=True, only=RULES)]
    assert {each.rule: each.detail for each in found if each.outcome is not RuleOutcome.KEPT} == {}


async def test_the_relay_obeys_and_its_id_is_fixed(relay):
    client = CommandClient([link_from_url(relay.url)], allow_writes=True)
    async with client.reading():
        roster = await Configurator(client).discover()
        assert {each.module for each in roster.devices} == {*MODULES, RELAY_ID}
        with pytest.raises(Exception, match="cannot do that"):
            await Configurator(client).write(bytes([99] * 12), {"module_id": 7})
        await Configurator(client).write(bytes([99] * 12), {"label": "belt"})
    assert relay.memory.settings["label"] == "belt"


def samples_in(path):
    """Numbers of the samples in a file of the card, by module; nothing in it is damaged."""
    decoder = PacketDecoder(FrameDecoder())
    found = defaultdict(list)
    for received in decoder.feed(path.read_bytes()):
        if isinstance(received.packet, InertialSample):
            found[received.module].append(received.sequence)
    assert not decoder.dropped.total()
    return found


async def test_what_the_relay_recorded_is_listed_fetched_and_erased(relay, command, tmp_path):
    async def typed(*words):
        process = command("modules", "card", *words, "--link", relay.url, "--rig", "arm_3")
        assert await process.ended() == 0, process.report()
        return process.output

    for _ in range(2):
        await typed("start")
        await asyncio.sleep(1.5)  # of recording
    busy = command(
        *("modules", "card", "erase", "--all", "--allow-writes", "--link", relay.url, "--rig", "arm_3")
    )
    assert await busy.ended() == 1
    await typed("stop")
    files = json.loads(await typed("list", "--json"))["files"]
    assert [each["file"] for each in files] == [1, 2]
    target = tmp_path / "walk"
    for each in files:
        await typed("download", each["file"], target, "--raw")
        assert target.stat().st_size == each["size"]
        found = samples_in(target)
        assert found.keys() == set(MODULES)
        for numbers in found.values():
            assert len(numbers) > 80
            assert Counter(steps(numbers, 2**16))[1] > 0.9 * (len(numbers) - 1)
        target.unlink()
    await typed("erase", "1", "--allow-writes")
    relay.cut_power()
    relay.switch_on()
    assert [each["file"] for each in json.loads(await typed("list", "--json"))["files"]] == [2]


async def test_a_file_that_was_cut_short_holds_all_but_the_last_second(relay, tmp_path):
    uid = bytes([99] * 12)
    client = CommandClient([link_from_url(relay.url)])
    async with client.reading():
        await client.request(uid, Verb.START)
        await asyncio.sleep(5.0)  # of recording
        (before,) = await Card(client, uid).files()
    relay.cut_power()
    relay.switch_on()
    client = CommandClient([link_from_url(relay.url)])
    async with client.reading():
        card = Card(client, uid)
        (entry,) = await card.files()
        await download(card.read, entry, tmp_path / "walk")
    assert entry.size > before.size - 1.5 * before.size / 5.0
    assert samples_in(tmp_path / "walk").keys() == set(MODULES)
