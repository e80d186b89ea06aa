"""Keypoints that other programs found: files of every kind, people told apart, poses of a known walk."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("cv2")

from typer.testing import CliRunner

from devices.cameras.keypoint_files import is_keypoints, read_keypoints
from devices.vendor_formats.sheets import FormatError
from gateway.body.camera import project
from gateway.calibration.cameras_file import cameras_text
from gateway.cameras.film import drawn_instants
from gateway.cameras.imported_keypoints import keypoint_messages
from gateway.cli.main import app
from gateway.cli.video import named
from gateway.emulation.video_truth import KnownPerson, ring_of_cameras, walking
from gateway.errors import GatewayError
from gateway.frames import FloatArray
from gateway.reconstruction.video.keypoint_set import load_keypoint_set
from gateway.reconstruction.video.networks.imported import LAYOUTS, layout_of
from gateway.reconstruction.video.reconstructor import VideoReconstructor
from gateway.recording import open_recording
from gateway.recording.solving import verify
from gateway.sources.heat_maps import heat_map_frame

CAMERAS = ring_of_cameras(4)
FRAMES = 16


def _found(
    person: KnownPerson, camera: int, frame: int, layout: tuple[str, ...], names: tuple[str, ...]
) -> FloatArray:
    """(n, 3) of somebody in a picture, in the order of a program."""
    pixels = project(CAMERAS[camera], person.keypoints[frame])
    found = np.zeros((len(layout), 3))
    for row, name in enumerate(layout):
        if name:
            found[row] = *pixels[names.index(name)], 0.9
    return found


def _numbered() -> FloatArray:
    """(17, 3) of somebody whose numbers tell which they are."""
    person = np.arange(51.0).reshape(17, 3)
    person[:, 2] = 0.5
    return person


def _folder(path: Path, people: list[list[FloatArray]]) -> Path:
    """Files of OpenPose's kind, a picture each; numbers without leading zeros."""
    path.mkdir()
    for f, each in enumerate(people):
        content = {"version": 1.3, "people": [{"pose_keypoints_2d": p.ravel().tolist()} for p in each]}
        (path / f"film2_{f}_keypoints.json").write_text(json.dumps(content))
    return path


@pytest.mark.parametrize("n_keypoints", [17, 18, 25, 26, 33, 133, 136])
def test_every_layout_names_the_keypoints_of_its_set(n_keypoints: int) -> None:
    keypoint_set, layout = layout_of(n_keypoints, "there")
    assert len(layout) == n_keypoints
    names = [name for name in layout if name]
    assert sorted(names) == sorted(load_keypoint_set(keypoint_set).names)
    assert len(set(names)) == len(names)


def test_an_unknown_number_of_keypoints_is_refused() -> None:
    with pytest.raises(
        GatewayError, match="there: 21 keypoints a person: known are 17, 18, 25, 26, 33, 133, 136"
    ):
        layout_of(21, "there")


def test_files_of_both_kinds_are_read(tmp_path: Path) -> None:
    person = _numbered()
    folder = _folder(tmp_path / "a", [[person], [], *[[person + f] for f in range(9)]])
    read = read_keypoints(folder)
    assert (len(read.people), read.n_keypoints, len(read.people[1])) == (11, 17, 0)
    np.testing.assert_array_equal(read.people[10][0], person + 8)  # 10 after 9, not after 1
    results = [
        {"image_id": f"film2_{f:03d}.png", "keypoints": person.ravel().tolist(), "score": 1}
        for f in (4, 6, 6)
    ]
    file = tmp_path / "b.json"
    file.write_text(json.dumps(results))
    assert [len(each) for each in read_keypoints(file).people] == [1, 0, 2]
    file.write_text(json.dumps({"annotations": results}))
    assert [len(each) for each in read_keypoints(file).people] == [1, 0, 2]
    predictions = [
        {
            "frame_id": f,
            "instances": [{"keypoints": (person[:, :2] + f).tolist(), "keypoint_scores": [0.5] * 17}] * n,
        }
        for f, n in ((1, 1), (2, 0), (4, 2))
    ]
    for content in (predictions, {"meta_info": {}, "instance_info": predictions}):
        file.write_text(json.dumps(content))
        read = read_keypoints(file)
        assert [len(each) for each in read.people] == [1, 0, 0, 2]
        np.testing.assert_array_equal(read.people[3][1], person + np.array([4, 4, 0]))
    assert [is_keypoints(str(each)) for each in (folder, file)] == [True, True]
    assert not is_keypoints(str(tmp_path / "film.mp4"))


def test_pictures_without_a_file_show_nobody(tmp_path: Path) -> None:
    person = _numbered()
    folder = _folder(tmp_path / "a", [[person + f] for f in range(12)])
    for missing in (0, 1, 5):
        (folder / f"film2_{missing}_keypoints.json").unlink()
    read = read_keypoints(folder)
    assert (read.first, len(read.people)) == (2, 10)
    assert [bool(each) for each in read.people] == [True] * 3 + [False] + [True] * 6
    strided = _folder(tmp_path / "b", [])
    for f in range(0, 60, 5):
        (strided / f"{f}.json").write_text(json.dumps({"people": [{"keypoints": person.ravel().tolist()}]}))
    assert len(read_keypoints(strided).people) == 12
    for f in range(3):
        (strided / f"{10**12 * (f + 1)}.json").write_text('{"people": []}')  # no numbers of pictures
    assert len(read_keypoints(strided).people) == 15


def test_a_camera_whose_first_pictures_show_nobody_stays_in_step(tmp_path: Path) -> None:
    """COCO's results have no entry of a picture in which nobody is found."""
    keypoint_set, layout = LAYOUTS[17]
    keypoints = load_keypoint_set(keypoint_set)
    person = walking(keypoints, FRAMES, (-0.1, 0.0), (0.8, 0.3))
    read = []
    for c in range(len(CAMERAS)):
        entries = [
            {"image_id": f, "keypoints": _found(person, c, f, layout, keypoints.names).ravel().tolist()}
            for f in range(5 if c == 2 else 0, FRAMES)
        ]
        (tmp_path / f"{c}.json").write_text(json.dumps(entries))
        read.append(read_keypoints(tmp_path / f"{c}.json"))
    _, (messages,) = keypoint_messages(CAMERAS, read, {}, 60.0, 1)
    assert len(messages) == FRAMES
    assert [heat_map_frame(0, each).cameras[2] is None for each in messages] == [True] * 5 + [False] * 11


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("{", "cannot be read as JSON"),
        ("{}", "neither 'people'"),
        ("[]", "an empty list"),
        ('[{"image_id": 1}]', "a person without pose_keypoints_2d or keypoints"),
        ('[{"image_id": 1, "keypoints": [1, 2]}]', "a person without"),
        ('[{"image_id": "first", "keypoints": [1, 2, 3]}]', "has no number"),
        ('[{"image_id": 1, "keypoints": [1, 2, Infinity]}]', "infinite keypoints"),
        ('[{"image_id": 1, "keypoints": [1, 2, NaN]}]', "no keypoint has a likelihood over 0"),
        ('[{"image_id": 1, "keypoints": [1, 2, 95]}]', "of up to 95: 0 to 1 are wanted"),
        ('[{"frame_id": 1, "instances": [{"keypoints": [[1, 2]]}]}]', "a person without"),
        ('{"instance_info": [{"frame_id": 1, "instances": [1]}]}', "a person without"),
        ('{"people": []}', "nobody in any of 1 pictures"),
        (
            '{"people": [{"pose_keypoints_2d": [1,2,3]}, {"pose_keypoints_2d": [1,2,3,4,5,6]}]}',
            "1 with 1 and 1 with 2 keypoints",
        ),
        ('{"people": [{"pose_keypoints_2d": [1, 2, 0.12]}]}', "of 0.12 at the most: 0 to 1 are wanted"),
    ],
)
def test_what_is_no_such_file_is_refused(tmp_path: Path, content: str, said: str) -> None:
    file = tmp_path / "bad.json"
    file.write_text(content)
    with pytest.raises(FormatError, match=said):
        read_keypoints(file)


def test_a_person_with_an_empty_list_is_nobody(tmp_path: Path) -> None:
    file = tmp_path / "a.json"
    file.write_text('{"people": [{"pose_keypoints_2d": []}, {"pose_keypoints_2d": [1, 2, 0.9]}]}')
    ((person,),) = read_keypoints(file).people
    np.testing.assert_array_equal(person, [[1, 2, 0.9]])


def test_files_are_matched_to_the_names_of_pose2sim_and_unknown_names_are_told(tmp_path: Path) -> None:
    known = ["int_cam01_img", "int_cam02_img", "int_cam03_img"]
    places = ["a/cam03_json", "a/cam01_json"]
    assert named(places, known, tmp_path) == {known[0]: places[1], known[2]: places[0]}
    with pytest.raises(GatewayError, match="has no camera 'cam9' \\(cameras: int_cam01_img"):
        named([f"cam9={tmp_path}"], known, tmp_path)


@pytest.mark.parametrize("unknown", ["NaN", "null"])
def test_keypoints_that_are_no_numbers_were_not_found(tmp_path: Path, unknown: str) -> None:
    file = tmp_path / "a.json"
    file.write_text(
        '[{"image_id": 1, "keypoints": [1, 2, 0.5, UNKNOWN, 3, 0.9]}]'.replace("UNKNOWN", unknown)
    )
    np.testing.assert_array_equal(read_keypoints(file).people[0][0], [[1, 2, 0.5], [0, 0, 0]])


@pytest.mark.timeout(600)
def test_two_walkers_are_told_apart_and_found_where_they_are(tmp_path: Path) -> None:
    """OpenPose's BODY_25; each camera lists the people in another order, one loses one for three pictures,
    and the second comes later."""
    keypoint_set, layout = LAYOUTS[25]
    keypoints = load_keypoint_set(keypoint_set)
    frames, late = 40, 8
    people = [
        walking(keypoints, frames, (-0.1, 0.6), (0.8, 0.0)),
        walking(keypoints, frames, (0.1, -0.6), (-0.8, 0.1), phase=1.0),
    ]
    read = []
    for c in range(len(CAMERAS)):
        pictures = []
        for f in range(frames):
            order = people if (c + f) % 2 else people[::-1]
            lost = (people[0], c == 1 and 5 <= f < 8), (people[1], f < late)
            kept = [p for p in order if not any(p is each and is_lost for each, is_lost in lost)]
            pictures.append([_found(person, c, f, layout, keypoints.names) for person in kept])
        read.append(read_keypoints(_folder(tmp_path / f"camera{c}", pictures)))
    network, captured = keypoint_messages(CAMERAS, read, {}, 60.0, 2)
    assert (network, [len(each) for each in captured]) == ("feet_24", [frames, frames])
    begun = [
        next(f for f, each in enumerate(person) if any(heat_map_frame(f, each).cameras))
        for person in captured
    ]
    assert begun[0] < 3
    assert late <= begun[1] < late + 8
    places = []
    for messages in captured:
        reconstructor = VideoReconstructor(CAMERAS, keypoints)
        for f, instant in enumerate(messages):
            pose = reconstructor.update(heat_map_frame(f, instant))
        places.append(pose.keypoints)
    for person in people:
        errors = [np.median(np.linalg.norm(at - person.keypoints[-1], axis=1)) for at in places]
        assert min(errors) < 0.01
        assert max(errors) > 0.5


def test_a_picture_of_another_network_is_named(tmp_path: Path) -> None:
    folder = _folder(tmp_path / "a", [[np.ones((17 if f == 3 else 25, 3))] for f in range(8)])
    with pytest.raises(FormatError, match=r"film2_3_keypoints\.json: 17 keypoints a person, 25 in most"):
        read_keypoints(folder)


def test_cameras_of_different_networks_are_refused(tmp_path: Path) -> None:
    read = [read_keypoints(_folder(tmp_path / str(n), [[np.ones((n, 3))]])) for n in (17, 25)]
    with pytest.raises(GatewayError, match="different networks"):
        keypoint_messages(CAMERAS[:2], read, {}, 60.0, 1)


@pytest.mark.parametrize(
    ("factor", "said"), [(3.0, "are the pictures larger"), (1e-3, "are shares of the picture")]
)
def test_what_are_no_pixels_of_the_calibrated_pictures_is_one_error(tmp_path, factor, said) -> None:
    keypoint_set, layout = LAYOUTS[17]
    keypoints = load_keypoint_set(keypoint_set)
    person = walking(keypoints, 1, (-0.1, 0.0), (0.8, 0.3))
    read = []
    for c in range(4):
        points = _found(person, c, 0, layout, keypoints.names)
        points[:, :2] *= factor if c == 1 else 1.0
        read.append(read_keypoints(_folder(tmp_path / str(c), [[points]])))
    with pytest.raises(GatewayError, match=rf"/1: .*{said}"):
        keypoint_messages(CAMERAS, read, {}, 60.0, 1)


def test_nobody_whom_two_cameras_see_is_one_error(tmp_path: Path) -> None:
    face = np.zeros((17, 3))
    face[0] = 500, 400, 0.9
    read = [read_keypoints(_folder(tmp_path / str(c), [[face]])) for c in range(4)]
    with pytest.raises(GatewayError, match="no two cameras see"):
        keypoint_messages(CAMERAS, read, {}, 60.0, 1)


@pytest.mark.timeout(600)
def test_the_command_solves_them(tmp_path: Path) -> None:
    """Halpe's 26, as RTMPose writes them for Pose2Sim."""
    keypoint_set, layout = LAYOUTS[26]
    keypoints = load_keypoint_set(keypoint_set)
    person = walking(keypoints, FRAMES, (-0.1, 0.0), (0.8, 0.3))
    places = [
        str(
            _folder(
                tmp_path / f"{camera.name}_json",
                [[_found(person, c, f, layout, keypoints.names)] for f in range(FRAMES)],
            )
        )
        for c, camera in enumerate(CAMERAS)
    ]
    calibration, target = tmp_path / "cameras.yaml", tmp_path / "walk.mcap"
    calibration.write_text(cameras_text(CAMERAS))
    command = ["video", "solve", *places, "--cameras", str(calibration), "-o", str(target)]
    without_rate = CliRunner().invoke(app, command)
    assert "--rate" in str(without_rate.exception)
    done = CliRunner().invoke(app, [*command, "--rate", "60"])
    assert done.exit_code == 0, done.output
    recording = open_recording(target)
    arrays = recording.skeleton_arrays()
    assert arrays.rate_hz == pytest.approx(60.0)
    joints = [
        arrays.skeleton.index(f"{side}_{part}") for side in ("left", "right") for part in ("hand", "foot")
    ]
    apart = np.linalg.norm(arrays.p_w[-1, joints] - person.joints[len(arrays.p_w) - 1, joints], axis=1)
    assert apart.max() < 0.03
    assert verify(recording).is_identical
    video = recording.meta.suit.video
    assert video is not None
    blank = [np.zeros((camera.height, camera.width, 3), np.uint8) for camera in CAMERAS]
    (drawn,) = drawn_instants(recording, video, [blank], height=320)
    assert drawn.shape == (320, 720, 3)
    assert all(drawn[:, left : left + 180].max() > 100 for left in range(0, 720, 180))
