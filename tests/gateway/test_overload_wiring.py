"""What the service does at each stage of the load."""

from __future__ import annotations

import pytest

from gateway.body.rig import load_rig
from gateway.overload import SHED
from gateway.service import Service
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
    service._shed()
    (side,) = service.side._outputs
    assert side.is_paused == (stage >= 1)
    assert service.mqtt._publications.has_segments == (stage < 2)
    admitted = sum(service.mqtt._relief.admits(k * 10_000_000) for k in range(100))
    assert admitted == (100 if stage < 3 else SHED[stage].poses_hz)
    assert service.pipeline._solve_every == SHED[stage].solve_every
    assert SHED[stage].meaning in caplog.text
    assert service.statistics()["load"]["shed"] == [each.name for each in SHED[1 : stage + 1]]
    assert service.observer.health()["load"]["stage"] == stage
    assert service.observer.figures().load.stage == stage
