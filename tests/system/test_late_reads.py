"""A gateway that is kept from reading for a while: no clock is misled, and its poses are right again."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from devices.emulators.emulated_suit import EmulatedSuit
from devices.emulators.imperfections import TYPICAL
from devices.emulators.suit_traffic import SuitSettings, SuitTraffic
from devices.emulators.transports import PtyTransport
from devices.link import Chunk, gateway_time_ns
from devices.links.serial_link import SerialLink
from gateway.body.rig import load_rig
from gateway.contract.messages import PoseMessage
from gateway.emulation.rig import dress, move
from gateway.geometry.comparison import orientation_error
from gateway.outputs.subscriber import PoseSubscriber
from gateway.service.service import Service
from gateway.settings import GatewaySettings
from tests.patience import PATIENCE_S

if TYPE_CHECKING:
    from tests.fixtures.brokers import Mosquitto

pytestmark = pytest.mark.system
RIG = "robot_arm_4"
HELD_S = 0.3
BURSTS_AT, N_POSES, JUDGED = (200, 270), 420, 80
"""After how many poses reads are late; how many poses there are; of how many errors are compared."""


class LateReader(SerialLink):
    """A serial line that is not looked at for a while: all that came meanwhile arrives at once, and late."""

    is_to_be_late = False

    async def __aiter__(self) -> AsyncIterator[Chunk]:
        async for chunk in super().__aiter__():
            if not self.is_to_be_late:
                yield chunk
                continue
            self.is_to_be_late = False
            held, until_ns = [chunk], chunk.arrived_ns + round(HELD_S * 1e9)
            while held[-1].arrived_ns < until_ns:
                held.append(await anext(super().__aiter__()))
            yield Chunk(b"".join(one.data for one in held), gateway_time_ns(), self.name)


def clock_errors_s(emulated: EmulatedSuit, traffic: SuitTraffic, service: Service) -> list[float]:
    """Of every module: how far the gateway's idea of its clock is from the truth."""
    found = []
    for module, sender in traffic.senders.items():
        record, clock = service.pipeline.stream.modules[module], sender.clock
        now_s = emulated.motion_time_s(record.last_arrival_ns)
        true_ns = emulated.instant_ns(now_s) - clock.count_us(now_s * (1 + clock.skew)) * 1000
        error_us = (record.clock.figures().offset_ns - true_ns) * 1e-3
        found.append(((error_us + 2**31) % 2**32 - 2**31) * 1e-6)
    return found


@pytest.mark.parametrize("has_relay", [False, True])
async def test_poses_are_right_again_after_reads_that_came_late(
    mosquitto: Mosquitto, tmp_path: Path, has_relay: bool
) -> None:
    suit, port = load_rig(RIG), tmp_path / "suit"
    settings = GatewaySettings.model_validate(
        {
            "gateway": "lab",
            "links": [{"name": "suit", "url": str(port)}],
            "rig": RIG,
            "reconstructor": "joint",
            "mqtt": {"port": mosquitto.port, "queue_length": 1000},
        }
    )
    motion = move(dress(suit), suit.skeleton.name, 1)
    traffic = SuitTraffic(motion, SuitSettings(has_relay=has_relay), TYPICAL, 1)
    emulated = EmulatedSuit(traffic, PtyTransport(port))
    link = LateReader(str(port), name="suit")
    playing = asyncio.create_task(emulated.run())
    while not emulated.transport.url:
        await asyncio.sleep(0.01)
    service = Service(settings, suit, links=[link])
    serving = asyncio.create_task(service.run())
    poses: list[PoseMessage] = []
    try:
        async with asyncio.timeout(2 * PATIENCE_S), PoseSubscriber(settings.mqtt, "lab") as received:
            async for pose in received:
                poses.append(pose.pose)
                link.is_to_be_late |= len(poses) in BURSTS_AT
                if len(poses) == N_POSES:
                    clocks_s = clock_errors_s(emulated, traffic, service)
                    break
    finally:
        for task in (playing, serving):
            task.cancel()
        await asyncio.gather(playing, serving, return_exceptions=True)
    whole = [pose for pose in poses if all(pose.segments.values())]
    times_s = np.array([emulated.motion_time_s(pose.t_ns) for pose in whole])
    q_wb = np.array([[pose.segments[name] for name in suit.skeleton.segment_names] for pose in whole])
    error_deg = np.degrees(orientation_error(q_wb, motion.state(times_s).q_wb).total).max(axis=1)
    n_incomplete = len(poses) - len(whole)
    assert n_incomplete < BURSTS_AT[0] - JUDGED
    before = error_deg[BURSTS_AT[0] - n_incomplete - JUDGED : BURSTS_AT[0] - n_incomplete]
    assert np.median(error_deg[-JUDGED:]) < np.median(before) + 1.0
    assert len(clocks_s) == 4
    assert np.abs(clocks_s).max() < HELD_S / 10
