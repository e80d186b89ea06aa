"""A walker before three simulated cameras, as heat-map messages."""

from gateway.emulation.video_truth import KnownPerson, messages_of, ring_of_cameras, walking
from gateway.reconstruction.video.keypoint_set import load_keypoint_set

CAMERAS = ring_of_cameras(3)


def seen_walk(n: int) -> tuple[list[list[bytes]], KnownPerson]:
    """By instant a message a camera, n of them, and the walker."""
    keypoints = load_keypoint_set("blazepose_33")
    person = walking(keypoints, n, (-0.2, 0.1), (1.0, 0.2))
    return messages_of(CAMERAS, keypoints, person), person
