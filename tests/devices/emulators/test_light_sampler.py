"""Emulated photoelectric cells: what they read, what they send, what shades them."""

import numpy as np
import pytest

from devices.emulators.bodies import emulated_body
from devices.emulators.motion.motions import robot_arm_motion
from devices.emulators.sensing.light_sampler import LightSampler, Shade, Sunlight
from devices.emulators.suit_traffic import SuitSettings, SuitTraffic
from firmware_protocol import FrameDecoder, InertialSample, LightSample, PacketDecoder

SUN = np.array([0.6, 0.0, 0.8])
UPRIGHT = np.eye(3)[None]


def test_faces_read_by_their_angle_to_sun_sky_and_ground():
    light = Sunlight(SUN, direct=0.5, sky=0.1, ground=0.04, gain_error=0.0, noise=0.0)
    found = LightSampler(light, 1, 3).read(np.zeros(1), UPRIGHT)[0]
    assert found == pytest.approx([0.37, 0.07, 0.07, 0.07, 0.5, 0.04])


def test_shades_fall_on_their_cells_for_their_time():
    shade = Shade(1.0, 2.0, module=3, cells=(4,))
    light = Sunlight(SUN, gain_error=0.0, noise=0.0, sky=0.0, ground=0.0, shades=(shade,))
    found = LightSampler(light, 1, 3).read(np.array([0.5, 1.5, 2.5]), np.tile(UPRIGHT, (3, 1, 1)))
    assert found[:, 4] == pytest.approx([0.48, 0.0, 0.48])
    assert found[:, 0] == pytest.approx([0.36, 0.36, 0.36])
    other = LightSampler(light, 1, 4).read(np.array([1.5]), UPRIGHT)
    assert other[0, 4] == pytest.approx(0.48)


def test_a_suit_with_cells_sends_a_light_sample_with_every_sample():
    body = emulated_body(("a", "b"), [-1, 0], [[0, 0, 0], [0, 0, 0.3]])
    traffic = SuitTraffic(robot_arm_motion(body, 1), SuitSettings(sunlight=Sunlight(SUN)))
    decoder = PacketDecoder(FrameDecoder())
    packets = [p for sent in traffic.transmissions(1.0) for p in decoder.feed(sent.data)]
    inertial = {(p.module, p.module_time_us) for p in packets if isinstance(p.packet, InertialSample)}
    light = {(p.module, p.module_time_us) for p in packets if isinstance(p.packet, LightSample)}
    assert light == inertial
    assert len(light) > 190
