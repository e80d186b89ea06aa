"""What no method of reconstruction may depend on: where north is, names and their order, left and right, an
interruption, a frame that comes twice; and how honest the errors are that ``joint`` claims."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from gateway.frames import ImuFrame, SkeletonFrame
from gateway.reconstruction import RECONSTRUCTORS, create_reconstructor
from gateway.reconstruction.optical.reconstructor import OpticalReconstructor
from gateway.reconstruction.reconstructor import Reconstructor, update_many
from gateway.reconstruction.whole_body import WholeBodyReconstructor
from tests.invariance import (
    INTERVAL_NS,
    SAGITTAL,
    SCENES,
    MarkerScene,
    Scene,
    assert_close,
    assert_same,
    few_examples,
    listing_of,
    marker_scene,
    mirrored,
    mirrored_pose,
    mirrored_skeleton,
    moved_markers,
    relisted,
    relisted_pose,
    segment_mirror,
    turn_about_up,
    turned,
    turned_pose,
)

NAMES = sorted(RECONSTRUCTORS)
RESUMABLE = ("joint", "outward")
FEW_FRAMES = 160
"""Of a scene, for methods that take long or have hardly a state: up to the end of the gap."""
IN_ALL_SCENES = ("articulated", "independent", "joint", "outward")
CASES = [(name, kind) for name in NAMES for kind in (SCENES if name in IN_ALL_SCENES else ["placed"])]
"""Methods and the scenes that they are tried on."""
ANGLES = st.floats(0.1, 6.2)
SEEDS = st.integers(0, 2**32 - 1)
PLACES = st.floats(0.0, 1.0)
"""In a scene: the share of its frames that come before."""
TOLERANCE = 1e-9
"""rad, rad/s, m/s², m. Turning a vector rounds it in its last bit, and rounding grows to 1e-11 where a method
is least sure (``gyro_free``, m/s²); what depends on where north is, is 1e-3 and more."""
OPTICAL_TOLERANCE = 1e-6
"""The solver ends its iterations where a step is below that."""
BY_AXES = {
    "joint": "rows that surprise (_huber, learn_rows) count less by what each world axis shows, one by one",
    "outward_held": "as joint",
    "outward_walking": "as joint, from when a heading is observed and its joint's lever arms are learnt",
    "gyro_free": "add_vector judges surprise, and _hold the place of a joint, by each world axis for itself",
}
BY_NUMBER = "learn_joint_arms begins at a third of the frames that the number of the segment tells"


def _cases(but: str = "", **expected: str) -> Any:
    """Every method on its scenes, but one; expected to fail those whose names begin so, with the reason."""
    parameters = []
    for name, kind in CASES:
        reasons = [why for beginning, why in expected.items() if f"{name}_{kind}".startswith(beginning)]
        marks = [pytest.mark.xfail(strict=True, raises=AssertionError, reason=why) for why in reasons]
        if name != but:
            parameters.append(pytest.param(name, kind, marks=marks, id=f"{name}-{kind}"))
    return pytest.mark.parametrize(("name", "kind"), parameters)


@cache
def whole_scene(kind: str) -> Scene:
    return SCENES[kind]()


def scene_of(name: str, kind: str) -> Scene:
    """As much of a scene as a method is tried on."""
    scene = whole_scene(kind)
    return scene if name in IN_ALL_SCENES else Scene(scene.suit, scene.frames[:FEW_FRAMES])


@cache
def unchanged(name: str, kind: str) -> list[SkeletonFrame]:
    """The poses of a scene as it is."""
    return reconstructed(name, scene_of(name, kind))


def reconstructed(name: str, scene: Scene) -> list[SkeletonFrame]:
    return updated(create_reconstructor(name, scene.suit, INTERVAL_NS * 1e-9), scene.frames)


def updated(reconstructor: Reconstructor, frames: Sequence[ImuFrame]) -> list[SkeletonFrame]:
    return update_many(reconstructor, frames)


@_cases(but="fused_neutral")
def test_a_world_turned_by_half_turns_the_poses_and_nothing_else(name: str, kind: str) -> None:
    """Which also methods that look at the world's axes one by one must give."""
    found = reconstructed(name, turned(scene_of(name, kind), np.pi))
    assert_close(found, [turned_pose(pose, np.pi) for pose in unchanged(name, kind)], TOLERANCE)


@_cases(but="fused_neutral", **BY_AXES)
@given(angle=ANGLES)
@few_examples(1)
@example(angle=0.7)
def test_a_turned_world_turns_the_poses_and_nothing_else(name: str, kind: str, angle: float) -> None:
    found = reconstructed(name, turned(scene_of(name, kind), angle))
    assert_close(found, [turned_pose(pose, angle) for pose in unchanged(name, kind)], TOLERANCE)


@given(angle=ANGLES)
@few_examples(2)
def test_fused_neutral_does_not_mind_where_the_references_face(angle: float) -> None:
    found = reconstructed("fused_neutral", turned(scene_of("fused_neutral", "placed"), angle))
    assert_close(found, unchanged("fused_neutral", "placed"), TOLERANCE)


@pytest.mark.parametrize(("name", "kind"), [case for case in CASES if case[0] in RESUMABLE])
@given(seed=SEEDS)
@few_examples(2)
def test_names_and_the_order_of_modules_do_not_count(name: str, kind: str, seed: int) -> None:
    scene = scene_of(name, kind)
    listing = listing_of(scene.suit, np.random.default_rng(seed))
    listing = replace(listing, segments=np.arange(scene.suit.skeleton.n_segments))
    for one, other in zip(reconstructed(name, relisted(scene, listing)), unchanged(name, kind), strict=True):
        assert_same(one, other)


@_cases(joint=BY_NUMBER, outward_held=BY_NUMBER, outward_placed=BY_NUMBER)
@given(seed=SEEDS)
@few_examples(1)
@example(seed=3)
def test_the_order_of_segments_does_not_count(name: str, kind: str, seed: int) -> None:
    scene = scene_of(name, kind)
    listing = listing_of(scene.suit, np.random.default_rng(seed))
    found = reconstructed(name, relisted(scene, listing))
    assert_close(found, [relisted_pose(pose, listing) for pose in unchanged(name, kind)], TOLERANCE)


@_cases()
def test_a_mirrored_body_gives_mirrored_poses(name: str, kind: str) -> None:
    scene = scene_of(name, kind)
    expected = [mirrored_pose(pose, scene.suit.skeleton) for pose in unchanged(name, kind)]
    assert_close(reconstructed(name, mirrored(scene)), expected, TOLERANCE)


@_cases()
@given(place=PLACES)
@few_examples(2)
def test_a_frame_that_comes_twice_changes_nothing(name: str, kind: str, place: float) -> None:
    frames = scene_of(name, kind).frames
    at = round(place * (len(frames) - 2))
    reconstructor = create_reconstructor(name, scene_of(name, kind).suit, INTERVAL_NS * 1e-9)
    updated(reconstructor, frames[: at + 1])
    again = reconstructor.update(frames[at])
    if isinstance(reconstructor, WholeBodyReconstructor):
        assert_same(again, unchanged(name, kind)[at])
    found = updated(reconstructor, frames[at + 1 :])
    for one, other in zip(found, unchanged(name, kind)[at + 1 :], strict=True):
        assert_same(one, other)


@pytest.mark.parametrize(("name", "kind"), [case for case in CASES if case[0] in RESUMABLE])
@given(place=PLACES)
@few_examples(4)
def test_a_saved_state_goes_on_as_if_never_interrupted(name: str, kind: str, place: float) -> None:
    scene = scene_of(name, kind)
    at = round(place * (len(scene.frames) - 2))
    before, after = (create_reconstructor(name, scene.suit, INTERVAL_NS * 1e-9) for _ in range(2))
    assert isinstance(before, WholeBodyReconstructor)
    assert isinstance(after, WholeBodyReconstructor)
    updated(before, scene.frames[:at])
    updated(after, scene.frames[-9:])  # something else, to be forgotten
    file = io.BytesIO()
    np.savez(file, **before.state())
    file.seek(0)
    with np.load(file) as saved:
        after.set_state(dict(saved))
    for one, other in zip(updated(after, scene.frames[at:]), unchanged(name, kind)[at:], strict=True):
        assert_same(one, other)


@cache
def markers() -> MarkerScene:
    return marker_scene()


@cache
def unchanged_optical() -> list[SkeletonFrame]:
    return optical(markers())


def optical(scene: MarkerScene) -> list[SkeletonFrame]:
    """The poses of markers."""
    reconstructor = OpticalReconstructor(scene.skeleton, scene.markers)
    return [reconstructor.update(frame) for frame in scene.frames]


@given(angle=ANGLES)
@few_examples(2)
def test_turned_markers_turn_the_poses(angle: float) -> None:
    found = optical(replace(markers(), frames=moved_markers(markers(), turn_about_up(angle))))
    assert_close(found, [turned_pose(pose, angle) for pose in unchanged_optical()], OPTICAL_TOLERANCE)


def test_mirrored_markers_mirror_the_poses() -> None:
    scene = markers()
    S = segment_mirror(scene.skeleton)
    mirrored_scene = MarkerScene(
        mirrored_skeleton(scene.skeleton),
        replace(scene.markers, positions=scene.markers.positions @ S),
        moved_markers(scene, SAGITTAL),
    )
    expected = [mirrored_pose(pose, scene.skeleton) for pose in unchanged_optical()]
    assert_close(optical(mirrored_scene), expected, OPTICAL_TOLERANCE)


@given(seed=SEEDS)
@few_examples(2)
def test_names_and_order_of_markers_do_not_count(seed: int) -> None:
    scene, rng = markers(), np.random.default_rng(seed)
    order = rng.permutation(len(scene.markers.labels))
    worn = scene.markers
    relisted_markers = replace(
        worn,
        labels=tuple(worn.labels[m][::-1] for m in order),
        segments=worn.segments[order],
        positions=worn.positions[order],
        sigmas=worn.sigmas[order],
    )
    frames = tuple(replace(frame, positions=frame.positions[order]) for frame in scene.frames)
    assert_close(
        optical(MarkerScene(scene.skeleton, relisted_markers, frames)), unchanged_optical(), OPTICAL_TOLERANCE
    )


@given(at=st.integers(1, 58))
@few_examples(3)
def test_a_frame_of_markers_that_comes_twice_changes_nothing(at: int) -> None:
    scene = markers()
    reconstructor = OpticalReconstructor(scene.skeleton, scene.markers)
    for frame in scene.frames[: at + 1]:
        reconstructor.update(frame)
    reconstructor.update(scene.frames[at])
    found = [reconstructor.update(frame) for frame in scene.frames[at + 1 :]]
    for one, other in zip(found, unchanged_optical()[at + 1 :], strict=True):
        assert_same(one, other)
