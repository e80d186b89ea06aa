"""A suit whose modules fuse on board: from a real port to MQTT."""

import asyncio
from dataclasses import replace

import numpy as np
import pytest

from devices.emulators.emulated_suit import EmulatedSuit
from devices.emulators.imperfections import TYPICAL
from devices.emulators.suit_traffic import SuitSettings, SuitTraffic
from devices.emulators.transports import PtyTransport
from gateway.body.rig import load_rig
from gateway.cli.emulated_rig import dress, move
from gateway.comparison import orientation_error
from gateway.outputs.subscriber import PoseSubscriber
from gateway.service import Service
from gateway.settings import GatewaySettings
from tests.patience import PATIENCE_S

pytestmark = pytest.mark.system

RIG = "robot_arm_4"


def is_whole(pose):
    return all(pose.segments.values())


@pytest.mark.parametrize(("reconstructor", "limit_deg"), [("fused", 1.5), ("fused_neutral", 4.0)])
async def test_orientations_of_the_modules_become_poses(tmp_path, mosquitto, reconstructor, limit_deg):
    """fused_neutral: references face anywhere; the arm is not quite neutral when it is first heard."""
    port, suit = tmp_path / "suit", load_rig(RIG)
    settings = GatewaySettings(
        gateway="lab",
        links=[{"name": "suit", "url": str(port)}],
        rig=RIG,
        reconstructor=reconstructor,
        mqtt={"port": mosquitto.port},
    )
    motion = move(dress(suit), suit.skeleton.name, 1)
    imperfections = replace(TYPICAL, has_random_heading=reconstructor == "fused_neutral")
    traffic = SuitTraffic(motion, SuitSettings(mode=1), imperfections, 1)
    service, emulated = Service(settings, suit), EmulatedSuit(traffic, PtyTransport(port))
    tasks = [asyncio.create_task(service.run()), asyncio.create_task(emulated.run())]
    poses = []
    try:
        async with asyncio.timeout(2 * PATIENCE_S), PoseSubscriber(settings.mqtt, "lab") as received:
            async for pose in received:
                poses.append(pose.pose)
                if sum(map(is_whole, poses[50:])) == 150:
                    break
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
    whole = list(filter(is_whole, poses[50:]))
    times_s = np.array([emulated.motion_time_s(pose.t_ns) for pose in whole])
    q_wb = np.array([[pose.segments[name] for name in suit.skeleton.segment_names] for pose in whole])
    total, _, _ = orientation_error(q_wb, motion.state(times_s).q_wb)
    assert np.degrees(np.sqrt(np.mean(np.square(total)))) < limit_deg
    assert service.statistics()["unused_readings"] == {}
