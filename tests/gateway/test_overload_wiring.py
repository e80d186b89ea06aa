"""What the service does at each stage of the load."""

from __future__ import annotations

import asyncio

import pytest

from devices.link import gateway_time_ns
from gateway.body.rig import load_rig
from gateway.service.overload import SHED
from gateway.service.service import Service
from gateway.settings import GatewaySettings


@pytest.fixture(scope="module")
def service():
    settings = GatewaySettings(
        gateway="lab",
        links=[{"name": "suit", "url": "tcp://127.0.0.1:1"}],
        rig="robot_arm_4",
        mqtt={"segment_rate": 20},
        outputs={"udp_json": {}},
    )
    return Service(settings, load_rig("robot_arm_4"))


@pytest.mark.parametrize("stage", [*range(len(SHED)), 2, 0])
def test_each_stage_takes_what_it_says_and_gives_it_back(service, stage, caplog):
    service.load.stage = stage
    service.shedding.shed()
    (side,) = service.side._outputs
    assert side.is_paused == (stage >= 1)
    assert service.mqtt._poses._publications.has_segments == (stage < 2)
    admitted = sum(service.mqtt._poses._relief.admits(k * 10_000_000) for k in range(100))
    assert admitted == (100 if stage < 3 else SHED[stage].poses_hz)
    assert service.pipeline.module_stage.solve_every == SHED[stage].solve_every
    assert SHED[stage].meaning in caplog.text
    assert service.statistics()["load"]["shed"] == [each.name for each in SHED[1 : stage + 1]]
    assert service.observer.health()["load"]["stage"] == stage
    assert service.observer.figures().load.stage == stage


async def test_what_waits_in_the_system_counts_as_lag_also_where_none_of_it_becomes_a_pose(until):
    settings = GatewaySettings(
        gateway="lab", links=[{"name": "suit", "url": "tcp://127.0.0.1:1"}], rig="robot_arm_4"
    )
    service = Service(settings, load_rig("robot_arm_4"))
    (link,) = service.links
    watching = asyncio.create_task(service.shedding.watch())
    link.counts.backlog_since_ns = gateway_time_ns() - 1_000_000_000
    await until(lambda: service.load.stage >= 1)
    # A chunk that was read a moment ago does not hide it.
    service.shedding.note_lag(link.name, link.counts, gateway_time_ns())
    assert service.load.worst_s > 1.0
    link.counts.backlog_since_ns = None
    await until(lambda: service.load.stage == 0)
    watching.cancel()
