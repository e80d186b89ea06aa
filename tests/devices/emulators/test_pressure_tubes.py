"""Emulated pressure tubes: what they send is the velocity along their own axes."""

import numpy as np
from scipy.spatial.transform import Rotation

from devices.emulators.bodies import EmulatedLocalDevice, emulated_body
from devices.emulators.motion.motions import generic_motion
from devices.emulators.sensing.ideal_sensors import AIR_VELOCITY, measure_point
from devices.emulators.sensing.local_sampler import AIR_DENSITY
from devices.emulators.suit_traffic import SuitTraffic
from firmware_protocol import FrameDecoder, PacketDecoder, PressureSample
from firmware_protocol.samples import VELOCITY

TURN = np.array([0.5, 0.5, 0.5, 0.5])


def test_pressure_is_that_of_the_velocity_along_each_tube():
    device = EmulatedLocalDevice(60, 0, np.array([0.1, 0.0, 0.0]), AIR_VELOCITY, orientation=TURN, rate_hz=50)
    body = emulated_body(("a", "b"), [-1, 0], [[0, 0, 0], [0, 0, 0.3]], local_devices=(device,))
    traffic = SuitTraffic(generic_motion(body, 2, root_travel_m=1.0))
    decoder = PacketDecoder(FrameDecoder())
    packets = [p for sent in traffic.transmissions(6.0) for p in decoder.feed(sent.data)]
    samples = [p for p in packets if isinstance(p.packet, PressureSample)]
    times = np.array([p.module_time_us for p in samples]) * 1e-6
    assert len(samples) > 290
    state = traffic.motion.state(times)
    v_w = measure_point(state, np.tile(device.position, (2, 1)), VELOCITY)[:, 0]
    R_wd = state.R_wb[:, 0] @ Rotation.from_quat(TURN, scalar_first=True).as_matrix()
    along = np.einsum("tji,tj->ti", R_wd, v_w)
    found = np.array([p.packet.differential_pressure for p in samples])
    assert np.abs(along).max() > 0.5
    np.testing.assert_allclose(found, 0.5 * AIR_DENSITY * along * np.abs(along), atol=2e-4)
