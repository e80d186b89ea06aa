"""A suit whose modules fuse on board: from a real port to MQTT."""

import asyncio
from collections import deque
from dataclasses import replace

import numpy as np
import pytest

from devices.emulators.emulated_suit import EmulatedSuit
from devices.emulators.imperfections import TYPICAL
from devices.emulators.suit_traffic import SuitSettings, SuitTraffic
from devices.emulators.transports import PtyTransport
from gateway.body.rig import load_rig
from gateway.emulation.rig import dress, move
from gateway.geometry.comparison import orientation_error
from gateway.outputs.subscriber import PoseSubscriber
from gateway.service.service import Service
from gateway.settings import GatewaySettings
from tests.patience import PATIENCE_S
from tests.running_suit import running

pytestmark = pytest.mark.system

RIG = "robot_arm_4"


WINDOW = 150
"""Poses that are to be right together, 1.5 s. The first may not be: on a busy machine bytes come late at
first, and it takes the clocks seconds to know by how much."""

RMS_SPEED_DEG_S = 55.0
"""Of the arm's segments: what it is worth when a suit on a busy machine sends later than it samples, which no
clock can know."""


def rms_error_deg(poses, emulated, motion, names):
    """Of all segments of these poses, against what the suit moved by."""
    times_s = np.array([emulated.motion_time_s(pose.t_ns) for pose in poses])
    q_wb = np.array([[pose.segments[name] for name in names] for pose in poses])
    total, _, _ = orientation_error(q_wb, motion.state(times_s).q_wb)
    return np.degrees(np.sqrt(np.mean(np.square(total))))


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
    window, late_s, count, error_deg = deque(maxlen=WINDOW), deque(maxlen=WINDOW), 0, np.nan
    try:
        async with (
            running(service),
            running(emulated),
            asyncio.timeout(2 * PATIENCE_S),
            PoseSubscriber(settings.mqtt, "lab") as received,
        ):
            async for pose in received:
                if not all(pose.pose.segments.values()):
                    continue
                window.append(pose.pose)
                late_s.append(emulated.counts.lateness_s)
                count += 1
                if count >= 50 + WINDOW and count % 50 == 0:
                    error_deg = rms_error_deg(window, emulated, motion, suit.skeleton.segment_names)
                    if error_deg < limit_deg + RMS_SPEED_DEG_S * np.median(late_s):
                        break
    except TimeoutError:
        pytest.fail(f"{error_deg}° off after {count} whole poses, sent {np.median(late_s)} s late")
    assert service.statistics()["unused_readings"] == {}
