"""A recording through the chain filters in few calls equals its frames one by one, bit for bit."""

from dataclasses import fields, replace

import numpy as np
import pytest
from simulated_body import arm, imu_frames, instants, simulate

from devices.link import Framing
from gateway.body.skeleton import LocalDevice
from gateway.emulation.simulation import LINK, relay_chunks, suit_17
from gateway.frames import LocalReading, Quantity
from gateway.pipeline import Pipeline
from gateway.reconstruction import update_many
from gateway.reconstruction.inertial.tree.reconstructor import JointReconstructor, OutwardReconstructor
from gateway.sources.clock_mode import ClockMode
from gateway.stages.frame_assembler import AssemblyParams

BOTH = pytest.mark.parametrize("kind", [JointReconstructor, OutwardReconstructor])


def assert_same(one, other):
    for field in fields(one):
        np.testing.assert_array_equal(getattr(one, field.name), getattr(other, field.name), strict=True)


def tracked_arm():
    """The arm with a position device on its root, 40 readings a second; frames; a frame that comes twice."""
    body = arm(on_joint=False)
    times = instants(100, 3.0)
    frames = imu_frames(body, simulate(body, times), gyroscopes=True)
    device = LocalDevice(quantity=Quantity.POSITION, segment=0, position=np.array([0.1, 0.0, 0.2]), device=60)
    suit = replace(body.suit(), local_devices=(device,))
    for k in range(0, len(frames), 3):
        position = np.array([0.01 * np.sin(0.1 * k), np.nan if k == 90 else 0.02, 1.0])
        reading = LocalReading(
            60, frames[k].time_ns - 4_000_000, device.quantity, position, np.full(3, 0.001)
        )
        frames[k] = replace(frames[k], local=(reading,))
    return suit, [*frames[:100], frames[99], *frames[100:]]


@BOTH
@pytest.mark.parametrize("size", [7, 256])
def test_many_frames_at_a_time_are_the_same_frames(kind, size):
    suit, frames = tracked_arm()
    singly, batched = kind(suit, 0.01), kind(suit, 0.01)
    one_by_one = [singly.update(frame) for frame in frames]
    many = [seen for k in range(0, len(frames), size) for seen in update_many(batched, frames[k : k + size])]
    assert len(many) == len(frames)
    for one, other in zip(one_by_one, many, strict=True):
        assert_same(one, other)
    for name, array in singly.state().items():
        assert array.tobytes() == batched.state()[name].tobytes(), name
    assert np.isfinite(many[-1].p_w).all()
    assert abs(many[-1].p_w[0, 2]) > 0.5  # the measured position is used


def test_no_frames_give_no_frames():
    assert JointReconstructor(arm(on_joint=False).suit(), 0.01).update_many([]) == []


def test_replaying_chunks_equals_feeding_them():
    suit, motion = suit_17()
    chunks = relay_chunks(motion, seconds=4.0)
    params = AssemblyParams(10e6, 30_000_000, 100_000_000, 500_000_000)
    live, replayed = (Pipeline(suit, params, "joint", ClockMode.ESTIMATED) for _ in range(2))
    for pipeline in (live, replayed):
        pipeline.add_link(LINK, Framing.BYTE_STREAM)
    fed = [frame for chunk in chunks for frame in live.feed(chunk)]
    frames = list(replayed.replay(chunks))
    assert len(frames) == len(fed) > 256
    for one, other in zip(fed, frames, strict=True):
        assert_same(one, other)
    assert replayed.skeleton_frames == live.skeleton_frames
