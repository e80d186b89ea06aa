"""Cameras in processes of their own, and who is followed by them."""

import os
import signal
import socket
import threading
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("cv2")

from devices.cameras.heat_map_messages import HeatMapMessage, HeatMapReceiver, encode_heat_maps
from devices.cameras.pictures import CameraError, PictureInfo
from gateway.body.camera import project
from gateway.cameras.camera_process import CameraProcess, CameraTask
from gateway.cameras.people_matching import matched_people, person_in_common
from gateway.cameras.rig_of_cameras import check_agreement
from gateway.cameras.serving import Outlet
from gateway.cli.video import moment
from gateway.errors import GatewayError
from gateway.reconstruction.video.networks.person_detector import Person
from tests.ring_of_cameras import CAMERAS


def person(seen_by, place, score=0.9):
    hips, shoulders = project(seen_by, np.array(place) + np.array([[0, 0, 0.9], [0, 0, 1.4]]))
    return Person(score, hips, shoulders, 2.0 * float(np.linalg.norm(hips - shoulders)))


def test_the_person_that_all_cameras_see_is_taken_and_not_the_bystander():
    walker, bystander = (0.2, 0.1, 0.0), (-0.9, 0.8, 0.0)
    people = [[person(c, walker)] for c in CAMERAS]
    people[0].insert(0, person(CAMERAS[0], bystander, 0.99))
    people[1].insert(0, person(CAMERAS[1], bystander, 0.99))
    chosen = person_in_common(CAMERAS, people)
    for c, region in zip(CAMERAS, chosen, strict=True):
        assert region is not None
        assert region.centre == pytest.approx(person(c, walker).hips)


def test_a_camera_without_the_person_is_left_out():
    people = [[person(c, (0.0, 0.0, 0.0))] for c in CAMERAS]
    people[2] = [person(CAMERAS[2], (1.0, -0.9, 0.0))]
    chosen = person_in_common(CAMERAS, people)
    assert [region is None for region in chosen] == [False, False, True, False]


def test_nobody_in_one_picture_only_is_nobody():
    assert person_in_common(CAMERAS, [[], [], [person(CAMERAS[2], (0, 0, 0))], []]) == [None] * 4


def test_people_are_told_apart_whatever_order_the_cameras_see_them_in():
    places = [(0.4, 0.3, 0.0), (-0.6, -0.4, 0.0)]
    people = [[person(c, places[(n + k) % 2]) for k in range(2)] for n, c in enumerate(CAMERAS)]
    people[0].append(person(CAMERAS[0], (-1.5, 1.0, 0.0)))  # seen by nobody else
    found = list(matched_people(CAMERAS, people))
    assert len(found) == 2
    for chosen in found:
        hips = [each.hips for each in chosen]
        place = min(places, key=lambda at: np.linalg.norm(hips[0] - person(CAMERAS[0], at).hips))
        assert hips == [pytest.approx(person(c, place).hips) for c in CAMERAS]


def test_what_is_of_another_size_in_each_camera_is_nobody():
    people = [[person(c, (0.4, 0.3, 0.0))] for c in CAMERAS]
    for camera, factor in ((0, 1.0), (1, 2.0)):
        false = person(CAMERAS[camera], (-0.6, -0.4, 0.0))
        people[camera].append(replace(false, radius=factor * false.radius))
    assert len(list(matched_people(CAMERAS, people))) == 1
    people[1][1] = person(CAMERAS[1], (-0.6, -0.4, 0.0))
    assert len(list(matched_people(CAMERAS, people))) == 2


def infos(*rows):
    return (
        [PictureInfo(name, 64, 48, rate, count) for name, rate, count, _ in rows],
        [CameraTask(name, f"{name}.mp4", "full", None, skip) for name, _, _, skip in rows],
    )


def test_files_of_other_rates_and_lengths_are_refused_with_the_figures():
    with pytest.raises(CameraError, match="'a' has 60 pictures a second and camera 'b' 50"):
        check_agreement(*infos(("a", 60.0, 100, 0), ("b", 50.0, 100, 0)))
    with pytest.raises(CameraError, match="a 100, b 90"):
        check_agreement(*infos(("a", 60.0, 100, 0), ("b", 60.0, 90, 0)))
    check_agreement(*infos(("a", 60.0, 100, 10), ("b", 60.0, 90, 0)))


def test_what_a_camera_cannot_do_is_told_with_its_name(tmp_path):
    process = CameraProcess([CameraTask("left", str(tmp_path / "no.mp4"), "full")])
    try:
        with pytest.raises(CameraError, match=r"camera 'left'.*no such video"):
            process.infos()
    finally:
        process.close()


def test_a_process_that_dies_is_told(tmp_path):
    import cv2  # noqa: PLC0415 - after the check that it is there

    for index in range(3):
        cv2.imwrite(str(tmp_path / f"{index}.png"), np.zeros((48, 64, 3), dtype=np.uint8))
    process = CameraProcess([CameraTask("left", str(tmp_path), "full")])
    try:
        os.kill(process._process.pid, signal.SIGKILL)
        process._process.join(20)
        with pytest.raises(CameraError, match="camera 'left': its process ended by itself"):
            process.infos()
    finally:
        process.close()


def test_messages_reach_whoever_is_connected_whole_and_in_order():
    listener = socket.create_server(("127.0.0.1", 0))
    outlet = Outlet(listener)
    received = bytearray()

    def receive():
        with socket.create_connection(listener.getsockname(), timeout=20) as connection:
            while data := connection.recv(1000):
                received.extend(data)

    thread = threading.Thread(target=receive)
    thread.start()
    outlet.wait_for_first()
    for sequence in range(50):
        outlet.offer(encode_heat_maps(HeatMapMessage("a", "full", sequence, 0, None, np.zeros((2, 3)))))
    outlet.close()
    thread.join(20)
    listener.close()
    found = HeatMapReceiver().receive(bytes(received))
    assert [message.sequence for message in found] == list(range(50))
    assert outlet.served.sent == 50


def test_a_receiver_that_does_not_read_misses_messages_and_holds_up_nobody():
    listener = socket.create_server(("127.0.0.1", 0))
    outlet = Outlet(listener)
    with socket.create_connection(listener.getsockname()):
        outlet.wait_for_first()
        likelihood = np.random.default_rng(1).integers(0, 255, (33, 64, 64), dtype=np.uint8)
        message = encode_heat_maps(HeatMapMessage("a", "full", 0, 0, likelihood, np.zeros((2, 3))))
        for _ in range(100):
            outlet.offer(message)
    assert outlet.served.skipped > 0
    listener.close()


def test_files_begin_at_a_time_of_day():
    noon = 20_000 * 86_400 + 12 * 3600.0
    assert moment("12:00:30", noon) == noon + 30
    assert moment("00:00:05", noon + 12 * 3600 - 10) == noon + 12 * 3600 + 5
    with pytest.raises(GatewayError, match="--at 11:59:59: has passed; it is 12:00:00 UTC"):
        moment("11:59:59", noon)
    with pytest.raises(GatewayError, match="--at noon: a time of day in UTC is wanted"):
        moment("noon", noon)
