"""What may be done to the world, to names and to chunks without changing the poses: from bytes to poses."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from devices.emulators import Imperfections, SuitSettings, SuitTraffic
from devices.emulators.motion.motions import generic_motion
from devices.link import Chunk, Framing
from firmware_protocol import (
    FrameDecoder,
    InertialSample,
    PacketDecoder,
    ReceivedPacket,
    encode_frame,
    wire_frame,
)
from gateway.body.skeleton import WornSuit
from gateway.emulation.rig import dress
from gateway.frames import SkeletonFrame
from gateway.pipeline import Pipeline
from gateway.sources.clock_mode import ClockMode
from gateway.sources.despiking import Despiker
from gateway.stages.frame_assembler import AssemblyParams
from tests.invariance import (
    FADE,
    SAGITTAL,
    Scene,
    assert_close,
    assert_same,
    few_examples,
    held_limb,
    listing_of,
    mirrored,
    mirrored_pose,
    recut,
    relisted,
    renamed,
    turned,
    turned_pose,
)

LINK = "suit"
SECONDS = 2.0
PARAMS = AssemblyParams(10e6, 30_000_000, 100_000_000, 500_000_000)
IMPERFECTIONS = Imperfections(
    accelerometer_noise=0.03,
    gyroscope_noise=0.002,
    magnetometer_noise=0.5,
    accelerometer_bias=0.05,
    gyroscope_bias=0.005,
    clock_skew_ppm=30.0,
    has_random_clock_start=True,
    has_random_phase=True,
    latency=0.002,
    jitter=0.002,
    loss=0.01,
)
METHODS = pytest.mark.parametrize("method", ["independent", "joint"])
TOLERANCE = 1e-9
ANGLES = st.floats(0.1, 6.2)
SEEDS = st.integers(0, 2**32 - 1)


@cache
def sent(has_relay: bool = False) -> tuple[Chunk, ...]:
    """What the emulated limb sends, one chunk a transmission."""
    suit = held_limb()
    motion = generic_motion(dress(suit), 1, peak_angular_rate=6.0, peak_angular_acceleration=50.0, fade=FADE)
    suit_settings = SuitSettings(
        gravity=suit.gravity, magnetic_field=suit.magnetic_field, has_relay=has_relay
    )
    traffic = SuitTraffic(motion, suit_settings, IMPERFECTIONS, 1)
    return tuple(Chunk(each.data, round(each.time_s * 1e9), LINK) for each in traffic.transmissions(SECONDS))


def poses(suit: WornSuit, chunks: tuple[Chunk, ...], method: str) -> list[SkeletonFrame]:
    """What the pipeline makes of the chunks."""
    pipeline = Pipeline(suit, PARAMS, method, ClockMode.ESTIMATED, despiker=Despiker())
    pipeline.add_link(LINK, Framing.BYTE_STREAM)
    return [pose for chunk in chunks for pose in pipeline.feed(chunk)]


@cache
def unchanged(method: str, has_relay: bool = False) -> list[SkeletonFrame]:
    """The poses of what was sent, as it was sent."""
    found = poses(held_limb(), sent(has_relay), method)
    assert len(found) > 180
    return found


def rewritten(change: Callable[[ReceivedPacket], ReceivedPacket]) -> tuple[Chunk, ...]:
    """What was sent, each packet changed."""
    decoder = PacketDecoder(FrameDecoder())
    chunks = []
    for chunk in sent():
        packets = [change(packet) for packet in decoder.feed(chunk.data)]
        frames = (wire_frame(p.packet, p.module, p.sequence, p.module_time_us) for p in packets)
        chunks.append(replace(chunk, data=b"".join(map(encode_frame, frames))))
    return tuple(chunks)


@METHODS
def test_a_field_turned_by_half_turns_the_poses(method: str) -> None:
    expected = [turned_pose(pose, np.pi) for pose in unchanged(method)]
    assert_close(poses(facing(np.pi), sent(), method), expected, TOLERANCE)


@given(angle=ANGLES)
@few_examples(2)
def test_a_turned_field_turns_the_poses(angle: float) -> None:
    """Of ``joint`` the reconstructor's own tests tell how far that is true."""
    expected = [turned_pose(pose, angle) for pose in unchanged("independent")]
    assert_close(poses(facing(angle), sent(), "independent"), expected, TOLERANCE)


def facing(angle: float) -> WornSuit:
    """The rig in a world where north is elsewhere: the modules' bytes are the same."""
    return turned(Scene(held_limb(), ()), angle).suit


@METHODS
@given(seed=SEEDS)
@few_examples(2)
def test_names_and_the_order_of_modules_do_not_count(method: str, seed: int) -> None:
    suit = held_limb()
    listing = listing_of(suit, np.random.default_rng(seed))
    listing = replace(listing, segments=np.arange(suit.skeleton.n_segments))
    chunks = rewritten(lambda packet: replace(packet, module=renamed(packet.module)))
    found = poses(relisted(Scene(suit, ()), listing).suit, chunks, method)
    for one, other in zip(found, unchanged(method), strict=True):
        assert_same(one, other)


@METHODS
def test_a_mirrored_suit_gives_mirrored_poses(method: str) -> None:
    suit = held_limb()
    found = poses(mirrored(Scene(suit, ())).suit, rewritten(mirrored_packet), method)
    assert_close(found, [mirrored_pose(pose, suit.skeleton) for pose in unchanged(method)], TOLERANCE)


def mirrored_packet(received: ReceivedPacket) -> ReceivedPacket:
    """What the module would have sent in the mirror."""
    packet = received.packet
    if not isinstance(packet, InertialSample):
        return received
    force, rate, field = (
        None if vector is None else tuple((sign * SAGITTAL @ vector).tolist())
        for sign, vector in (
            (1.0, packet.specific_force),
            (-1.0, packet.angular_rate),
            (-1.0, packet.magnetic_field),
        )
    )
    packet = replace(packet, specific_force=force, angular_rate=rate, magnetic_field=field)
    return replace(received, packet=packet)


@pytest.mark.parametrize(("method", "has_relay"), [("joint", False), ("independent", True)])
@given(seed=SEEDS)
@few_examples(2)
def test_chunks_may_be_cut_anywhere(method: str, has_relay: bool, seed: int) -> None:
    chunks = recut(sent(has_relay), np.random.default_rng(seed))
    assert b"".join(c.data for c in chunks) == b"".join(c.data for c in sent(has_relay))
    found, expected = poses(held_limb(), chunks, method), unchanged(method, has_relay)
    assert len(found) == len(expected)
    for one, other in zip(found, expected, strict=True):
        assert_same(one, other)


@pytest.mark.xfail(
    strict=True,
    raises=AssertionError,
    reason="a module's clock takes in the delay of a packet before its counter tells that it has come before",
)
@METHODS
def test_a_packet_that_comes_twice_changes_nothing(method: str) -> None:
    twice = tuple(replace(chunk, data=2 * chunk.data) for chunk in sent())
    for one, other in zip(poses(held_limb(), twice, method), unchanged(method), strict=True):
        assert_same(one, other)
