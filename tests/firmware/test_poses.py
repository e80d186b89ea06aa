"""Two modules of the reference firmware, a gateway and a broker: poses against the motion that is felt."""

from __future__ import annotations

import asyncio

import numpy as np
import pytest

from devices.emulators.firmware_memory import motion_rows
from gateway.body.rig import load_rig
from gateway.emulation.rig import dress, move
from gateway.outputs.settings import MqttSettings
from gateway.outputs.subscriber import PoseSubscriber
from gateway.service.service import Service
from gateway.settings import GatewaySettings, LinkSettings
from tests.firmware.machines import Machine
from tests.patience import PATIENCE_S

pytestmark = pytest.mark.system

PAIR_BODY = """
name: pair
neutral: [1, 0, 0, 0]
segments:
  - {name: upper, parent: null, tip: [0, 0, -0.3]}
  - {name: lower, parent: upper, joint: [0, 0, -0.3], tip: [0, 0, -0.3]}
"""
PAIR_RIG = """
body: pair.body.yaml
modules:
  - {id: 1, segment: upper, position: [0, 0, -0.1]}
  - {id: 2, segment: lower, position: [0, 0, -0.1]}
world:
  gravity: 9.80665
  magnetic_field: {norm_ut: 49, dip_deg: 66, declination_deg: 0}
"""
INTERVAL_US = 5000
SECONDS, SETTLING_S, PLAYED_S = 8.0, 4.0, 90.0
LARGEST_ERROR_DEG = 3.0


def error_deg(q: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Angle between orientations (n, 4), degrees."""
    return np.degrees(2 * np.arccos(np.clip(np.abs((q * truth).sum(axis=1)), 0, 1)))


@pytest.mark.timeout(300)
async def test_poses_follow_the_motion_that_the_sensors_feel(module, board, mosquitto, tmp_path):
    (tmp_path / "pair.body.yaml").write_text(PAIR_BODY)
    (tmp_path / "pair.yaml").write_text(PAIR_RIG)
    suit = load_rig(str(tmp_path / "pair.yaml"))
    motion = move(dress(suit), "pair", seed=2)
    times = np.arange(0, PLAYED_S, INTERVAL_US * 1e-6)
    machines: list[Machine] = []
    for segment, number in enumerate(suit.module_ids):
        machine = module(board, number, is_on=False, settings={"module_id": number})
        rows = motion_rows(motion, segment, times, suit.gravity, suit.magnetic_field)
        machine.memory.play(rows, INTERVAL_US)
        machines.append(machine)
    settings = GatewaySettings(
        gateway="lab",
        links=[LinkSettings(name=f"m{i}", url=m.url) for i, m in enumerate(machines)],
        rig=str(tmp_path / "pair.yaml"),
        reconstructor="independent",
        mqtt=MqttSettings(port=mosquitto.port, decimals=None),
    )
    for machine in machines:
        machine.switch_on()
    service = Service(settings, suit)
    serving = asyncio.create_task(service.run())
    poses = []
    try:
        async with PoseSubscriber(settings.mqtt, "lab") as subscriber, asyncio.timeout(PATIENCE_S + SECONDS):
            async for received in subscriber:
                poses.append(received.pose)
                if received.pose.t_ns - poses[0].t_ns > SECONDS * 1e9:
                    break
        modules = service.pipeline.modules.records
        offsets = [modules[number].clock.figures().offset_ns for number in suit.module_ids]
        bounds = [modules[number].clock.figures().bound_us for number in suit.module_ids]
    finally:
        serving.cancel()
        await asyncio.gather(serving, return_exceptions=True)
    t_ns = np.array([pose.t_ns for pose in poses])
    settled = t_ns - t_ns[0] > SETTLING_S * 1e9
    for segment, name in enumerate(suit.skeleton.segment_names):
        q = np.array([pose.segments[name] or [np.nan] * 4 for pose in poses])[settled]
        truth = motion.state((t_ns[settled] - offsets[segment]) * 1e-9).q_wb[:, segment]
        errors = error_deg(q, truth)
        print(
            f"{board} {name}: median {np.nanmedian(errors):.2f}°, worst "
            f"{np.nanmax(errors):.2f}°, clock ±{bounds[segment]} µs"
        )
        assert np.isfinite(errors).mean() > 0.5
        assert np.nanmedian(errors) < LARGEST_ERROR_DEG
    assert all(bound is not None for bound in bounds)  # time requests were answered
