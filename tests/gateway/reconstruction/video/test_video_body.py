"""The 40 degrees of freedom: derivatives, limits, proportions, and poses found again."""

import numpy as np
import pytest

from gateway.body.body_file import load_body
from gateway.emulation.video_truth import walking
from gateway.errors import SettingsError
from gateway.geometry import quaternion
from gateway.reconstruction.optical import kernels
from gateway.reconstruction.optical.pose_solver import Held
from gateway.reconstruction.video.freedom import DEGREES, freedom_of, kept_free, turn_matrix
from gateway.reconstruction.video.inverse_kinematics import Goal, solve, video_body
from gateway.reconstruction.video.keypoint_set import load_keypoint_set
from gateway.reconstruction.video.networks.keypoints import BLAZEPOSE, OPENPOSE
from gateway.reconstruction.video.proportions import PARTS, part_lengths, sized, standard_lengths

pytestmark = pytest.mark.timeout(600)  # whichever test comes first compiles

KEYPOINTS = load_keypoint_set("blazepose_33")
PERSON = walking(KEYPOINTS, 30, (0.0, 0.0), (0.6, 0.8))
BODY = video_body(PERSON.skeleton, PERSON.markers)


@pytest.mark.parametrize(("name", "network"), [("blazepose_33", BLAZEPOSE), ("openpose_18", OPENPOSE)])
def test_keypoints_stand_in_the_order_of_the_network(name, network):
    keypoints = load_keypoint_set(name)
    assert keypoints.names == tuple(network)
    right = [n for n, each in enumerate(keypoints.names) if "right" in each]
    left = [keypoints.index(keypoints.names[n].replace("right", "left")) for n in right]
    mirrored = keypoints.markers.positions[right] * [1, 1, -1]
    np.testing.assert_allclose(keypoints.markers.positions[left], mirrored)


def test_an_unknown_segment_is_named(tmp_path):
    path = tmp_path / "set.yaml"
    path.write_text("{name: x, body: human_23, keypoints: {nose: {segment: haed}}}")
    with pytest.raises(SettingsError, match=r"keypoints\.nose.*'haed'.*head"):
        load_keypoint_set(str(path))


def test_the_changes_span_forty_dimensions_and_stay_a_pose():
    R = PERSON.R[7]
    T = turn_matrix(BODY.freedom, BODY.model.parents, R)
    assert T.shape == (72, DEGREES)
    assert np.linalg.matrix_rank(T) == DEGREES
    np.testing.assert_allclose(kept_free(BODY.freedom, BODY.model.parents, R), R, atol=1e-9)
    for column in range(DEGREES):
        change = T[:, column] * 1e-4
        moved, _ = kernels.moved(BODY.model.parents, R, np.zeros(3), change)
        kept = kept_free(BODY.freedom, BODY.model.parents, moved)
        np.testing.assert_allclose(kept, moved, atol=1e-7)


def test_hinges_stay_inside_their_limits():
    skeleton = PERSON.skeleton
    knee, thigh = skeleton.index("left_shank"), skeleton.index("left_thigh")
    R = PERSON.R[0].copy()
    forwards = quaternion.to_matrix(quaternion.from_rotation_vector(np.array([0.0, 0.0, 0.9])))
    R[knee] = R[thigh] @ forwards
    kept = kept_free(BODY.freedom, BODY.model.parents, R)
    bend = np.arccos(np.clip((np.trace(kept[thigh].T @ kept[knee]) - 1) / 2, -1, 1))
    assert np.degrees(bend) == pytest.approx(10.0, abs=0.01)


def test_a_pose_is_found_again_from_its_keypoints():
    start, root = PERSON.R[0], PERSON.joints[0, 0]
    everyone = np.ones(len(KEYPOINTS.names))
    for f in (2, 6):
        found = solve(BODY, Goal(PERSON.keypoints[f], everyone, Held(start), -np.inf), start, root, 60)
        places = BODY.model.markers_at(found.R, found.root)
        assert np.linalg.norm(places - PERSON.keypoints[f], axis=1).max() < 0.002


def test_what_is_not_seen_is_held_and_the_floor_is_not_passed():
    R, root = PERSON.R[3], PERSON.joints[3, 0]
    weights = np.ones(len(KEYPOINTS.names))
    hand = [KEYPOINTS.index(f"left_{name}") for name in ("pinky", "index", "thumb")]
    targets = PERSON.keypoints[3].copy()
    weights[hand] = 0.0
    targets[hand] = 9.0
    held = solve(BODY, Goal(targets, weights, Held(R, 30.0), -np.inf), R, root, 20)
    np.testing.assert_allclose(held.R, R, atol=0.01)
    below = Goal(PERSON.keypoints[3] - [0, 0, 0.1], np.ones_like(weights), Held(R), 0.0)
    sunk = solve(BODY, below, R, root, 60)
    p = BODY.model.joints_at(sunk.R, sunk.root)
    for segment, point in zip(BODY.contact_segments, BODY.contacts, strict=True):
        assert (p[segment] + sunk.R[segment] @ point)[2] > -0.02


def test_parts_are_scaled_alike_left_and_right():
    lengths = standard_lengths(KEYPOINTS) * np.linspace(0.8, 1.1, len(PARTS))
    skeleton, markers = sized(KEYPOINTS, lengths)
    body = video_body(skeleton, markers)
    R = np.tile(quaternion.to_matrix(skeleton.neutral), (skeleton.n_segments, 1, 1))
    np.testing.assert_allclose(
        part_lengths(KEYPOINTS, body.model.markers_at(R, np.zeros(3))), lengths, rtol=0.02
    )
    for name in skeleton.segment_names:
        if name.startswith("left_"):
            other = skeleton.index(name.replace("left", "right"))
            expected = skeleton.offsets[skeleton.index(name)] * [1, 1, -1]
            np.testing.assert_allclose(skeleton.offsets[other], expected, atol=1e-12)


def test_a_length_that_belongs_to_nobody_is_not_believed():
    lengths = standard_lengths(KEYPOINTS)
    lengths[PARTS.index("forearm")] *= 3.0
    skeleton, _ = sized(KEYPOINTS, lengths)
    np.testing.assert_allclose(skeleton.offsets, KEYPOINTS.skeleton.offsets)


def test_a_body_without_the_segments_is_refused():
    with pytest.raises(SettingsError, match=r"human_17.*l3.*human_23"):
        freedom_of(load_body("human_17"))
