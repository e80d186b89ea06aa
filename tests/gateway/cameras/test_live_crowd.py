"""Several people before served cameras, who come and go."""

from __future__ import annotations

import numpy as np
import pytest

from devices.cameras.heat_map_messages import HeatMapReceiver
from devices.link import Chunk
from gateway.body.skeleton import VideoSetUp
from gateway.cameras.filmed_people import FilmedPeople
from gateway.cameras.live_crowd import LiveCrowd
from gateway.emulation.video_truth import RATE_HZ, ring_of_cameras, walking
from gateway.frames import HeatMapFrame
from gateway.reconstruction.video.keypoint_set import load_keypoint_set
from gateway.reconstruction.video.reconstructor import video_reconstructor
from gateway.recording.video import video_suit
from gateway.sources.heat_maps import heat_map_frame, heat_maps_of
from tests.served_cameras import Scene, ServedCameras, TwiceScene

KEYPOINTS = load_keypoint_set("blazepose_33")
CAMERAS = ring_of_cameras(4)


class Played:
    """A crowd before cameras, instant by instant."""

    def __init__(self, most: int = 4, scene: type[Scene] = Scene) -> None:
        self.crowd = LiveCrowd(VideoSetUp(tuple(CAMERAS), "full"), most)
        self.cameras = ServedCameras(CAMERAS, KEYPOINTS, most, scene)
        self.persons, self.places, self.maps = {}, {}, {}
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
                    self.crowd.solved_by(number, self.persons[number])
                for number, messages in step.messages.items():
                    maps = tuple(map(heat_maps_of, HeatMapReceiver().receive(b"".join(messages))))
                    self.maps[number] = maps
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
        0.9 * walking(KEYPOINTS, 200, (0.0, -1.2), (0.0, 0.3), phase=2.0).keypoints,  # of another size
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


def test_somebody_who_has_entered_is_tracked_by_their_solver_alone(people):
    a, b, _ = people
    played = Played()
    for f in range(50):
        played.show([a[f], b[f]])
    assert played.crowd.present == [1, 2]
    trackers = played.crowd._crowd.trackers
    assert trackers == [played.persons[number].tracker for number in (1, 2)]
    apart_m = [apart(played, 1, points[49]) for points in (a, b)]
    assert min(apart_m) < 0.02


def test_who_comes_back_soon_is_known_again_and_a_stranger_is_not(people):
    a, _, _ = people
    smaller = 0.9 * walking(KEYPOINTS, 200, (-0.7, -0.4), (0.4, 0.0)).keypoints
    for back, number in ((a, 1), (smaller, 2)):
        played = Played()
        for f in range(40):
            played.show([a[f]])
        for _ in range(40):
            played.show([])
        assert played.crowd.present == []
        for f in range(80, 125):
            played.show([back[f]])
        assert played.crowd.present == [number]
        assert apart(played, number, back[124]) < 0.02
    for _ in range(40):
        played.show([])
    assert played.crowd.statistics()["returned"] == 0


def test_who_stands_where_somebody_is_missed_takes_their_number_before_they_are_given_up(people):
    """A camera's picture may be wrong for a moment: the person seems to be elsewhere, and is found anew."""
    a, b, _ = people
    video = VideoSetUp(tuple(CAMERAS), "full")
    crowd, cameras, filmed = (
        LiveCrowd(video, 4),
        ServedCameras(CAMERAS, KEYPOINTS, 4),
        FilmedPeople(video, RATE_HZ),
    )
    left, entered = [], []
    for f in range(120):
        shown = [a[f], b[f]] if not 50 <= f < 58 else [b[f]]
        instant = crowd.take(cameras.messages(np.array(shown), f))
        filmed.add(instant)
        left += instant.left
        entered += instant.entered
        if f == 57:  # it is led astray
            tracker = crowd._crowd.trackers[0]
            tracker.pose = tracker.pose._replace(root=tracker.pose.root + np.array([0.0, 0.0, 1.5]))
            tracker._places = []
        cameras.take(instant.orders)
    assert sorted(entered) in ([1, 2], [1, 1, 2])
    assert sorted(crowd.present) == [1, 2]
    assert [len(person) for person in filmed.people] == [120, 120]


def test_whoever_comes_into_a_film_later_is_recorded_from_where_they_were_found(people):
    """Two people, of whom the second comes later and the first leaves: as `video solve --people 2`."""
    a, b, _ = people
    video = VideoSetUp(tuple(CAMERAS), "full")
    crowd, cameras, filmed = (
        LiveCrowd(video, 2),
        ServedCameras(CAMERAS, KEYPOINTS, 2),
        FilmedPeople(video, RATE_HZ),
    )
    for f in range(110):
        shown = [points[f] for points, first, last in ((a, 0, 60), (b, 30, 110)) if first <= f < last]
        instant = crowd.take(cameras.messages(np.array(shown), f))
        filmed.add(instant)
        cameras.take(instant.orders)
    first, second = filmed.people
    assert 60 <= len(first) < 60 + 20  # without the instants in which they were waited for
    assert len(second) == 110
    shown = [any(each is not None for each in heat_map_frame(0, instant).cameras) for instant in second]
    assert shown.index(True) in range(30, 36)
    assert all(shown[36:])
    sequences = [HeatMapReceiver().receive(instant[0])[0].sequence for instant in second]
    assert sequences == list(range(110))
    for messages, truth, last in ((first, a, 59), (second, b, 109)):
        reconstructor = video_reconstructor(video_suit(CAMERAS, "full", messages))
        for f, instant in enumerate(messages[: last + 1]):
            pose = reconstructor.update(heat_map_frame(f, instant))
        assert np.median(np.linalg.norm(pose.keypoints - truth[last], axis=1)) < 0.02


def test_somebody_found_twice_is_one_person_whose_maps_are_whole(people):
    """Both are led to one body, and take it out of each other's maps until one of them is given up."""
    a, _, _ = people
    played = Played(scene=TwiceScene)
    played.show([a[0]])
    assert len(played.crowd._tracked) == 2
    for f in range(1, 70):
        played.show([a[f]])
    assert played.crowd.present == [1]
    assert len(played.crowd._tracked) == 1
    assert played.crowd.statistics()["given_up"] == 1
    assert apart(played, 1, a[69]) < 0.02
    likelihoods = [maps.likelihood.max(axis=(1, 2)) for maps in played.maps[1] if maps is not None]
    assert len(likelihoods) == len(CAMERAS)
    assert np.min(likelihoods) > 0.7
