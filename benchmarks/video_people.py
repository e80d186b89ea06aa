"""``video_people``: two people in real pictures, and one across the pictures of two cameras side by side.

The clip has one person. A second one is that person again, cut out along the limbs and pasted a metre beside
by the affine map that moves the projected keypoints so: real pixels, in true places up to what perspective
changes within a body. Cameras side by side are one film cut in two down the middle of the person.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path

import cv2
import numpy as np

from benchmarks.figures import Figure, Report
from benchmarks.video_pictures import DATA, RATE_HZ, calibrated_cameras, look, solve
from benchmarks.video_scoring import LIMBS
from devices.cameras.pictures import Picture, open_pictures
from gateway.body.camera import Camera, project
from gateway.body.skeleton import VideoSetUp
from gateway.cameras.camera_process import CameraTask
from gateway.cameras.filmed_people import FilmedPeople
from gateway.cameras.rig_of_cameras import CameraRig, RigOptions
from gateway.frames import FloatArray
from gateway.reconstruction.video.keypoint_set import load_keypoint_set
from gateway.reconstruction.video.networks.keypoints import BLAZEPOSE, BONES
from gateway.reconstruction.video.reconstructor import VideoReconstructor
from gateway.sources.heat_maps import heat_map_frame

INSTANTS = 40
ASIDE = np.array([1.0, -0.2, 0.0])
"""m, from the person to the one pasted in."""
CUT = {"cam01": 460, "cam04": 430}
"""Column at which a film is cut in two."""
_OVERLAP = 10
_SETTLED = 5
"""First instants that do not count."""
_TRUNK = (("left_hip", "right_shoulder"), ("right_hip", "left_shoulder"))
_ENDS = (
    ("nose", "left_shoulder"), ("nose", "right_shoulder"), ("left_wrist", "left_index"),
    ("right_wrist", "right_index"), ("left_heel", "left_foot_index"), ("right_heel", "right_foot_index"),
)  # fmt: skip
_LIMB_M, _TRUNK_M, _HEAD_M = 0.17, 0.26, 0.15
"""Breadths, and the radius of the head."""
_ROWS = [BLAZEPOSE.index(name) for name in LIMBS]


def run() -> Report:
    """Raises ``GatewayError`` without weights."""
    report = Report("video_people")
    alone = solve(look("full")).body[:INSTANTS]
    cameras = calibrated_cameras()
    with tempfile.TemporaryDirectory() as folder:
        tasks = pasted(cameras, alone, Path(folder))
        people = _solved(VideoSetUp(tuple(cameras), "full"), tasks, RigOptions(people=2))
    off = [[_apart(person, alone + shift) for person in people] for shift in (np.zeros(3), ASIDE)]
    report.figures += [
        Figure(
            "two_people_first_mm", min(off[0]), "mm", "<=60", "median of 12 joints; a swap would be a metre"
        ),
        Figure("two_people_pasted_mm", min(off[1]), "mm", "<=60", "the same of the one pasted in"),
    ]
    with tempfile.TemporaryDirectory() as folder:
        halves, tasks = _cut(cameras, Path(folder))
        pairs = tuple((n, n + 1) for n, half in enumerate(halves[:-1]) if half.name.endswith("_left"))
        apart, joined = (
            _apart(
                _solved(VideoSetUp(tuple(halves), "full", each), tasks, RigOptions(must_agree=False))[0],
                alone,
            )
            for each in ((), pairs)
        )
    report.figures += [
        Figure("cut_pictures_mm", apart, "mm", note="one person, two films cut in two, every half alone"),
        Figure("joined_pictures_mm", joined, "mm", "<=10", "the halves put together"),
        Figure("joined_over_cut", joined / apart, "", "<1.0", "the one over the other"),
    ]
    return report


def _apart(found: FloatArray, known: FloatArray) -> float:
    """Median distance of the limb joints, mm."""
    off = np.linalg.norm(found[_SETTLED:, _ROWS] - known[_SETTLED:, _ROWS], axis=2)
    return 1e3 * float(np.nanmedian(off))


def _solved(video: VideoSetUp, tasks: Sequence[CameraTask], options: RigOptions) -> list[FloatArray]:
    """By person (INSTANTS, n_keypoints, 3) m, not smoothed."""
    keypoints = load_keypoint_set("blazepose_33")
    with CameraRig(video, tasks, options) as rig:
        filmed = FilmedPeople(video, rig.rate_hz)
        for instant in islice(rig, INSTANTS):
            filmed.add(instant)
    found = []
    for person in filmed.people:
        reconstructor = VideoReconstructor(video.cameras, keypoints)
        poses = [reconstructor.update(heat_map_frame(t, messages)) for t, messages in enumerate(person)]
        found.append(np.array([pose.keypoints for pose in poses]))
    return found


def pasted(cameras: Sequence[Camera], places: FloatArray, folder: Path) -> list[CameraTask]:
    """Folders of the clip's pictures with the person (n, n_keypoints, 3) m in them twice."""
    for camera in cameras:
        for t, (picture, points) in enumerate(zip(_film(camera, len(places)), places, strict=True)):
            _write(folder / camera.name, t, _with_another(camera, picture, points))
    return [_task(camera.name, folder) for camera in cameras]


def _with_another(camera: Camera, picture: Picture, points: FloatArray) -> Picture:
    here, there = project(camera, points), project(camera, points + ASIDE)
    affine, _ = cv2.estimateAffine2D(here.astype(np.float32), there.astype(np.float32))
    size = picture.shape[1], picture.shape[0]
    depths = (np.stack([points, points + ASIDE]).mean(axis=1) @ camera.rotation.T + camera.translation)[:, 2]
    own = _outline(camera, here, float(depths[0]), size)
    moved = cv2.warpAffine(picture, affine, size)
    both = _laid(moved, picture, cv2.warpAffine(own, affine, size))
    return _laid(picture, both, own) if depths[1] > depths[0] else both


def _outline(camera: Camera, pixels: FloatArray, depth: float, size: tuple[int, int]) -> Picture:
    """(rows, columns) 255 where the person is."""
    a_metre = camera.matrix[0, 0] / depth
    mask = np.zeros(size[::-1], dtype=np.uint8)
    at = {name: tuple(int(v) for v in pixel) for name, pixel in zip(BLAZEPOSE, pixels, strict=True)}
    for a, b in (*BONES, *_ENDS):
        cv2.line(mask, at[a], at[b], 255, round(_LIMB_M * a_metre))
    for a, b in _TRUNK:
        cv2.line(mask, at[a], at[b], 255, round(_TRUNK_M * a_metre))
    middle = np.mean([at["left_ear"], at["right_ear"]], axis=0)
    cv2.circle(mask, (int(middle[0]), int(middle[1])), round(_HEAD_M * a_metre), 255, -1)
    return mask


def _laid(above: Picture, below: Picture, mask: Picture) -> Picture:
    share = cv2.GaussianBlur(mask, (9, 9), 0)[:, :, None] / 255.0
    return np.asarray(above * share + below * (1.0 - share), dtype=np.uint8)


def _cut(cameras: Sequence[Camera], folder: Path) -> tuple[list[Camera], list[CameraTask]]:
    """Cameras and pictures, those of ``CUT`` in two halves."""
    halves, tasks = [], []
    for camera in cameras:
        if camera.name not in CUT:
            halves.append(camera)
            tasks.append(CameraTask(camera.name, str(DATA / f"videos/{camera.name}.mp4"), "full"))
            continue
        middle = CUT[camera.name]
        for side, first, last in (
            ("left", 0, middle + _OVERLAP), ("right", middle - _OVERLAP, camera.width),
        ):  # fmt: skip
            name = f"{camera.name}_{side}"
            matrix = camera.matrix - np.array([[0, 0, first], [0, 0, 0], [0, 0, 0]])
            halves.append(replace(camera, name=name, width=last - first, matrix=matrix))
            for t, picture in enumerate(_film(camera)):
                _write(folder / name, t, picture[:, first:last])
            tasks.append(_task(name, folder))
    return halves, tasks


def _film(camera: Camera, count: int = INSTANTS) -> Iterator[Picture]:
    source = open_pictures(str(DATA / f"videos/{camera.name}.mp4"))
    for _, picture in islice(source, count):
        yield picture
    source.close()


def _write(folder: Path, t: int, picture: Picture) -> None:
    folder.mkdir(exist_ok=True)
    cv2.imwrite(str(folder / f"{t:03}.bmp"), picture)


def _task(name: str, folder: Path) -> CameraTask:
    return CameraTask(name, str(folder / name), "full", RATE_HZ)
