"""Whose heat maps are whose, at the start."""

from benchmarks.people_apart import people_apart
from gateway.emulation.video_truth import rendered, ring_of_cameras, true_regions, walking
from gateway.reconstruction.video.keypoint_set import load_keypoint_set
from gateway.reconstruction.video.projection import camera_model

CAMERAS = ring_of_cameras(4)
KEYPOINTS = load_keypoint_set("blazepose_33")


def test_detections_of_all_cameras_are_sorted_into_people():
    people = [walking(KEYPOINTS, 1, (x, 0.1), (1.0, 0.0)) for x in (-0.4, 0.5)]
    detections = []
    for c in range(4):
        found = [
            rendered(CAMERAS, true_regions(CAMERAS, KEYPOINTS, p.keypoints[0]), p.keypoints, 0).cameras[c]
            for p in people
        ]
        detections.append(found[:: -1 if c % 2 else 1] if c != 2 else found[:1])
    sorted_out = people_apart([camera_model(camera) for camera in CAMERAS], detections)
    assert len(sorted_out) == 2
    assert all(seen is not None for seen in sorted_out[0])
    for c in (0, 1, 3):
        assert sorted_out[0][c] is detections[c][c % 2]
        assert sorted_out[1][c] is detections[c][1 - c % 2]
    assert sorted_out[1][2] is None
