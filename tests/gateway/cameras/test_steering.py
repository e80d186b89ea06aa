"""Cameras told where the poses go."""

import numpy as np
import pytest

pytest.importorskip("cv2")

from devices.cameras.heat_map_messages import HeatMapMessage, HeatMapReceiver, encode_heat_maps
from devices.cameras.orders import read_orders
from gateway.body.skeleton import VideoSetUp
from gateway.cameras.live_crowd import AHEAD
from gateway.cameras.steering import Steering
from gateway.emulation.video_truth import messages_of, ring_of_cameras, walking
from gateway.reconstruction.video.keypoint_set import load_keypoint_set
from gateway.reconstruction.video.region import person_region
from gateway.reconstruction.video.sides import pairs_of

pytestmark = pytest.mark.timeout(600)  # whichever test comes first compiles

CAMERAS = ring_of_cameras(3)
KEYPOINTS = load_keypoint_set("blazepose_33")
WALKER = walking(KEYPOINTS, 8, (-0.3, 0.2), (0.5, 0.8))


def exchanged(message):
    """The message of a network that takes left for right."""
    read = HeatMapReceiver().receive(message)[0]
    names = KEYPOINTS.names
    rows = [names.index(n.replace("left", "@").replace("right", "left").replace("@", "right")) for n in names]
    return encode_heat_maps(
        type(read)(
            read.camera, read.network, read.sequence, read.time_ns, read.likelihood[rows], read.map_from_pixel
        )
    )


def squares_of(instant, camera):
    return read_orders(instant.orders, camera.name).squares


def test_regions_are_those_of_the_picture_to_come():
    steering = Steering(VideoSetUp(tuple(CAMERAS), "full"))
    for index, messages in enumerate(messages_of(CAMERAS, KEYPOINTS, WALKER)[: 8 - AHEAD]):
        instant = steering.take(messages)
        assert read_orders(instant.orders, "ring0").sequence == index + AHEAD
    for camera in CAMERAS:
        true = person_region(camera, WALKER.keypoints[-1], KEYPOINTS.names)
        x, y, size, _ = squares_of(instant, camera)[0]
        assert (x, y) == pytest.approx(tuple(true.centre), abs=0.03 * true.size)
        assert size == pytest.approx(true.size, rel=0.05)


def test_left_and_right_of_one_camera_are_put_back_and_of_most_are_left():
    instants = messages_of(CAMERAS, KEYPOINTS, WALKER)
    steering = Steering(VideoSetUp(tuple(CAMERAS), "full"))
    for instant in instants[:4]:
        steering.take(instant)
    wrong = [instants[4][0], exchanged(instants[4][1]), instants[4][2]]
    given = steering.take(wrong).messages[1]
    put_right, true = (HeatMapReceiver().receive(each[1])[0].likelihood for each in (given, instants[4]))
    cells = np.array([np.unravel_index(each.argmax(), each.shape) for each in true])
    apart = [pair for pair in pairs_of(KEYPOINTS.names) if np.ptp(cells[pair], axis=0).max() > 8]
    assert len(apart) >= 3
    assert all((put_right[pair] == true[pair]).all() for pair in apart)
    assert given[0] == instants[4][0]
    everywhere = [exchanged(message) for message in instants[5]]
    assert steering.take(everywhere).messages[1] == everywhere


def test_without_a_pose_cameras_follow_by_themselves():
    steering = Steering(VideoSetUp(tuple(CAMERAS), "full"))
    nobody = [
        encode_heat_maps(HeatMapMessage(camera.name, "full", 0, 0, None, np.zeros((2, 3))))
        for camera in CAMERAS
    ]
    assert all(squares_of(steering.take(nobody), camera) == {} for camera in CAMERAS)
