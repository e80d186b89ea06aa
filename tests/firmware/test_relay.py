"""The relay unit: modules of several lines on one, commands and time requests through it."""

from __future__ import annotations

from collections import Counter

import pytest

from devices.command_client import CommandClient
from devices.configure import Configurator
from devices.conformance import Outcome, check_module
from devices.conformance.bench import Bench, steps
from devices.endpoints import link_from_url
from firmware_protocol import RELAY as RELAY_ID
from firmware_protocol import Health, InertialSample
from tests.firmware.machines import POSIX, RELAY, Machine
from tests.patience import PATIENCE_S

pytestmark = [pytest.mark.system, pytest.mark.timeout(200)]

MODULES = (1, 2, 3)
RULES = (
    *("hello", "get_info", "unknown_verb", "read_settings", "stop_and_start", "repeated_command"),
    *("by_module_id", "by_unique_id", "time_request", "time_told_truly", "time_request_to_all"),
    *("staged", "limits", "commit", "triggers"),
)


@pytest.fixture
def relay(module) -> Machine:
    """A relay and three modules behind it."""
    behind = [module(POSIX, number, settings={"module_id": number}) for number in MODULES]
    relay = module(RELAY, 99, is_on=False)
    relay.environment["RELAY_PORTS"] = ":".join(str(each.link) for each in behind)
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
    assert {each.rule: each.detail for each in found if each.outcome is not Outcome.KEPT} == {}


async def test_the_relay_obeys_and_its_id_is_fixed(relay):
    client = CommandClient([link_from_url(relay.url)], allow_writes=True)
    async with client.reading():
        roster = await Configurator(client).discover()
        assert {each.module for each in roster.devices} == {*MODULES, RELAY_ID}
        with pytest.raises(Exception, match="cannot do that"):
            await Configurator(client).write(bytes([99] * 12), {"module_id": 7})
        await Configurator(client).write(bytes([99] * 12), {"label": "belt"})
    assert relay.memory.settings["label"] == "belt"
