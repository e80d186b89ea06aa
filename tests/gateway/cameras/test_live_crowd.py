"""Several people before served cameras, who come and go."""

from __future__ import annotations

import numpy as np
import pytest

from devices.cameras.heat_map_messages import HeatMapReceiver
from devices.link import Chunk
from gateway.body.skeleton import VideoSetUp
from gateway.cameras.live_crowd import LiveCrowd
from gateway.emulation.video_truth import RATE_HZ, ring_of_cameras, walking
from gateway.frames import HeatMapFrame
from gateway.reconstruction.video.keypoint_set import load_keypoint_set
from gateway.reconstruction.video.reconstructor import video_reconstructor
from gateway.sources.heat_maps import heat_maps_of
from tests.served_cameras import ServedCameras

KEYPOINTS = load_keypoint_set("blazepose_33")
CAMERAS = ring_of_cameras(4)


class Played:
    """A crowd before cameras, instant by instant."""

    def __init__(self, most: int = 4, is_shared: bool = True) -> None:
        self.is_shared = is_shared
        self.crowd = LiveCrowd(VideoSetUp(tuple(CAMERAS), "full"), most)
        self.cameras = ServedCameras(CAMERAS, KEYPOINTS, most)
        self.persons, self.places = {}, {}
        self.left = {}
        self.sequence = 0

    def show(self, people, without=()):
        """One instant of people's keypoints; without: rows of cameras that are silent."""
        now_ns = round(self.sequence * 1e9 / RATE_HZ)
        everybody = np.array(people).reshape(len(people), len(KEYPOINTS.names), 3)
        for row, message in enumerate(self.cameras.messages(everybody, self.sequence)):
            if row in without:
                continue
            for step in self.crowd.receive(Chunk(message, now_ns, f"camera{row}")):
                for number, suit in step.entered.items():
                    self.persons[number] = video_reconstructor(suit)
                    if self.is_shared:
                        self.crowd.solved_by(number, self.persons[number])
                for number, data in step.chunks.items():
                    maps = tuple(map(heat_maps_of, HeatMapReceiver().receive(data)))
                    pose = self.persons[number].update(HeatMapFrame(self.sequence, now_ns, maps))
                    self.places[number] = pose.keypoints
                self.left |= dict.fromkeys(step.left, self.sequence)
                self.cameras.take(step.orders)
        self.sequence += 1


def apart(played, number, points):
    return np.median(np.linalg.norm(played.places[number] - points, axis=1))


@pytest.fixture(scope="module")
def people():
    return [
        walking(KEYPOINTS, 200, (-0.7, -0.4), (0.4, 0.0)).keypoints,
        walking(KEYPOINTS, 200, (0.8, 0.5), (-0.4, 0.1), phase=1.0).keypoints,
        walking(KEYPOINTS, 200, (0.0, -1.2), (0.0, 0.3), phase=2.0).keypoints,
    ]


def test_people_come_and_go_and_keep_their_numbers(people):
    a, b, c = people
    played = Played()
    for f in range(40):
        played.show([a[f]])
    assert played.crowd.present == [1]
    for f in range(40, 80):
        played.show([a[f], b[f]])
    assert played.crowd.present == [1, 2]
    assert apart(played, 1, a[79]) < 0.02
    assert apart(played, 2, b[79]) < 0.02
    for f in range(80, 125):
        played.show([b[f]])
    assert played.crowd.present == [2]
    assert list(played.left) == [1]
    assert 80 < played.left[1] <= 115
    for f in range(125, 165):
        played.show([b[f], c[f]])
    assert played.crowd.present == [2, 3]
    assert apart(played, 2, b[164]) < 0.02
    assert apart(played, 3, c[164]) < 0.02
    for _ in range(40):
        played.show([])
    assert played.crowd.present == []
    assert played.crowd.statistics()["left"] == 3


def test_cameras_follow_under_the_gateways_numbers_alone_once_they_are_told(people):
    a, b, _ = people
    played = Played()
    for f in range(30):
        played.show([a[f], b[f]])
    for follower in played.cameras.followers:
        assert sorted(follower._regions) == [1, 2]


def test_a_camera_that_vanishes_and_comes_back_costs_nobody(people):
    a, b, _ = people
    played = Played()
    for f in range(130):
        played.show([a[f], b[f]], without=(2,) if 40 <= f < 90 else ())
    assert played.crowd.present == [1, 2]
    assert apart(played, 1, a[129]) < 0.03
    assert played.crowd.statistics()["left"] == 0


def test_no_more_are_tracked_than_wanted_and_one_camera_alone_finds_nobody(people):
    a, b, c = people
    played = Played(most=2)
    for f in range(40):
        played.show([a[f], b[f], c[f]])
    assert len(played.crowd.present) == 2
    alone = Played()
    for f in range(40):
        alone.show([a[f]], without=(1, 2, 3))
    assert alone.crowd.present == []
    assert alone.crowd.statistics()["given_up"] == 0
