"""One served camera: whom it finds, whom it is told of, and what it does when nobody tells any more."""

import json
import socket

import numpy as np
import pytest

from devices.cameras.heat_map_messages import FOUND_BY_CAMERA, HeatMapReceiver
from devices.cameras.orders import CameraOrders, Joined, encode_orders, read_orders
from gateway.cameras.camera_process import CameraTask, messages_of
from gateway.cameras.people_follower import FollowingCameras, follower_of
from gateway.cameras.serving import Outlet
from gateway.emulation.video_truth import ring_of_cameras, true_regions, walking
from gateway.frames import CameraHeatMaps
from gateway.reconstruction.video.keypoint_set import load_keypoint_set
from gateway.reconstruction.video.region import square_of
from tests.served_cameras import Scene

KEYPOINTS = load_keypoint_set("blazepose_33")
CAMERA = ring_of_cameras(3)[0]


@pytest.fixture(scope="module")
def people():
    return np.stack(
        [walking(KEYPOINTS, 1, start, (0.4, 0.0)).keypoints[0] for start in ((-0.5, -0.6), (0.5, 0.6))]
    )


def follower(most):
    scene = Scene(CAMERA, KEYPOINTS)
    return follower_of(scene, scene, most)


def squares_of(people):
    return {k: square_of(*true_regions([CAMERA], KEYPOINTS, points)) for k, points in enumerate(people, 1)}


def test_people_have_numbers_of_the_camera_until_they_are_told(people):
    camera = follower(4)
    found = camera.heat_maps(people)
    assert sorted(found) == [FOUND_BY_CAMERA, FOUND_BY_CAMERA + 1]
    camera.take(CameraOrders(2, squares_of(people)))
    assert sorted(camera.heat_maps(people)) == [1, 2]
    camera.take(CameraOrders(3, {1: squares_of(people)[1], 2: None}))
    assert sorted(n for n in camera.heat_maps(people) if n < FOUND_BY_CAMERA) == [1]


def test_one_person_has_number_0_and_is_led_too(people):
    camera = follower(1)
    assert list(camera.heat_maps(people)) == [0]
    first, second = squares_of(people).values()
    for square, points in ((second, people[1]), (first, people[0])):
        camera.take(CameraOrders(2, {0: square}))
        assert list(camera.heat_maps(points[None])) == [0]
        (region,) = true_regions([CAMERA], KEYPOINTS, points)
        assert np.linalg.norm(camera._regions[0].centre - region.centre) < 0.1 * region.size
    camera.take(CameraOrders(3, {0: None}))
    assert camera.heat_maps(people) == {}
    camera.take(CameraOrders(4, {}))  # no pose is known any more: it looks for itself
    assert list(camera.heat_maps(people)) == [0]


@pytest.mark.parametrize("most", [1, 4])
def test_a_gateway_that_falls_silent_leaves_the_camera_to_itself(people, most):
    camera = follower(most)
    camera.take(CameraOrders(1, {0: None} if most == 1 else {1: None, 2: None, 3: None, 4: None}))
    assert camera.heat_maps(people) == {}
    for _ in range(65):
        found = camera.heat_maps(people)
    assert len(found) == (1 if most == 1 else 2)


def test_nobody_is_a_message_and_the_last_of_a_picture_is_told(people):
    task = CameraTask("a", "", "full")
    (nobody,) = HeatMapReceiver().receive(messages_of({}, task, 7, 8))
    assert (nobody.person, nobody.following, nobody.likelihood) == (0, 0, None)
    maps = follower(4).heat_maps(people)
    read = HeatMapReceiver().receive(messages_of(maps, task, 7, 8))
    assert [each.following for each in read] == [1, 0]
    assert [each.person for each in read] == list(maps)


def test_the_newest_orders_come_back_over_the_connection():
    listener = socket.create_server(("127.0.0.1", 0))
    outlet = Outlet(listener)
    line = encode_orders(5, {"a": {1: None}})
    with socket.create_connection(listener.getsockname(), timeout=20) as gateway:
        outlet.wait_for_first()
        assert outlet.newest_line() == b""
        gateway.sendall(b"rubbish\n" + encode_orders(4, {"a": {}}) + line + line[:9])
        gateway.setblocking(True)
        for _ in range(1000):
            if told := outlet.newest_line():
                break
        assert told == line.strip()
        assert outlet.newest_line() == b""
    outlet.close()
    listener.close()


def test_somebody_partly_in_either_picture_is_seen_in_both_at_once():
    """The gateway tells one camera of its neighbour: the network sees both pictures once, each gets its
    cells."""

    class Network:
        keypoints = KEYPOINTS.names
        looks = 0

        def heat_maps(self, picture, region):
            self.looks += 1
            return CameraHeatMaps(np.ones((33, 64, 64), np.float32), region.affine(64))

    network = Network()
    cameras = FollowingCameras(["left", "right"], network, Scene(CAMERA, KEYPOINTS), 4)
    square = (100.0, 50.0, 80.0, 0.0)
    joined = {"left": {1: Joined("right", (1.0, 0.0, 100.0, 0.0, 1.0, 0.0))}}
    cameras.take(
        encode_orders(
            2, {"left": {1: square, 2: None, 3: None, 4: None}, "right": dict.fromkeys(range(1, 5))}, joined
        )
    )
    picture = np.zeros((100, 100, 3), np.uint8)
    left, right = cameras.heat_maps([picture, picture])
    assert network.looks == 1
    assert (sorted(left), sorted(right)) == ([1], [1])
    assert 0.4 < left[1].likelihood.mean() < 0.6
    assert left[1].likelihood.mean() + right[1].likelihood.mean() == pytest.approx(1.0)
    assert right[1].map_from_pixel @ [0, 50, 1] == pytest.approx(left[1].map_from_pixel @ [100, 50, 1])
    for bad in ([["right", 1.0]], [3, *range(6)], ["right", *[float("nan")] * 6]):
        assert (
            read_orders(
                json.dumps(
                    {"sequence": 1, "cameras": {"left": {"1": square}}, "joined": {"left": {"1": bad}}}
                ).encode(),
                "left",
            )
            is None
        )
