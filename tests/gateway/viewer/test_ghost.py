"""A second recording on the page, pale beside the first."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gateway.body.body_file import load_body
from gateway.errors import GatewayError
from gateway.frames import Status
from gateway.geometry import quaternion
from gateway.recording import SkeletonArrays

viser = pytest.importorskip("viser", reason="the extra 'viewer' is not installed")

from gateway.viewer.ghost import later_s  # noqa: E402 - needs the extra
from gateway.viewer.playback import Playback  # noqa: E402 - needs the extra

N_FRAMES, STEP_NS = 50, 20_000_000
QUARTER = quaternion.from_rotation_vector(np.array([0.0, 0.0, np.pi / 2]))


def standing(first_ns=0, turn=None):
    """A second of a person who stands; turned about the vertical."""
    skeleton = load_body("human_17")
    n = skeleton.n_segments
    q = skeleton.neutral if turn is None else quaternion.multiply(turn, skeleton.neutral)
    nothing = np.full((N_FRAMES, n, 3), np.nan)
    return SkeletonArrays(
        time_ns=first_ns + STEP_NS * np.arange(N_FRAMES),
        sequence=np.arange(N_FRAMES),
        q_wb=np.tile(q, (N_FRAMES, n, 1)),
        p_w=np.zeros((N_FRAMES, n, 3)),
        angular_rate=nothing,
        joint_acceleration=nothing,
        sigma=np.full((N_FRAMES, n), 0.01),
        status=np.full((N_FRAMES, n), Status.MEASURED, np.uint8),
        skeleton=skeleton,
    )


@pytest.fixture
def server():
    server = viser.ViserServer("127.0.0.1", 0, verbose=False)
    yield server
    server.stop()


def test_it_stands_where_the_other_does_and_turns_as_its_own_recording_says(server):
    playback = Playback(server, standing(), "one", compared=standing(turn=QUARTER))
    playback.advance(0.1)
    ghost = playback._ghost
    assert ghost._bodies.visible
    shown, plain = ghost._bodies.batched_wxyzs, playback._body.scene._bodies
    same = Playback(server, standing(), "one", compared=standing())
    same.advance(0.1)
    turned = [quaternion.multiply(QUARTER, np.asarray(q, float)) for q in same._ghost._bodies.batched_wxyzs]
    assert np.abs(np.sum(np.array(turned) * shown, axis=1)) == pytest.approx(np.ones(len(turned)), abs=1e-5)
    root = np.asarray(ghost._bodies.batched_positions)[:, 2]
    assert root.min() > -0.1
    assert plain is not ghost._bodies


def test_recordings_of_the_same_time_are_shown_at_the_same_instants(server):
    later = standing(first_ns=500_000_000)
    assert later_s(later, standing()) == pytest.approx(0.5)
    playback = Playback(server, standing(), "one", compared=later)
    playback.advance(0.3)
    assert not playback._ghost._bodies.visible
    playback.advance(0.4)
    assert playback._ghost._bodies.visible


def test_recordings_of_other_times_begin_together():
    assert later_s(standing(first_ns=10**12), standing()) == 0.0
    assert later_s(standing(), standing(first_ns=10**12)) == 0.0


def test_it_stands_at_its_own_place_when_that_is_wanted(server):
    here, there = (replace(standing(), p_w=np.full((N_FRAMES, 17, 3), metres)) for metres in (1.0, 3.0))
    playback = Playback(server, here, "one", compared=there)
    playback.advance(0.1)
    beside = np.array(playback._ghost._bodies.batched_positions)
    playback._ghost._is_apart.value = True
    playback.advance(0.1)
    apart = np.array(playback._ghost._bodies.batched_positions)
    assert apart - beside == pytest.approx(np.full_like(beside, 2.0), abs=1e-4)


def test_it_is_hidden_when_it_is_not_wanted(server):
    playback = Playback(server, standing(), "one", compared=standing())
    playback.advance(0.1)
    playback._ghost._is_wanted.value = False
    playback.advance(0.1)
    assert not playback._ghost._bodies.visible


def test_bodies_that_share_no_segment_are_refused(server):
    other = standing()
    names = tuple(f"link_{s}" for s in range(other.skeleton.n_segments))
    skeleton = replace(other.skeleton, segment_names=names)
    with pytest.raises(GatewayError, match="nothing to compare"):
        Playback(server, standing(), "one", compared=replace(other, skeleton=skeleton))
