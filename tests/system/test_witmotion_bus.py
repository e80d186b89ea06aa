"""Several WitMotion devices on one CAN bus: a link each, told apart by their identifiers."""

from __future__ import annotations

import asyncio
import contextlib

import numpy as np
import pytest

from devices.emulators.emulated_suit import EmulatedSuit
from devices.emulators.imperfections import TYPICAL
from devices.emulators.makers.witmotion import witmotion_can_emulators
from devices.emulators.suit_traffic import SuitSettings, SuitTraffic
from devices.emulators.transports import CanBusTransport, LinkPerDevice
from devices.endpoints import link_from_url
from gateway.body.rig import load_rig
from gateway.contract.balances import unaccounted
from gateway.emulation.rig import dress, move_about
from gateway.modules.makers import MakersModules, changed
from gateway.pipeline import Pipeline
from gateway.sources.witmotion import WitMotionCanLinkSettings
from gateway.stages.frame_assembler import AssemblyParams

pytestmark = pytest.mark.system

RIG = "arm_3"
POSES = 200


@pytest.fixture
async def bus(request):
    """The settings of three links to one bus, on which three emulated devices move."""
    suit = load_rig(RIG)
    channel = f"witmotion-{request.node.name}"
    emulators = witmotion_can_emulators(suit.module_ids, 49.0)
    traffic = SuitTraffic(
        move_about(dress(suit), suit.skeleton.name, 1),
        SuitSettings(emulator=emulators.__getitem__),
        TYPICAL,
        1,
    )
    transports = {module: CanBusTransport(channel) for module in suit.module_ids}
    emulated = EmulatedSuit(traffic, LinkPerDevice(transports))
    running = asyncio.create_task(emulated.run())
    yield [
        WitMotionCanLinkSettings(
            name=str(module), url=f"can://virtual/{channel}", module=module, rate_hz=100,
            **emulators[module].link_settings,
        )
        for module in suit.module_ids
    ]  # fmt: skip
    running.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await running


@contextlib.asynccontextmanager
async def read(settings):
    """Read all links into one pipeline; yields it, the way to its devices, and the poses so far."""
    suit = load_rig(RIG)
    params = AssemblyParams(10e6, 60_000_000, 100_000_000, 500_000_000)
    pipeline = Pipeline(suit, params, "independent", links={each.name: each for each in settings})
    makers, links, poses = MakersModules(), [], []

    async def feed(link):
        async for chunk in link:
            poses.extend(pipeline.feed(chunk))

    async with asyncio.TaskGroup() as group:
        for each in settings:
            link = link_from_url(each.url, name=each.name)
            pipeline.add_link(each.name, each.carries)
            await link.open()
            links.append(link)
            makers.add_link(link, pipeline.source_of(each.name))
            group.create_task(feed(link))
        try:
            yield pipeline, makers, poses
        finally:
            for link in links:
                await link.close()


def turned(poses, segment):
    return np.ptp([pose.q_wb[segment] for pose in poses], axis=0).max()


async def test_each_is_read_from_the_bus_that_all_share(bus, until):
    assert [each.identifier for each in bus] == [0x50, 0x51, 0x52]
    async with read(bus) as (pipeline, _, poses):
        records = pipeline.modules.records
        await until(lambda: len(records) == 3 and min(each.received for each in records.values()) >= POSES)
        await until(lambda: len(poses) >= POSES and turned(poses[POSES // 2 :], -1) > 1e-3)
    assert np.isfinite([pose.q_wb for pose in poses[POSES // 2 :]]).all()
    assert set(records) == {each.module for each in bus}
    assert not any(pipeline.source_of("1").dropped().values())
    assert unaccounted(pipeline.balances()) == {}


async def test_each_is_asked_and_set_by_itself(bus):
    async with read(bus) as (_, makers, _):
        found = {device.module: device for device in await makers.discover()}
        assert set(found) == {each.module for each in bus}
        assert len({device.unique_id for device in found.values()}) == 3
        first, second, third = (found[each.module] for each in bus)
        before, after = await changed(second, {"rate": 50})
        assert (before, after) == ({"rate": 100}, {"rate": 50})
        assert [(await each.commands.read(each.line))["rate"] for each in (first, third)] == [100, 100]
