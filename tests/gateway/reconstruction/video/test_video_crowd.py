"""Who takes what out of whose heat maps, and whose tracker counts."""

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest

from gateway.emulation.video_truth import rendered, ring_of_cameras, true_regions, walking
from gateway.frames import FloatArray, HeatMapFrame
from gateway.reconstruction.video.crowd import VideoCrowd, _Followed
from gateway.reconstruction.video.keypoint_set import load_keypoint_set

KEYPOINTS = load_keypoint_set("blazepose_33")
CAMERAS = ring_of_cameras(3)


@dataclass
class Tracker:
    """Somebody at known places."""

    places: FloatArray
    lost: float = 0.0
    pose: object = "known"
    tracked: int = 0

    def expected_after(self, frames):
        return self.places

    def put_right(self, maps):
        return maps

    def track(self, maps):
        self.tracked += 1


@pytest.mark.parametrize("is_shown", [True, False])
def test_only_whom_cameras_show_takes_something_out_of_others_maps(is_shown):
    first, second = (walking(KEYPOINTS, 1, start, (0.4, 0.0)).keypoints[0] for start in ((0, 0), (0.1, 0.1)))
    crowd = VideoCrowd(CAMERAS, KEYPOINTS, 2)
    trackers = [Tracker(first), Tracker(second, lost=0.0 if is_shown else 0.9)]
    for each, tracker in zip(crowd._people, trackers, strict=True):
        each.tracker = tracker
    maps = rendered(CAMERAS, true_regions(CAMERAS, KEYPOINTS, first), np.stack([first, second]), 0).cameras
    frame = HeatMapFrame(0, 0, tuple(maps))
    masked = crowd.masked([frame, frame])[0]
    same = [np.array_equal(a.likelihood, b.likelihood) for a, b in zip(masked.cameras, maps, strict=True)]
    assert same == [not is_shown] * len(CAMERAS)


def test_a_solver_is_taken_once_it_is_up_to_date_and_sees_as_much():
    own = Tracker(np.zeros((33, 3)))
    solver = SimpleNamespace(tracker=Tracker(np.ones((33, 3)), lost=0.5), sequence=10)
    person = _Followed(own, solver)

    def follow(sequence):
        person.follow(HeatMapFrame(sequence, 0, ()))
        return person.tracker is solver.tracker

    solver.tracker.lost = 0.0
    assert not any(follow(sequence) for sequence in range(20, 30))  # its service starts, and instants wait
    solver.sequence, solver.tracker.lost = 29, 0.5
    assert not follow(30)
    solver.tracker.lost, solver.tracker.pose = 0.0, None
    assert not follow(31)
    assert own.tracked == 12
    solver.tracker.pose = "known"
    assert follow(31)
    assert follow(40)
    assert (own.tracked, solver.tracker.tracked) == (13, 0)
