"""Photoelectric cells from the emulated module through a terminal to a subscriber: headings by the sun."""

import time
from pathlib import Path

import numpy as np
import pytest
import yaml

from devices.emulators.emulated_suit import EmulatedSuit
from devices.emulators.suit_traffic import SuitSettings, SuitTraffic
from devices.emulators.transports import PtyTransport
from devices.link import gateway_time_ns
from gateway.body.rig import load_rig
from gateway.emulation.rig import dress, move, sunlight
from gateway.geometry.comparison import orientation_error, rmse_deg

pytestmark = pytest.mark.system

SECONDS, SETTLED_S = 25.0, 12.0


def rig_in_the_morning(folder: Path) -> Path:
    """The shipped rig where it is about nine o'clock by the sun, whenever the test runs."""
    rig = yaml.safe_load(Path("config/rigs/robot_arm_4_sun.yaml").read_text(encoding="utf-8"))
    hours = time.time() / 3600 % 24
    longitude = ((9.0 - hours) * 15 + 180) % 360 - 180
    rig["world"]["place"] = {"latitude_deg": 25.0, "longitude_deg": longitude}
    path = folder / "sunny.yaml"
    path.write_text(yaml.safe_dump(rig), encoding="utf-8")
    return path


async def test_a_subscriber_gets_headings_by_the_sun(gateway_on, tmp_path):
    rig = rig_in_the_morning(tmp_path)
    suit = load_rig(str(rig))
    motion = move(dress(suit), suit.skeleton.name, 1)
    settings = SuitSettings(gravity=suit.gravity, sensors=("specific_force", "angular_rate"))
    lit = SuitSettings(**{**vars(settings), "sunlight": sunlight(suit, gateway_time_ns())})
    port = tmp_path / "suit"
    # As fast as it is read: in real time a busy machine has it drop what nobody reads.
    emulated = EmulatedSuit(SuitTraffic(motion, lit), PtyTransport(port), speed=None, duration_s=SECONDS)
    async with gateway_on(str(port), str(rig), "independent") as running:
        await emulated.run()
        await running.until_quiet(emulated.counts.sent_bytes)
        told = running.service.pipeline.statistics()["light"]
        clock = running.service.pipeline.stream.modules[0].clock.figures()
    poses = [received.pose for received in running.received]
    # These modules count motion time, and one clock: when the first of them arrived does not matter.
    times_s = np.array([pose.t_ns - clock.offset_ns for pose in poses]) * 1e-9
    kept = times_s > SETTLED_S
    names = suit.skeleton.segment_names
    q_wb = np.array([[pose.segments[name] for name in names] for pose in poses])[kept]
    heading = rmse_deg(orientation_error(q_wb, motion.state(times_s[kept]).q_wb).heading)
    print(f"\nheading {heading}, {told}")
    assert kept.sum() > 500
    assert heading.max() < 1.5
    assert all(module["sun"] > 1000 for module in told["modules"].values())
