"""Cameras told where the poses go."""

import numpy as np
import pytest

pytest.importorskip("cv2")

from devices.cameras.heat_map_messages import HeatMapReceiver, encode_heat_maps
from gateway.cameras.steering import AHEAD, Steering
from gateway.emulation.video_truth import messages_of, ring_of_cameras, walking
from gateway.reconstruction.video.keypoint_set import load_keypoint_set
from gateway.reconstruction.video.regions import person_region
from gateway.reconstruction.video.sides import pairs_of

pytestmark = pytest.mark.timeout(600)  # whichever test comes first compiles

CAMERAS = ring_of_cameras(3)
KEYPOINTS = load_keypoint_set("blazepose_33")
WALKER = walking(KEYPOINTS, 8, (-0.3, 0.2), (0.5, 0.8))
OTHER = walking(KEYPOINTS, 8, (0.6, -0.4), (-0.5, -0.8), phase=1.0)


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


def test_regions_are_those_of_the_picture_to_come():
    steering = Steering(CAMERAS, KEYPOINTS, 2)
    both = [messages_of(CAMERAS, KEYPOINTS, person) for person in (WALKER, OTHER)]
    for instant in zip(*both, strict=True):
        before = steering.orders()
        steering.take(list(instant))
    assert all(order.is_ordered for of_camera in before for order in of_camera)
    for person, known in enumerate((WALKER, OTHER)):
        for camera, orders in zip(CAMERAS, before, strict=True):
            true = person_region(camera, known.keypoints[6 + AHEAD - 1], KEYPOINTS.names)
            assert orders[person].region.centre == pytest.approx(true.centre, abs=0.03 * true.size)
            assert orders[person].region.size == pytest.approx(true.size, rel=0.05)


def test_left_and_right_of_one_camera_are_put_back_and_of_most_are_left():
    instants = messages_of(CAMERAS, KEYPOINTS, WALKER)
    steering = Steering(CAMERAS, KEYPOINTS, 1)
    for instant in instants[:4]:
        steering.take([instant])
    wrong = [instants[4][0], exchanged(instants[4][1]), instants[4][2]]
    (given,) = steering.take([wrong])
    put_right, true = (HeatMapReceiver().receive(each[1])[0].likelihood for each in (given, instants[4]))
    cells = np.array([np.unravel_index(each.argmax(), each.shape) for each in true])
    apart = [pair for pair in pairs_of(KEYPOINTS.names) if np.ptp(cells[pair], axis=0).max() > 8]
    assert len(apart) >= 3
    assert all((put_right[pair] == true[pair]).all() for pair in apart)
    assert given[0] == instants[4][0]
    everywhere = [exchanged(message) for message in instants[5]]
    assert steering.take([everywhere])[0] == everywhere


def test_without_a_pose_cameras_follow_by_themselves():
    steering = Steering(CAMERAS, KEYPOINTS, 1)
    assert not any(order.is_ordered for (order,) in steering.orders())
    assert np.all([order.region is None for (order,) in steering.orders()])
