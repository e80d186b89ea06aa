"""What poses from heat maps may not depend on: where north is, left and right, names and order of cameras and
keypoints, how the bytes are cut, a message that comes twice, whoever was followed before."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from devices.cameras.heat_map_messages import HeatMapReceiver, encode_heat_maps
from devices.link import Chunk
from gateway.body.camera import Camera
from gateway.body.skeleton import WornSuit
from gateway.frames import CameraHeatMaps, FloatArray, HeatMapFrame, IntArray, SkeletonFrame
from gateway.pipeline import Pipeline
from gateway.reconstruction.video.keypoint_set import KeypointSet, load_keypoint_set
from gateway.reconstruction.video.low_pass import DELAY
from gateway.reconstruction.video.reconstructor import VideoOptions, VideoReconstructor
from gateway.reconstruction.video.tracker import FINE
from gateway.recording.video import LINK, video_chunks, video_settings, video_suit
from gateway.sources.heat_maps import heat_map_frame
from tests.invariance import (
    SAGITTAL,
    Listing,
    assert_close,
    assert_same,
    few_examples,
    mirrored_pose,
    recut,
    relisted_pose,
    turn_about_up,
    turned_pose,
)
from tests.seen_walk import CAMERAS, seen_walk

pytestmark = pytest.mark.timeout(600)  # whichever test comes first compiles

N_FRAMES = 9
RATE_HZ = 60.0
KEYPOINTS = load_keypoint_set("blazepose_33")
ANGLES = st.floats(0.1, 6.2)
SEEDS = st.integers(0, 2**32 - 1)
TOLERANCE = 1e-7
"""rad, m, rad/s, m/s². Sums in another order round otherwise; it grows to 2e-9."""
BY_AXES_RAD = 0.04
BY_AXES_M = 0.5 * FINE
"""The lattices in which keypoints are sought lie along the world's axes: turned by less than a quarter,
other points are tried. A hand is told by keypoints 0.1 m apart."""


@cache
def instants() -> tuple[tuple[bytes, ...], ...]:
    """A walker before three cameras: by instant a message a camera."""
    return tuple(map(tuple, seen_walk(N_FRAMES)[0]))


@cache
def frames() -> tuple[HeatMapFrame, ...]:
    return tuple(heat_map_frame(sequence, messages) for sequence, messages in enumerate(instants()))


@cache
def unchanged() -> list[SkeletonFrame]:
    """The poses of the walker as seen."""
    found = poses(CAMERAS, frames())
    assert all(np.isfinite(pose.q_wb).all() for pose in found)
    return found


def poses(
    cameras: Sequence[Camera], seen: Sequence[HeatMapFrame], keypoints: KeypointSet = KEYPOINTS
) -> list[SkeletonFrame]:
    """The newest pose of every instant, then the smoothed ones."""
    reconstructor = VideoReconstructor(cameras, keypoints)
    found = [reconstructor.update(frame) for frame in seen]
    smoothed = [pose.skeleton for pose in found if pose.skeleton is not None]
    return [*(pose.newest for pose in found), *smoothed, *reconstructor.finish()]


def turned_cameras(angle: float) -> list[Camera]:
    """The cameras in a world turned about the vertical: their pictures are the same."""
    back = turn_about_up(angle).T
    return [replace(camera, rotation=camera.rotation @ back) for camera in CAMERAS]


@pytest.mark.parametrize("quarters", [1, 2])
def test_a_world_turned_by_quarters_turns_the_poses(quarters: int) -> None:
    angle = 0.5 * np.pi * quarters
    expected = [turned_pose(pose, angle) for pose in unchanged()]
    assert_close(poses(turned_cameras(angle), frames()), expected, TOLERANCE)


@given(angle=ANGLES)
@few_examples(3)
def test_a_turned_world_turns_the_poses_within_the_lattice(angle: float) -> None:
    found = poses(turned_cameras(angle), frames())
    for one, expected in zip(found, (turned_pose(pose, angle) for pose in unchanged()), strict=True):
        np.testing.assert_array_equal(one.status, expected.status)
        assert np.linalg.norm(one.p_w - expected.p_w, axis=1).max() < BY_AXES_M
        assert angles_between(one.q_wb, expected.q_wb).max() < BY_AXES_RAD


def angles_between(one: FloatArray, other: FloatArray) -> FloatArray:
    """(S,) rad between orientations (S, 4)."""
    apart: FloatArray = 2.0 * np.arccos(np.minimum(np.abs((one * other).sum(axis=1)), 1.0))
    return apart


def test_left_and_right_mirrored_give_mirrored_poses() -> None:
    """What was a left arm is a right one in the mirror, with the keypoints' names and the segments'."""
    skeleton = KEYPOINTS.skeleton
    keypoints, segments = other_sides(KEYPOINTS.names), other_sides(skeleton.segment_names)
    seen = [
        replace(
            frame,
            cameras=tuple(
                CameraHeatMaps(maps.likelihood[keypoints], mirrored_affine(camera, maps.map_from_pixel))
                for camera, maps in zip(CAMERAS, frame.cameras, strict=True)
                if maps is not None
            ),
        )
        for frame in frames()
    ]
    listing = Listing(segments, np.arange(0))
    expected = [relisted_pose(mirrored_pose(pose, skeleton), listing) for pose in unchanged()]
    assert_close(poses([mirrored_camera(camera) for camera in CAMERAS], seen), expected, TOLERANCE)


def other_sides(names: Sequence[str]) -> IntArray:
    """By name the row of the other side's; of what has no sides its own."""
    swapped = {"left": "right", "right": "left"}
    return np.array([names.index("_".join(swapped.get(w, w) for w in name.split("_"))) for name in names])


def mirrored_camera(camera: Camera) -> Camera:
    """One in the mirrored world whose picture is mirrored about the principal point."""
    across = np.diag([-1.0, 1.0, 1.0])
    return replace(
        camera,
        distortion=camera.distortion * [1.0, 1.0, 1.0, -1.0, 1.0],
        rotation=across @ camera.rotation @ SAGITTAL,
        translation=across @ camera.translation,
    )


def mirrored_affine(camera: Camera, affine: FloatArray) -> FloatArray:
    """The same maps of a picture mirrored about the principal point."""
    column, row, shift = affine.T
    return np.stack([-column, row, shift + 2.0 * camera.matrix[0, 2] * column], axis=1)


@given(seed=SEEDS)
@few_examples(2)
def test_names_and_order_of_cameras_and_of_keypoints_do_not_count(seed: int) -> None:
    rng = np.random.default_rng(seed)
    order, rows = rng.permutation(len(CAMERAS)), rng.permutation(len(KEYPOINTS.names))
    cameras = [replace(CAMERAS[c], name=CAMERAS[c].name[::-1]) for c in order]
    worn = KEYPOINTS.markers
    keypoints = replace(
        KEYPOINTS,
        names=tuple(KEYPOINTS.names[n] for n in rows),
        shows=KEYPOINTS.shows[rows],
        markers=replace(
            worn,
            labels=tuple(worn.labels[n] for n in rows),
            segments=worn.segments[rows],
            positions=worn.positions[rows],
            sigmas=worn.sigmas[rows],
        ),
    )
    seen = []
    for frame in frames():
        maps = [frame.cameras[c] for c in order]
        relisted = (None if m is None else replace(m, likelihood=m.likelihood[rows]) for m in maps)
        seen.append(replace(frame, cameras=tuple(relisted)))
    assert_close(poses(cameras, seen, keypoints), unchanged(), TOLERANCE)


@cache
def suit() -> WornSuit:
    return video_suit(CAMERAS, "full", instants())


@cache
def chunks() -> tuple[Chunk, ...]:
    """One message each, the cameras a millisecond after each other."""
    return tuple(
        Chunk(message, whole.arrived_ns + 1_000_000 * c, LINK)
        for whole, messages in zip(video_chunks(instants(), RATE_HZ), instants(), strict=False)
        for c, message in enumerate(messages)
    )


def piped(sent: Sequence[Chunk]) -> list[SkeletonFrame]:
    """What the pipeline makes of messages."""
    pipeline = Pipeline.from_settings(video_settings("walker", RATE_HZ), suit())
    pipeline.add_link(LINK, "heat_maps")
    return [pose for chunk in sent for pose in pipeline.feed(chunk)]


@cache
def unchanged_piped() -> list[SkeletonFrame]:
    found = piped(chunks())
    assert len(found) == N_FRAMES - DELAY
    return found


@given(seed=SEEDS)
@few_examples(2)
def test_chunks_of_messages_may_be_cut_anywhere(seed: int) -> None:
    pieces = recut(chunks(), np.random.default_rng(seed))
    for one, other in zip(piped(pieces), unchanged_piped(), strict=True):
        assert_same(one, other)


def test_a_message_that_comes_twice_changes_nothing() -> None:
    twice = [chunk for chunk in chunks() for _ in range(2)]
    for one, other in zip(piped(twice), unchanged_piped(), strict=True):
        assert_same(one, other)


def test_names_of_cameras_may_be_others_on_the_wire_too() -> None:
    worn = suit()
    assert worn.video is not None
    cameras = tuple(replace(camera, name=camera.name[::-1]) for camera in worn.video.cameras)
    renamed = replace(worn, video=replace(worn.video, cameras=cameras))
    pipeline = Pipeline.from_settings(video_settings("walker", RATE_HZ), renamed)
    pipeline.add_link(LINK, "heat_maps")
    found = []
    for chunk in chunks():
        (message,) = HeatMapReceiver().receive(chunk.data)
        other = replace(message, camera=message.camera[::-1])
        found += pipeline.feed(replace(chunk, data=encode_heat_maps(other)))
    for one, expected in zip(found, unchanged_piped(), strict=True):
        assert_same(one, expected)


def test_one_forgotten_begins_as_a_new_one() -> None:
    """Its measured lengths stay: what was another's pose does not."""
    person = VideoReconstructor(CAMERAS, KEYPOINTS)
    for frame in frames():
        person.update(frame)
    keypoints, options = person.person, VideoOptions(is_measured=True)
    used, new = (VideoReconstructor(CAMERAS, keypoints, options) for _ in range(2))
    for frame in frames()[5:]:
        used.update(frame)
    used.reset()
    for frame in frames():
        one, other = used.update(frame), new.update(frame)
        assert_same(one.newest, other.newest)
        assert (one.skeleton is None) == (other.skeleton is None)
        if one.skeleton is not None and other.skeleton is not None:
            assert_same(one.skeleton, other.skeleton)
