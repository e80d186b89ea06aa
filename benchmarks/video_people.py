"""``video_people``: two people in real pictures, one of them hidden by times, and one person across the
pictures of two cameras side by side.

The clip has one person. A second one is that person again, cut out along the limbs and pasted a metre beside
by the affine map that moves the projected keypoints so: real pixels, in true places up to what perspective
changes within a body. Hidden, parts of the second one are not pasted, while the clip is played there and
back. Cameras side by side are one film cut in two down the middle of the person.
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
from gateway.calibration.picture_size import SizeChange, fitted
from gateway.cameras.camera_process import CameraTask
from gateway.cameras.filmed_people import FilmedPeople
from gateway.cameras.live_crowd import LiveCrowd
from gateway.cameras.rig_of_cameras import CameraRig, RigOptions
from gateway.frames import FloatArray
from gateway.reconstruction.video.keypoint_set import load_keypoint_set
from gateway.reconstruction.video.networks.keypoints import BLAZEPOSE, BONES
from gateway.reconstruction.video.reconstructor import VideoReconstructor, video_reconstructor
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
_HIDDEN = {"right half": range(30, 60), "whole": range(90, 120), "lower half": range(150, 180)}
"""Instants in which all cameras miss so much of the one pasted in."""
_HIDDEN_INSTANTS = 220
_NEAR_M = 0.3
"""Median distance of the limb joints under which a number is somebody's."""
_HIPS = [BLAZEPOSE.index(f"{side}_hip") for side in ("left", "right")]
_ROWS = [BLAZEPOSE.index(name) for name in LIMBS]


def run() -> Report:
    """Raises ``GatewayError`` without weights."""
    report = Report("video_people")
    alone_throughout = solve(look("full")).body
    alone = alone_throughout[:INSTANTS]
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
    report.figures += _hidden(alone_throughout)
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


def _hidden(alone: FloatArray) -> list[Figure]:
    """Return what becomes of two people's numbers, of whom one is hidden by times; alone: of the clip."""
    there_and_back = np.arange(_HIDDEN_INSTANTS) % (2 * len(alone) - 2)
    order = np.minimum(there_and_back, 2 * len(alone) - 2 - there_and_back)
    cameras = [
        fitted(each, each.width // 2, each.height // 2, SizeChange.SCALED) for each in calibrated_cameras()
    ]
    with tempfile.TemporaryDirectory() as folder:
        for camera, whole in zip(cameras, calibrated_cameras(), strict=True):
            size = camera.width, camera.height
            clip = [np.asarray(cv2.resize(each, size), np.uint8) for each in _film(whole, len(alone))]
            for t, f in enumerate(order):
                part = next((part for part, instants in _HIDDEN.items() if t in instants), "")
                _write(Path(folder) / camera.name, t, _with_another(camera, clip[f], alone[f], part))
        tasks = [_task(camera.name, Path(folder)) for camera in cameras]
        whose, n_numbers = _whose(cameras, tasks, np.stack([alone[order], alone[order] + ASIDE]))
    is_shown = [not any(t in instants for instants in _HIDDEN.values()) for t in range(_HIDDEN_INSTANTS)]
    has_number = [1 in people.values() for people, shown in zip(whose, is_shown, strict=True) if shown]
    switches = 0
    last: dict[int, int] = {}
    for people in whose:
        switches += sum(last.get(number, person) != person for number, person in people.items())
        last |= people
    return [
        Figure("hidden_numbers", n_numbers, "", "<=2", "given to two people, of whom one is hidden 3 times"),
        Figure("hidden_switches", switches, "", "<=0", "times that a number went over to the other one"),
        Figure(
            "hidden_followed_percent", 100.0 * float(np.mean(has_number)), "%",
            note="of the instants in which the one pasted in is not hidden",
        ),
    ]  # fmt: skip


def _whose(
    cameras: Sequence[Camera], tasks: Sequence[CameraTask], places: FloatArray
) -> tuple[list[dict[int, int]], int]:
    """Return, of every instant, by number which of the people (2, F, n_keypoints, 3) m it is near, and how
    many numbers were given."""
    solvers: dict[int, VideoReconstructor] = {}
    whose = []
    with CameraRig(VideoSetUp(tuple(cameras), "full"), tasks, RigOptions(people=2)) as rig:
        crowd = rig.people
        assert isinstance(crowd, LiveCrowd)
        for t, instant in enumerate(islice(rig, places.shape[1])):
            found = {}
            for number, messages in instant.messages.items():
                points = solvers[number].update(heat_map_frame(t, messages)).keypoints
                off = np.median(np.linalg.norm(places[:, t, _ROWS] - points[_ROWS], axis=2), axis=1)
                if not instant.absent[number] and off.min() < _NEAR_M:
                    found[number] = int(np.argmin(off))
            whose.append(found)
            for number, suit in instant.entered.items():
                solvers[number] = video_reconstructor(suit)
                crowd.solved_by(number, solvers[number])
    return whose, len(solvers)


def pasted(cameras: Sequence[Camera], places: FloatArray, folder: Path) -> list[CameraTask]:
    """Folders of the clip's pictures with the person (n, n_keypoints, 3) m in them twice."""
    for camera in cameras:
        for t, (picture, points) in enumerate(zip(_film(camera, len(places)), places, strict=True)):
            _write(folder / camera.name, t, _with_another(camera, picture, points))
    return [_task(camera.name, folder) for camera in cameras]


def _with_another(camera: Camera, picture: Picture, points: FloatArray, hidden: str = "") -> Picture:
    """Return a picture with the person (n_keypoints, 3) m in it once more; hidden: of ``_HIDDEN``."""
    here, there = project(camera, points), project(camera, points + ASIDE)
    affine, _ = cv2.estimateAffine2D(here.astype(np.float32), there.astype(np.float32))
    size = picture.shape[1], picture.shape[0]
    depths = (np.stack([points, points + ASIDE]).mean(axis=1) @ camera.rotation.T + camera.translation)[:, 2]
    own = _outline(camera, here, float(depths[0]), size)
    moved = cv2.warpAffine(picture, affine, size)
    shown = _without(own, here, hidden)
    both = _laid(moved, picture, cv2.warpAffine(shown, affine, size))
    return _laid(picture, both, own) if depths[1] > depths[0] else both


def _without(outline: Picture, pixels: FloatArray, hidden: str) -> Picture:
    """Return an outline without a part, told from the rest by the hips."""
    column, row = np.clip(pixels[_HIPS].mean(axis=0), 0, outline.shape[1::-1]).astype(np.int64)
    shown = outline.copy()
    if hidden == "whole":
        shown[:] = 0
    elif hidden == "right half":
        shown[:, column:] = 0
    elif hidden == "lower half":
        shown[row:] = 0
    return shown


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
