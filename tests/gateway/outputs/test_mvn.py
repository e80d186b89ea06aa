"""Poses as MVN streams them: read back by the source that reads MVN, they are the same poses."""

from __future__ import annotations

import asyncio
import math
import socket

import numpy as np
import pytest
from pydantic import ValidationError

from devices.endpoints import link_from_url
from devices.link import Chunk
from devices.vendor_protocols.mvn import SEGMENTS, JointRotation, MvnDecoder, SegmentPose
from gateway.body.kinematics import joint_positions
from gateway.body.rig import load_rig
from gateway.errors import OutputError
from gateway.frames import FusedReading, SkeletonFrame
from gateway.geometry import quaternion
from gateway.outputs import stream_sink
from gateway.outputs.mvn import MvnEncoder
from gateway.outputs.settings import OutputsSettings
from gateway.outputs.side_outputs import SideOutputs
from gateway.sources.module_table import ModuleTable
from gateway.sources.mvn import MvnSource
from gateway.sources.source import SourceContext
from tests.patience import PATIENCE_S

DAY_NS = 86_400 * 10**9


def frame(skeleton, rng, sequence=0):
    """A body bent anyhow by up to a radian."""
    bent = [quaternion.from_rotation_vector(rng.uniform(-0.5, 0.5, 3)) for _ in skeleton.segment_names]
    q_wb = np.array([quaternion.multiply(skeleton.neutral, q) for q in bent])
    n = skeleton.n_segments
    p_w = joint_positions(skeleton.parents, skeleton.offsets, q_wb, np.array([1.0, 2.0, 0.9]))
    return SkeletonFrame(
        sequence=sequence, time_ns=DAY_NS + 12_345_678_901 + 10_000_000 * sequence, q_wb=q_wb,
        angular_rate=np.zeros((n, 3)), joint_acceleration=np.zeros((n, 3)), p_w=p_w, sigma=np.zeros(n),
        status=np.zeros(n, np.uint8), root=0,
    )  # fmt: skip


def read_back(rig, datagrams):
    """Orientations of segments as our own source gives them, in the axes of the rig's segments."""
    suit = load_rig(rig)
    source = MvnSource(SourceContext(suit, ModuleTable()))
    source.add_link("mvn", "mvn")
    readings = source.receive(Chunk(b"".join(datagrams), 10**18, "mvn"))
    rows = {suit.module_ids[row]: segment for segment, row in enumerate(suit.module_of_segment) if row >= 0}
    found = {}
    for reading in readings:
        assert isinstance(reading, FusedReading)
        segment = rows[reading.module]
        q_bs = quaternion.conjugate(suit.sensor_to_segment[segment])
        found[segment] = quaternion.multiply(np.array(reading.orientation), q_bs)
    return found


def test_segments_that_were_sent_are_read_by_the_source_as_they_were():
    skeleton = load_rig("mvn_fused_23").skeleton
    sent = frame(skeleton, np.random.default_rng(1))
    found = read_back("mvn_fused_23", MvnEncoder(skeleton, "lab").encode(sent)[:1])
    assert len(found) == 23
    for segment, q_wb in found.items():
        assert quaternion.angle_between(sent.q_wb[segment], q_wb) < 1e-6


def test_joint_angles_that_were_sent_give_the_same_bends():
    skeleton = load_rig("mvn_fused_23").skeleton
    sent = frame(skeleton, np.random.default_rng(2))
    found = read_back("mvn_fused_23", MvnEncoder(skeleton, "lab").encode(sent)[1:2])
    pelvis = SEGMENTS[0]
    root = skeleton.segment_names.index(pelvis)
    for segment, q_wb in found.items():
        expected = quaternion.multiply(quaternion.conjugate(sent.q_wb[root]), sent.q_wb[segment])
        bent = quaternion.multiply(quaternion.conjugate(found[root]), q_wb)
        assert quaternion.angle_between(expected, bent) < 1e-5


def test_a_body_of_fewer_segments_is_sent_whole_and_a_lost_segment_keeps_its_last_place():
    skeleton = load_rig("suit_17").skeleton
    encoder, rng = MvnEncoder(skeleton, "lab"), np.random.default_rng(3)
    first = frame(skeleton, rng)
    encoder.encode(first)
    lost = frame(skeleton, rng, 1)
    lost.q_wb[3] = np.nan
    (poses,) = MvnDecoder().feed(encoder.encode(lost)[0])
    assert [pose.segment for pose in poses.items] == list(range(1, 24))
    assert all(isinstance(pose, SegmentPose) for pose in poses.items)
    assert (poses.sample, poses.time_ms) == (1, 12_355)
    assert np.isfinite([pose.orientation for pose in poses.items]).all()


def test_somebody_who_stands_upright_has_unturned_segments_but_for_the_arms_and_no_bends():
    skeleton = load_rig("mvn_fused_23").skeleton
    upright = frame(skeleton, np.random.default_rng(4))
    upright.q_wb[:] = skeleton.neutral
    poses, joints, *_ = (
        MvnDecoder().feed(each)[0] for each in MvnEncoder(skeleton, "lab").encode(upright)[:2]
    )
    for pose in poses.items:
        name = SEGMENTS[pose.segment - 1]
        angle = math.degrees(2 * math.acos(min(1.0, abs(pose.orientation[0]))))
        assert angle == pytest.approx(90 if name.endswith(("arm", "hand")) else 0, abs=1e-3), name
    assert all(isinstance(joint, JointRotation) for joint in joints.items)
    assert np.allclose([joint.angles for joint in joints.items], 0.0, atol=1e-4)


def test_who_it_is_and_how_long_is_told_each_second():
    skeleton = load_rig("suit_17").skeleton
    encoder, rng = MvnEncoder(skeleton, "lab"), np.random.default_rng(5)
    kinds = [[each[4:6] for each in encoder.encode(frame(skeleton, rng, k))] for k in range(250)]
    assert [k for k, sent in enumerate(kinds) if b"13" in sent] == [0, 100, 200]
    assert all(sent[:3] == [b"02", b"20", b"25"] for sent in kinds)
    datagrams = MvnEncoder(skeleton, "lab").encode(frame(skeleton, rng))
    assert datagrams[2].endswith(b"00:00:12.345")
    assert b"name:lab\n" in datagrams[3]
    assert b"RightForeArm" in datagrams[4]
    assert all(len(each) < 1472 for each in datagrams)  # a network takes each whole


def test_a_body_that_is_no_persons_is_refused():
    with pytest.raises(OutputError, match=r"outputs.mvn: body 'robot_arm_4' is not a person's"):
        MvnEncoder(load_rig("robot_arm_4").skeleton, "lab")


async def test_datagrams_arrive_at_the_app(until):
    skeleton = load_rig("suit_17").skeleton
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as app:
        app.bind(("127.0.0.1", 0))
        app.settimeout(PATIENCE_S)
        settings = OutputsSettings(mvn={"port": app.getsockname()[1]})
        side = SideOutputs(settings, skeleton, "lab", 100.0)
        async with side.running():
            side.offer(frame(skeleton, np.random.default_rng(6)))
            await until(lambda: side.counters["mvn"].published == 1)
        assert [app.recv(2048)[:6] for _ in range(3)] == [b"MXTP02", b"MXTP20", b"MXTP25"]


async def test_over_tcp_the_gateway_connects_to_the_app_as_mvn_does_and_again_when_it_is_back(
    until, unused_port, monkeypatch, caplog
):
    monkeypatch.setattr(stream_sink, "AGAIN_S", 0.01)
    skeleton, rng = load_rig("mvn_fused_23").skeleton, np.random.default_rng(7)
    settings = OutputsSettings(mvn={"transport": "tcp", "port": unused_port})
    side = SideOutputs(settings, skeleton, "lab", 100.0)
    sequence = 0

    async def heard(link, decoder):
        """Offer poses until the app has read one whole."""
        nonlocal sequence
        reading = asyncio.ensure_future(anext(aiter(link)))
        async with asyncio.timeout(PATIENCE_S):
            while not reading.done():
                side.offer(frame(skeleton, rng, sequence := sequence + 2))
                await asyncio.sleep(0.001)
        return decoder.feed(reading.result().data)

    async with side.running():
        side.offer(frame(skeleton, rng))
        await until(lambda: side.counters["mvn"].dropped == 1)  # nobody listens yet
        for _ in range(2):
            app = link_from_url(f"tcp://127.0.0.1:{unused_port}?listen=1")
            await app.open()
            poses, *_ = await heard(app, MvnDecoder())
            assert [pose.segment for pose in poses.items] == list(range(1, 24))
            await app.close()
        assert side.counters["mvn"].published >= 2
    assert caplog.text.count("refused the connection: start what should listen there") >= 1


async def test_an_app_that_does_not_read_costs_poses_and_gets_no_old_ones(unused_port, monkeypatch):
    monkeypatch.setattr(stream_sink, "AGAIN_S", 0.01)
    skeleton, rng = load_rig("mvn_fused_23").skeleton, np.random.default_rng(8)
    with socket.create_server(("127.0.0.1", unused_port)) as listening:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        settings = OutputsSettings(mvn={"transport": "tcp", "port": unused_port, "rate": 1000})
        side = SideOutputs(settings, skeleton, "lab", 100.0)
        async with side.running():
            app, _ = await asyncio.to_thread(listening.accept)
            counters = side.counters["mvn"]
            while counters.dropped < 500 or not counters.published:
                side.offer(frame(skeleton, rng, counters.dropped + counters.published))
                await asyncio.sleep(0)
                counters = side.counters["mvn"]
            assert 0 < counters.published < 200  # what the system holds: a second or two of poses
            app.close()


async def test_a_host_that_nobody_knows_is_refused_over_tcp_too():
    skeleton = load_rig("mvn_fused_23").skeleton
    settings = OutputsSettings(mvn={"transport": "tcp", "host": "nobody.invalid"})
    side = SideOutputs(settings, skeleton, "lab", 100.0)
    with pytest.raises(OutputError, match=r"outputs\.mvn: no such host 'nobody\.invalid'"):
        async with side.running():
            pass


def test_a_transport_that_there_is_not_is_refused_with_those_that_there_are():
    with pytest.raises(ValidationError, match="'udp' or 'tcp'"):
        OutputsSettings(mvn={"transport": "sctp"})
