"""People of known motion, rendered as heat maps, found again."""

from dataclasses import replace

import numpy as np
import pytest

from gateway.emulation.video_truth import rendered, ring_of_cameras, true_regions, walking
from gateway.errors import GatewayError
from gateway.frames import HeatMapFrame, Status
from gateway.geometry import quaternion
from gateway.reconstruction.video.crowd import VideoCrowd
from gateway.reconstruction.video.initial import from_rays
from gateway.reconstruction.video.keypoint_set import load_keypoint_set
from gateway.reconstruction.video.low_pass import DELAY
from gateway.reconstruction.video.offline import reconstruct_recorded
from gateway.reconstruction.video.projection import camera_model
from gateway.reconstruction.video.reconstructor import Tracking, VideoReconstructor
from gateway.reconstruction.video.tracker import TRUNK, VideoOptions

pytestmark = pytest.mark.timeout(600)  # whichever test comes first compiles

CAMERAS = ring_of_cameras(4)
KEYPOINTS = load_keypoint_set("blazepose_33")
JOINTS = [
    f"{side}_{part}" for side in ("left", "right") for part in ("forearm", "hand", "thigh", "shank", "foot")
]
ARM = [KEYPOINTS.index(f"left_{name}") for name in ("elbow", "wrist", "pinky", "index", "thumb")]


def hidden_in_all(keypoints):
    hidden = np.zeros((len(CAMERAS), len(KEYPOINTS.names)), dtype=bool)
    hidden[:, keypoints] = True
    return hidden


def tracked(person, n_frames, seen_by=lambda f, c: True, hidden=lambda f: None, options=None):
    """The poses, and (F, joints) errors of the newest, m."""
    reconstructor = VideoReconstructor(CAMERAS, KEYPOINTS, options)
    regions = true_regions(CAMERAS, KEYPOINTS, person.keypoints[0])
    poses, errors = [], []
    rows = [person.skeleton.index(name) for name in JOINTS]
    for f in range(n_frames):
        frame = rendered(CAMERAS, regions, person.keypoints[f][None], f, hidden(f))
        maps = tuple(each if seen_by(f, c) else None for c, each in enumerate(frame.cameras))
        poses.append(reconstructor.update(replace(frame, cameras=maps)))
        if np.isfinite(poses[-1].keypoints).all():
            regions = poses[-1].regions
        errors.append(np.linalg.norm(poses[-1].newest.p_w[rows] - person.joints[f][rows], axis=1))
    return reconstructor, poses, np.array(errors)


def test_a_walk_is_found_within_millimetres_and_smoothed_three_frames_late():
    person = walking(KEYPOINTS, 24, (-0.1, 0.0), (0.8, 0.3))
    reconstructor, poses, errors = tracked(person, 24)
    assert np.median(errors) < 0.004
    assert errors.max() < 0.03
    assert [pose.skeleton is None for pose in poses] == [True] * DELAY + [False] * (24 - DELAY)
    smoothed = [pose.skeleton for pose in poses[DELAY:]] + reconstructor.finish()
    assert [frame.sequence for frame in smoothed] == list(range(24))
    assert [frame.time_ns for frame in smoothed] == [pose.time_ns for pose in poses]
    rows = [person.skeleton.index(name) for name in JOINTS]
    late = [np.linalg.norm(f.p_w[rows] - person.joints[f.sequence][rows], axis=1) for f in smoothed]
    assert np.median(late) < 0.004
    status = dict(zip(person.skeleton.segment_names, smoothed[10].status, strict=True))
    assert status["left_thigh"] == status["thorax"] == status["left_hand"] == Status.MEASURED
    assert status["left_toes"] == status["l3"] == Status.PREDICTED


def test_the_lengths_are_constant_once_a_person_is_measured():
    person = walking(KEYPOINTS, 8, (0.0, 0.0), (0.8, 0.0))
    first, _, _ = tracked(person, 8)
    again = VideoReconstructor(CAMERAS, first.person, VideoOptions(is_measured=True))
    offsets = again.skeleton.offsets.copy()
    regions = true_regions(CAMERAS, KEYPOINTS, person.keypoints[0])
    for f in range(4):
        again.update(rendered(CAMERAS, regions, person.keypoints[f][None], f))
    np.testing.assert_array_equal(again.skeleton.offsets, offsets)


def test_someone_on_the_hands_is_followed_in_turned_pictures():
    person = walking(KEYPOINTS, 12, (0.0, 0.0), (0.5, 0.0), upside_down=True)
    _, poses, errors = tracked(person, 12)
    assert np.median(errors) < 0.004
    rolls = np.degrees([region.roll for region in poses[-1].regions])
    assert (np.abs(rolls) >= 149).all()


def test_a_hidden_arm_is_lost_held_and_recovered():
    person = walking(KEYPOINTS, 24, (0.0, 0.0), (0.8, 0.0))
    _, poses, errors = tracked(person, 24, hidden=lambda f: hidden_in_all(ARM) if 8 <= f < 14 else None)
    wrist = KEYPOINTS.index("left_wrist")
    states = [pose.tracking[wrist] for pose in poses]
    assert states[7:15] == [Tracking.TRACKED, *[Tracking.LOST] * 6, Tracking.RECOVERED]
    assert poses[10].newest.status[person.skeleton.index("left_forearm")] == Status.PREDICTED
    assert errors[8:14].max() < 0.3
    assert np.median(errors[18:]) < 0.004
    others = [n for n, name in enumerate(JOINTS) if name not in ("left_forearm", "left_hand")]
    assert errors[:, others].max() < 0.03


def test_what_was_hidden_is_recovered_from_later_frames():
    person = walking(KEYPOINTS, 26, (0.0, 0.0), (0.8, 0.0))
    frames = [
        rendered(
            CAMERAS, true_regions(CAMERAS, KEYPOINTS, points), points[None], f,
            hidden_in_all(ARM) if 8 <= f < 18 else None,
        )
        for f, points in enumerate(person.keypoints)
    ]  # fmt: skip
    told = []
    recorded = reconstruct_recorded(CAMERAS, KEYPOINTS, frames, advanced=lambda: told.append(1))
    assert [frame.sequence for frame in recorded] == list(range(26))
    assert len(told) == 2 * 26
    hand = person.skeleton.index("left_hand")
    _, poses, _ = tracked(person, 18, hidden=lambda f: hidden_in_all(ARM) if 8 <= f < 18 else None)
    live = np.linalg.norm(poses[17].newest.p_w[hand] - person.joints[17, hand])
    late = max(np.linalg.norm(recorded[f].p_w[hand] - person.joints[f, hand]) for f in range(8, 18))
    assert late < 0.5 * live


def test_two_people_cross_without_a_swap():
    people = [
        walking(KEYPOINTS, 30, (-0.75, -0.25), (3.0, 0.0)),
        walking(KEYPOINTS, 30, (0.75, 0.25), (-3.0, 0.0), phase=1.0),
    ]
    crowd = VideoCrowd(CAMERAS, KEYPOINTS, 2)
    regions = [true_regions(CAMERAS, KEYPOINTS, person.keypoints[0]) for person in people]
    for f in range(30):
        everyone = np.stack([person.keypoints[f] for person in people])
        alone = [everyone[k : k + 1] if f == 0 else everyone for k in range(2)]
        crowd.update([rendered(CAMERAS, regions[k], alone[k], f) for k in range(2)])
        regions = [true_regions(CAMERAS, KEYPOINTS, points) for points in crowd.expected_after(1)]
    for person, tracker in zip(people, crowd.trackers, strict=True):
        assert np.median(np.linalg.norm(tracker.places - person.keypoints[-1], axis=1)) < 0.02
    with pytest.raises(GatewayError, match="1 people for 2"):
        crowd.update([HeatMapFrame(0, 0, (None,) * 4)])


def test_one_person_found_twice_is_counted_once_and_two_close_by_stay_two():
    twice = walking(KEYPOINTS, 10, (0.0, 0.0), (0.8, 0.0))
    crowd = VideoCrowd(CAMERAS, KEYPOINTS, 2)
    regions = true_regions(CAMERAS, KEYPOINTS, twice.keypoints[0])
    for f in range(10):
        frame = rendered(CAMERAS, regions, twice.keypoints[f][None], f)
        crowd.update([frame, frame])
        regions = true_regions(CAMERAS, KEYPOINTS, crowd.expected_after(1)[0])
    assert crowd.same_as == {1: 0}
    assert np.median(np.linalg.norm(crowd.trackers[0].places - twice.keypoints[-1], axis=1)) < 0.02
    beside = [walking(KEYPOINTS, 10, (0.0, y), (0.8, 0.0)) for y in (0.0, 0.5)]
    crowd = VideoCrowd(CAMERAS, KEYPOINTS, 2)
    seen = [true_regions(CAMERAS, KEYPOINTS, person.keypoints[0]) for person in beside]
    for f in range(10):
        shown = [person.keypoints[f][None] for person in beside]
        crowd.update([rendered(CAMERAS, seen[k], shown[k], f) for k in range(2)])
        seen = [true_regions(CAMERAS, KEYPOINTS, points) for points in crowd.expected_after(1)]
    assert crowd.same_as == {}


@pytest.mark.parametrize(("cameras", "limit"), [(3, 0.004), (2, 0.010), (1, 0.25)])
def test_cameras_that_fall_out_cost_accuracy_and_nothing_else(cameras, limit):
    person = walking(KEYPOINTS, 12, (0.0, 0.0), (0.4, 0.0))
    _, poses, errors = tracked(person, 12, seen_by=lambda f, c: f < 4 or c < cameras)
    assert np.isfinite(errors).all()
    assert np.median(errors[4:]) < limit
    assert all(np.isfinite(pose.newest.q_wb).all() for pose in poses)


def test_nobody_is_nobody():
    reconstructor = VideoReconstructor(CAMERAS, KEYPOINTS)
    pose = reconstructor.update(HeatMapFrame(0, 0, (None,) * 4))
    assert np.isnan(pose.newest.q_wb).all()
    assert (pose.newest.status == Status.MISSING).all()
    assert pose.skeleton is None
    assert pose.regions == (None,) * 4
    person = walking(KEYPOINTS, 1, (0.0, 0.0), (0.4, 0.0))
    seen = rendered(CAMERAS, true_regions(CAMERAS, KEYPOINTS, person.keypoints[0]), person.keypoints, 1)
    alone = replace(seen, cameras=(seen.cameras[0], None, None, None))
    assert np.isnan(reconstructor.update(alone).keypoints).all()
    assert np.isfinite(reconstructor.update(replace(seen, sequence=2)).keypoints).all()


def test_somebody_whose_rays_nowhere_meet_is_found_in_the_whole_volume():
    """Cameras that a calibration has off by centimetres, each another way."""
    person = walking(KEYPOINTS, 2, (0.6, -0.5), (0.4, 0.0))
    off = np.array([[0, 0, 0.06], [0, 0, 0.02], [0, 0, -0.02], [0, 0, -0.06]])
    cameras = [
        replace(camera, translation=camera.translation - camera.rotation @ away)
        for camera, away in zip(CAMERAS, off, strict=True)
    ]
    seen = rendered(CAMERAS, true_regions(CAMERAS, KEYPOINTS, person.keypoints[0]), person.keypoints[:1], 0)
    models = [camera_model(camera) for camera in cameras]
    trunk = [KEYPOINTS.index(name) for name in TRUNK]
    assert np.isnan(from_rays(models, seen.cameras)[0][trunk, 0]).sum() > 1
    pose = VideoReconstructor(cameras, KEYPOINTS).update(seen)
    assert np.median(np.linalg.norm(pose.keypoints - person.keypoints[0], axis=1)) < 0.08


def test_whoever_leaves_is_held_and_then_sought_anew():
    person = walking(KEYPOINTS, 1, (0.0, 0.0), (0.4, 0.0))
    seen = rendered(CAMERAS, true_regions(CAMERAS, KEYPOINTS, person.keypoints[0]), person.keypoints, 0)
    reconstructor = VideoReconstructor(CAMERAS, KEYPOINTS)
    reconstructor.update(seen)
    poses = [reconstructor.update(HeatMapFrame(f, f, (None,) * 4)) for f in range(1, 40)]
    assert (poses[5].newest.status == Status.HELD).all()
    assert np.isfinite(poses[5].newest.q_wb).all()
    assert (poses[-1].newest.status == Status.MISSING).all()


def test_a_floor_far_above_the_person_is_not_the_persons():
    person = walking(KEYPOINTS, 3, (0.0, 0.0), (0.4, 0.0))
    reconstructor, _, errors = tracked(person, 3, options=VideoOptions(floor_m=0.6))
    assert reconstructor.tracker.floor == -np.inf
    assert np.median(errors) < 0.004


def test_orientations_stray_about_as_far_as_their_sigma_says():
    """With the maps' blobs a cell off at random: cells are centimetres wide."""
    generator = np.random.default_rng(4)
    person = walking(KEYPOINTS, 30, (-0.6, 0.0), (0.3, 0.6))
    reconstructor = VideoReconstructor(CAMERAS, KEYPOINTS)
    regions, ratios = true_regions(CAMERAS, KEYPOINTS, person.keypoints[0]), []
    for f, points in enumerate(person.keypoints):
        off = generator.normal(size=(len(CAMERAS), len(points), 2))
        pose = reconstructor.update(rendered(CAMERAS, regions, points[None], f, None, off))
        regions = pose.regions
        if f >= 20:
            found = np.array([quaternion.to_matrix(q) for q in pose.newest.q_wb])
            turns = found @ person.R[f].transpose(0, 2, 1)
            angles = np.arccos(np.clip((np.trace(turns, axis1=1, axis2=2) - 1) / 2, -1, 1))
            ratios.append(angles / pose.newest.sigma)
    assert 0.5 < np.sqrt(np.mean(np.square(ratios))) < 1.6


def test_one_camera_from_the_start_places_somebody_on_the_floor():
    person = walking(KEYPOINTS, 6, (0.2, -0.3), (0.4, 0.6))
    camera = CAMERAS[:1]
    reconstructor = VideoReconstructor(camera, KEYPOINTS)
    for f, points in enumerate(person.keypoints):
        regions = true_regions(camera, KEYPOINTS, points)
        pose = reconstructor.update(rendered(camera, regions, points[None], f))
        off = np.linalg.norm(pose.keypoints - points, axis=1)
        assert np.median(off) < 0.25
    assert np.isfinite(pose.newest.sigma).all()
    floating = VideoReconstructor(camera, KEYPOINTS, VideoOptions(floor_m=None))
    assert np.isnan(floating.update(rendered(camera, regions, points[None], 0)).keypoints).all()
