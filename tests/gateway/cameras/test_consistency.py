"""Cameras that agree, that are not in step, and that are not those of the calibration."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from devices.cameras.heat_map_messages import HeatMapMessage, HeatMapReceiver, encode_heat_maps, quantised
from gateway.body.camera import project
from gateway.body.skeleton import VideoSetUp
from gateway.cameras.consistency import Consistency, consistency_of, in_step
from gateway.cameras.synchronisation import synchronisation_of
from gateway.cli.video_solve import Capture, Choice, _sorted_out
from gateway.errors import GatewayError
from tests.ring_of_cameras import CAMERAS

SIZE = 64
N = 60
AFFINE = np.array([[0.09, 0.0, -25.6], [0.0, 0.09, 0.0]])


def walker(t):
    """(6, 3) m: keypoints that walk and swing, beside the axis that all cameras look at."""
    base = np.array([[0, 0, 0.1], [0.2, 0, 0.5], [0, 0.2, 0.9], [0.1, -0.2, 1.2], [0, 0.1, 1.5], [0, 0, 1.7]])
    swing = 0.25 * np.sin(0.25 * t + np.arange(6))[:, None] * np.array([0.6, 0.6, 0.3])
    return base + swing + np.array([0.015 * t + 0.3, -0.5, 0.0])


def heat_maps(seen_by, t):
    """Gaussians where the camera sees the keypoints at time t."""
    pixels = project(seen_by, walker(t))
    cells = pixels @ AFFINE[:, :2].T + AFFINE[:, 2]
    y, x = np.mgrid[:SIZE, :SIZE]
    squares = (x - cells[:, 0, None, None]) ** 2 + (y - cells[:, 1, None, None]) ** 2
    return np.exp(-squares / (2 * 1.5**2)).astype(np.float32)


def messages(cameras, late=None):
    late = late or {}
    return [
        [
            encode_heat_maps(
                HeatMapMessage(c.name, "full", t, t, quantised(heat_maps(c, t - late.get(c.name, 0))), AFFINE)
            )
            for c in cameras
        ]
        for t in range(N)
    ]


NOBODY = [
    [encode_heat_maps(HeatMapMessage(c.name, "full", t, t, None, AFFINE)) for c in CAMERAS] for t in range(N)
]


@pytest.mark.parametrize(
    ("apart", "told"),
    [
        ({"a": 0.02, "b": 0.021, "c": 0.037}, []),
        (
            {"a": 0.006, "b": 0.005, "c": 0.044},
            ["rays of c pass the others' at 44 mm, theirs each other at 6"],
        ),
        ({"a": 0.06, "b": 0.06}, ["c: the person is hardly seen"]),
        ({}, []),
    ],
)
def test_what_is_odd_of_cameras_but_not_refused_is_told(apart, told):
    found = Consistency(("a", "b", "c"), apart, {}, 0.0, 0.0)
    found.refuse_wrong(Path("cameras.yaml"))
    assert len(found.doubts()) == len(told)
    assert all(part in doubt for part, doubt in zip(told, found.doubts(), strict=True))


def test_cameras_in_step_agree():
    found = consistency_of(CAMERAS, messages(CAMERAS))
    assert max(found.apart.values()) < 0.02
    assert found.offsets == {}
    found.refuse_wrong(Path("c.yaml"))


@pytest.mark.parametrize("late", [{"c": 4}, {"a": 3}, {"b": 2, "d": -3}])
def test_cameras_out_of_step_are_named_with_the_cure(late):
    found = consistency_of(CAMERAS, messages(CAMERAS, late))
    expected = {c.name: late.get(c.name, 0) for c in CAMERAS}
    assert found.offsets == {name: n for name, n in expected.items() if n}
    with pytest.raises(GatewayError, match="not synchronised") as error:
        found.refuse_wrong(Path("c.yaml"))
    earliest = min(expected.values())
    assert all(
        f"--offset {name}={n - earliest}" in str(error.value) for name, n in expected.items() if n > earliest
    )


def test_cameras_are_put_in_step_by_what_is_found():
    late = {"b": 2, "d": -3}
    captured = messages(CAMERAS, late)
    found = consistency_of(CAMERAS, captured)
    shifted = in_step(captured, found.skipped)
    assert len(shifted) == N - 5
    read = [HeatMapReceiver().receive(message)[0] for message in shifted[7]]
    assert {(each.sequence, each.time_ns) for each in read} == {(7, 7)}
    after = consistency_of(CAMERAS, shifted)
    assert after.offsets == {}
    after.refuse_wrong(Path("c.yaml"))


@pytest.mark.parametrize("order", [1, -1])
def test_whoever_is_seen_the_most_tells_whether_cameras_are_in_step(order):
    """Somebody half hidden may seem to tell otherwise, and must not keep everybody from being solved."""
    hidden = [
        [*each[:2], *nobody[2:]] for each, nobody in zip(messages(CAMERAS, {"b": 5}), NOBODY, strict=True)
    ]
    people = [messages(CAMERAS), hidden][::order]
    assert consistency_of(CAMERAS, hidden).offsets
    capture = Capture(VideoSetUp(tuple(CAMERAS), "full"), people, 60.0)
    found, checks = _sorted_out(capture, Choice(people="2"), Path("c.yaml"))
    assert found == people
    assert [bool(each.offsets) for each in checks] == [False, True][::order]
    found, _ = _sorted_out(capture, Choice(people="2", synchronise=True), Path("c.yaml"))
    assert found == people
    late = Capture(capture.video, [messages(CAMERAS, {"b": 5}), hidden][::order], 60.0)
    with pytest.raises(GatewayError, match="not synchronised"):
        _sorted_out(late, Choice(people="2"), Path("c.yaml"))


def test_a_camera_that_was_moved_is_named():
    moved = replace(CAMERAS[2], translation=CAMERAS[2].translation + np.array([0.5, 0.4, 0.0]))
    found = consistency_of([*CAMERAS[:2], moved, CAMERAS[3]], messages(CAMERAS))
    with pytest.raises(GatewayError, match=r"c\.yaml: camera 'c' does not fit the others"):
        found.refuse_wrong(Path("c.yaml"))


def test_a_calibration_of_other_cameras_is_told():
    others = [replace(CAMERAS[i], name=c.name) for i, c in zip((1, 0, 2, 3), CAMERAS, strict=True)]
    found = consistency_of(others, messages(CAMERAS))
    with pytest.raises(GatewayError, match=r"c\.yaml does not fit these pictures"):
        found.refuse_wrong(Path("c.yaml"))


def test_pictures_of_nobody_accuse_nobody():
    nobody = [[encode_heat_maps(HeatMapMessage(c.name, "full", 0, 0, None, AFFINE)) for c in CAMERAS]]
    found = consistency_of(CAMERAS, nobody)
    assert found.apart == {}
    found.refuse_wrong(Path("c.yaml"))


@pytest.mark.parametrize("late", [{"c": 5}, {"a": -5}])
def test_slow_motion_tells_in_spite_of_a_network_that_is_always_a_little_wrong(late):
    """The rays pass each other by centimetres that stay; what swings with the motion is told from that."""
    generator = np.random.default_rng(7)
    rays = np.zeros((90, 4, 6, 3))
    wrong = {c.name: generator.normal(scale=0.008, size=(6, 3)) for c in CAMERAS}
    for t in range(90):
        for c, each in enumerate(CAMERAS):
            noise = generator.normal(scale=0.002, size=(6, 3))
            ray = walker(0.25 * (t - late.get(each.name, 0))) - each.position
            rays[t, c] = ray / np.linalg.norm(ray, axis=1, keepdims=True) + wrong[each.name] + noise
    positions = np.stack([each.position for each in CAMERAS])
    found = synchronisation_of(positions, rays, np.ones((90, 4, 6)))
    first = late.get("a", 0)
    assert found.offsets == [late.get(each.name, 0) - first for each in CAMERAS]
    standing = synchronisation_of(positions, np.repeat(rays[:1], 90, axis=0), np.ones((90, 4, 6)))
    assert standing.offsets == [0, 0, 0, 0]


def test_of_four_cameras_the_odd_one_is_named_though_it_is_the_first():
    told = consistency_of(CAMERAS, messages(CAMERAS, {"a": 5}))
    assert told.offsets == {"a": 5}
    cure = r"camera 'a' is 5 pictures behind the others .*: --offset a=5, or --synchronise$"
    with pytest.raises(GatewayError, match=cure):
        told.refuse_wrong(Path("c.yaml"))
