"""Two modules of the reference firmware, a gateway and a broker: poses against the motion that is felt."""

from __future__ import annotations

import asyncio

import numpy as np
import pytest

from devices.emulators.device.firmware_memory import motion_rows
from gateway.body.rig import load_rig
from gateway.emulation.rig import dress, move
from gateway.outputs.settings import MqttSettings
from gateway.outputs.subscriber import PoseSubscriber
from gateway.service.service import Service
from gateway.settings import GatewaySettings, LinkSettings
from tests.firmware.machines import SHOWN, Machine
from tests.patience import PATIENCE_S
from tests.running_suit import running

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
REST_S, PLAYED_S = 6.0, 60.0
"""The modules lie still at first, so that the gateway finds them before they move, as a wearer would."""
FADED_S = 2.0
"""So long after its begin the motion is under way; until then it hardly turns anything."""
N_MOVING = 800
"""Poses of moving modules to look at: some seconds, and more where a busy host loses some."""
LARGEST_ERROR_DEG = 1.5


def error_deg(q: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Angle between orientations (n, 4), degrees."""
    return np.degrees(2 * np.arccos(np.clip(np.abs((q * truth).sum(axis=1)), 0, 1)))


def motion_s(service: Service, t_ns: np.ndarray) -> np.ndarray:
    """Return the time of its motion that each module plays at instants (n,), s: (n, m), by its newest clock.

    Before 0 it lies still. Of a module that its watchdog has restarted, that is before the restart too.
    """
    records = service.pipeline.modules.records
    offsets = [records[number].clock.figures().offset_ns for number in sorted(records)]
    return (t_ns[:, None] - np.array(offsets)) * 1e-9 - REST_S


@pytest.mark.timeout(300)
async def test_poses_follow_the_motion_that_the_sensors_feel(module, board, mosquitto, tmp_path, figure):
    (tmp_path / "pair.body.yaml").write_text(PAIR_BODY)
    (tmp_path / "pair.yaml").write_text(PAIR_RIG)
    suit = load_rig(str(tmp_path / "pair.yaml"))
    motion = move(dress(suit), "pair", seed=2)
    times = np.arange(0, PLAYED_S, INTERVAL_US * 1e-6)
    machines: list[Machine] = []
    for segment, number in enumerate(suit.module_ids):
        machine = module(board, number, is_on=False, settings={"module_id": number})
        rows = motion_rows(motion, segment, times - REST_S, suit.gravity, suit.magnetic_field)
        machine.memory.play(rows, INTERVAL_US)
        machines.append(machine)
    settings = GatewaySettings(
        gateway="lab",
        links=[LinkSettings(name=f"m{i}", url=m.url) for i, m in enumerate(machines)],
        rig=str(tmp_path / "pair.yaml"),
        reconstructor="independent",
        mqtt=MqttSettings(port=mosquitto.port, decimals=None),
    )
    service = Service(settings, suit)
    poses = []
    async with running(service):
        async with PoseSubscriber(settings.mqtt, "lab") as subscriber, asyncio.timeout(4 * PATIENCE_S):
            for machine in machines:
                machine.switch_on()
            async for received in subscriber:
                poses.append(received.pose)
                played_s = motion_s(service, np.array([pose.t_ns for pose in poses]))
                if (played_s.min(axis=1) > FADED_S).sum() >= N_MOVING:
                    break
        modules = service.pipeline.modules.records
        bounds = [modules[number].clock.figures().bound_us for number in suit.module_ids]
    for segment, name in enumerate(suit.skeleton.segment_names):
        is_moving = played_s[:, segment] > FADED_S
        q = np.array([pose.segments[name] or [np.nan] * 4 for pose in poses])[is_moving]
        truth = motion.state(played_s[is_moving, segment]).q_wb[:, segment]
        errors = error_deg(q, truth)
        figure(
            f"Orientation of module `{name}` against the motion that it plays, {SHOWN[board]}",
            f"median error {np.nanmedian(errors):.2f}°, 99 of 100 below {np.nanpercentile(errors, 99):.2f}°; "
            f"its clock is known to ±{bounds[segment] or np.nan:.0f} µs",
        )
        assert np.isfinite(errors).mean() > 0.5
        assert np.nanmedian(errors) < LARGEST_ERROR_DEG
    assert all(bound is not None for bound in bounds)  # time requests were answered
