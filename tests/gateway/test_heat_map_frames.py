"""Heat-map messages through the pipeline: put together by instant, solved, recorded, replayed."""

import numpy as np
import pytest

from devices.cameras.heat_map_messages import HeatMapMessage, encode_heat_maps
from devices.link import Chunk
from gateway.body.rig import load_rig
from gateway.body.subject_file import write_subject
from gateway.contract.balances import unaccounted
from gateway.errors import GatewayError, SettingsError
from gateway.pipeline import Pipeline
from gateway.recording.reading import open_recording
from gateway.recording.solving import verify
from gateway.recording.video import (
    LINK,
    video_chunks,
    video_settings,
    video_subject,
    video_suit,
    write_offline_video,
    write_solved_video,
)
from gateway.service.accounting import balances_of
from tests.seen_walk import CAMERAS, seen_walk

RATE = 60.0
N = 14


@pytest.fixture(scope="module")
def messages():
    """A walker before three cameras, by instant."""
    return seen_walk(N)


@pytest.fixture(scope="module")
def suit(messages):
    return video_suit(CAMERAS, "full", messages[0])


def pipeline_of(suit):
    pipeline = Pipeline.from_settings(video_settings("walker", RATE), suit)
    pipeline.add_link(LINK, "heat_maps")
    return pipeline


def instants(pipeline):
    """Count the instants that were put together."""
    return next(each.total for each in pipeline.balances() if each.name == "frames")


def test_a_recording_replays_bit_for_bit_and_is_the_walker(messages, suit, tmp_path):
    instants, person = messages
    done = write_solved_video(instants, RATE, suit, "walker", tmp_path / "walk.mcap")
    assert done.frames == N
    recording = open_recording(tmp_path / "walk.mcap")
    assert verify(recording).difference is None
    frames = list(recording.skeleton_frames())
    assert [frame.sequence for frame in frames] == list(range(N))
    knee = suit.skeleton.index("left_shank")
    off = [np.linalg.norm(f.p_w[knee] - person.joints[f.sequence, knee]) for f in frames]
    assert np.median(off) < 0.04
    assert recording.meta.suit.video.network == "full"
    assert (recording.meta.suit.video.cameras[1].rotation == CAMERAS[1].rotation).all()


def test_offline_poses_are_recorded_as_such(messages, suit, tmp_path):
    write_offline_video(messages[0], RATE, suit, "walker", tmp_path / "walk.mcap")
    recording = open_recording(tmp_path / "walk.mcap")
    assert recording.meta.solved_by == "offline"
    assert len(list(recording.skeleton_frames())) == N


def test_messages_of_one_camera_a_chunk_give_the_same_poses(messages, suit):
    """As separate connections bring them, the third camera late by one instant."""
    whole, apart = pipeline_of(suit), pipeline_of(suit)
    chunks = video_chunks(messages[0], RATE)[:N]
    expected = [frame for chunk in chunks for frame in whole.feed(chunk)]
    order = [(t, c) for t in range(N) for c in (0, 1)] + [(t, 2) for t in range(N)]
    order.sort(key=lambda each: each[0] + (each[1] == 2))
    found = []
    for t, c in order:
        found += apart.feed(Chunk(messages[0][t][c], chunks[t].arrived_ns, LINK))
    assert len(found) == len(expected)
    assert all((a.p_w == b.p_w).all() for a, b in zip(found, expected, strict=True))


def test_a_camera_that_falls_silent_is_gone_on_without(messages, suit):
    """Three instants wait for it at first; once it has been silent for a second, no more."""
    pipeline = pipeline_of(suit)
    made, times = [], [round(t * 1e9 / 8) for t in range(N)]
    for t, arrived in enumerate(times):
        data = b"".join(messages[0][t] if t < 2 else messages[0][t][:2])
        made += pipeline.feed(Chunk(data, arrived, LINK))
        # silent since 0.125 s: from the chunk at 1.125 s on nothing waits
        assert instants(pipeline) == (t + 1 if t >= 9 or t < 2 else max(t - 2, 2)), t
    assert pipeline.statistics()["video"]["incomplete"] == N - 2
    assert np.isfinite(made[-1].p_w).all()
    assert unaccounted(balances_of(pipeline, {}, None, {})) == {}


def test_a_lost_message_holds_nothing_up(messages, suit):
    pipeline = pipeline_of(suit)
    for t in range(6):
        data = b"".join(messages[0][t] if t != 3 else messages[0][t][:2])
        pipeline.feed(Chunk(data, t, LINK))
        assert instants(pipeline) == (3 if t == 3 else t + 1)
    assert pipeline.statistics()["video"]["incomplete"] == 1


def test_films_that_are_served_again_are_taken_again(messages, suit):
    pipeline = pipeline_of(suit)
    for turn in range(2):
        for t in range(10):
            pipeline.feed(Chunk(b"".join(messages[0][t]), 10**9 * turn + t, LINK))
    statistics = pipeline.statistics()["video"]
    assert (instants(pipeline), statistics["begun_anew"], statistics["dropped"]) == (20, 1, {})


def test_what_does_not_belong_is_dropped_counted_and_logged_once(messages, suit, caplog):
    pipeline = pipeline_of(suit)

    def feed(**changes):
        content = {"camera": "ring0", "network": "full", "sequence": 5, "time_ns": 0, "likelihood": None}
        content |= {"map_from_pixel": np.zeros((2, 3))} | changes
        pipeline.feed(Chunk(encode_heat_maps(HeatMapMessage(**content)), 10, LINK))

    for _ in range(3):
        feed(camera="another")
    feed(network="openpose")
    feed(person=2)
    for camera in CAMERAS:
        feed(camera=camera.name)
    feed(sequence=2)
    assert pipeline.statistics()["video"]["dropped"] == {
        "unknown_camera": 3, "other_network": 1, "too_late": 1,
    }  # fmt: skip
    first, second, third = caplog.messages
    assert "camera 'another' is not in the rig: serve it with the --name of one (ring0, " in first
    assert "sends keypoints of 'openpose', and the rig is for 'full'" in second
    assert "camera 'ring0' tells of several people: set 'people' in the configuration" in third


def test_a_subject_file_stands_in_a_rigs_place(suit, tmp_path):
    write_subject(tmp_path / "anna.yaml", video_subject("anna", suit))
    found = load_rig(str(tmp_path / "anna.yaml"))
    assert found.video.network == "full"
    assert found.markers.labels == suit.markers.labels
    for a, b in zip(found.video.cameras, CAMERAS, strict=True):
        assert (a.matrix == b.matrix).all()
        assert (a.translation == b.translation).all()


def test_heat_maps_without_cameras_are_refused(suit):
    settings = video_settings("suit_17", RATE).model_copy(update={"reconstructor": "independent"})
    with pytest.raises(SettingsError, match="link 'cameras' carries heat maps: the rig has no cameras"):
        Pipeline.from_settings(settings, load_rig("suit_17"))


def test_a_scene_without_anybody_is_told():
    nobody = [
        [encode_heat_maps(HeatMapMessage(c.name, "full", t, t, None, np.zeros((2, 3)))) for c in CAMERAS]
        for t in range(3)
    ]
    with pytest.raises(GatewayError, match="in 3 pictures of 3 cameras nobody is seen"):
        video_suit(CAMERAS, "full", nobody)


def test_a_subject_of_other_keypoints_is_refused(messages, suit):
    with pytest.raises(GatewayError, match="no keypoints of the network 'openpose'"):
        video_suit(CAMERAS, "openpose", messages[0], suit)
