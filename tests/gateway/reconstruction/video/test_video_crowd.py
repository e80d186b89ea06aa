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


def test_a_solver_is_taken_once_it_is_up_to_date():
    own, places = Tracker(np.zeros((33, 3))), np.ones((33, 3))
    solver = SimpleNamespace(tracker=Tracker(places), sequence=-1)
    person = _Followed(own, solver)
    for sequence in range(20, 30):
        person.follow(HeatMapFrame(sequence, 0, ()))
        solver.sequence = 10  # its service starts, and the instants wait
    assert person.tracker is own
    assert own.tracked == 10
    solver.sequence = 29
    person.follow(HeatMapFrame(30, 0, ()))
    assert person.tracker is solver.tracker
    person.follow(HeatMapFrame(40, 0, ()))
    assert person.tracker is solver.tracker
    assert own.tracked == 10
