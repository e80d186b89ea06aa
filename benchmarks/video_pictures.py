"""Four cameras' pictures of one walker through detector, network and reconstructor, timed by stage."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.people_apart import people_apart
from devices.cameras.pictures import Picture, open_pictures
from gateway.body.camera import Camera, project
from gateway.calibration.cameras_import import import_cameras
from gateway.calibration.picture_size import SizeChange, fitted
from gateway.frames import CameraHeatMaps, FloatArray, HeatMapFrame
from gateway.geometry import quaternion
from gateway.reconstruction.video.initial import centroids
from gateway.reconstruction.video.inverse_kinematics import video_body
from gateway.reconstruction.video.keypoint_set import KeypointSet, load_keypoint_set
from gateway.reconstruction.video.networks.network import PoseNetwork
from gateway.reconstruction.video.networks.person_detector import PersonDetector
from gateway.reconstruction.video.networks.weights import load_network
from gateway.reconstruction.video.projection import camera_model
from gateway.reconstruction.video.reconstructor import VideoOptions, VideoReconstructor
from gateway.reconstruction.video.region import PersonRegion

DATA = Path(__file__).parents[2] / "shared/data/pose2sim_single"
RATE_HZ = 60.0
_MOST_OFF = 4


@dataclass(frozen=True)
class Seen:
    """All pictures as heat maps, cropped by the pose of the frame before."""

    cameras: tuple[Camera, ...]
    person: KeypointSet
    """On the walker's body."""
    frames: list[HeatMapFrame]
    network_ms: float
    """Processor time a frame, all cameras: crop and network."""
    reconstructor_ms: float
    """Processor time a frame: lattices, inverse kinematics, smoothing."""


@dataclass(frozen=True)
class Solved:
    """Keypoints over time, (F, n_keypoints, 3) m."""

    candidates: FloatArray
    body: FloatArray
    smoothed: FloatArray


def calibrated_cameras() -> tuple[Camera, ...]:
    """As the pictures are. Those of two cameras were shrunk from 1088 to 1080 columns, with a border above
    and below: their still pictures, in the calibrated size, lie over the films' so and not otherwise."""
    return tuple(
        fitted(camera, info.width, info.height, SizeChange.SCALED)
        for camera in import_cameras(DATA / "calibration/Calib.qca.txt")
        for info in [open_pictures(str(DATA / f"videos/{camera.name}.mp4")).info]
    )


def look(network_name: str) -> Seen:
    """Raises ``GatewayError`` when weights are missing."""
    cameras = calibrated_cameras()
    network, keypoints = load_network(network_name, threads=2), load_keypoint_set("blazepose_33")
    reconstructor = VideoReconstructor(cameras, keypoints)
    sources = [open_pictures(str(DATA / f"videos/{camera.name}.mp4")) for camera in cameras]
    frames: list[HeatMapFrame] = []
    spent = np.zeros(2)
    regions: tuple[PersonRegion | None, ...] = ()
    for f, pictures in enumerate(zip(*sources, strict=True)):
        began = time.process_time()
        shown = [picture for _, picture in pictures]
        maps = _maps(network, shown, regions) if f else _first(cameras, network, shown)
        looked = time.process_time()
        frames.append(HeatMapFrame(f, round(f * 1e9 / RATE_HZ), maps))
        regions = reconstructor.update(frames[-1]).regions
        if f:  # the first compiles
            spent += looked - began, time.process_time() - looked
    for source in sources:
        source.close()
    network_ms, reconstructor_ms = 1e3 * spent / (len(frames) - 1)
    return Seen(cameras, reconstructor.person, frames, network_ms, reconstructor_ms)


def solve(seen: Seen) -> Solved:
    """All frames with the lengths measured before."""
    options = VideoOptions(is_measured=True)
    reconstructor = VideoReconstructor(seen.cameras, seen.person, options)
    poses = [reconstructor.update(frame) for frame in seen.frames]
    smoothed = [pose.skeleton for pose in poses if pose.skeleton is not None] + reconstructor.finish()
    body = video_body(seen.person.skeleton, seen.person.markers)
    places = [
        body.model.markers_at(np.stack([quaternion.to_matrix(q) for q in frame.q_wb]), frame.p_w[0])
        for frame in smoothed
    ]
    return Solved(
        np.array([pose.candidates for pose in poses]), np.array([pose.keypoints for pose in poses]),
        np.array(places),
    )  # fmt: skip


def points_2d(seen: Seen) -> tuple[FloatArray, FloatArray]:
    """What other methods triangulate: pixels (F, n_cameras, n_keypoints, 2) of the centroids about the maps'
    highest values, and those values (F, n_cameras, n_keypoints)."""
    n = len(seen.person.names)
    nothing = (np.full((n, 2), np.nan), np.zeros(n))
    found = [[_centroids(maps) if maps is not None else nothing for maps in f.cameras] for f in seen.frames]
    return (
        np.array([[points for points, _ in frame] for frame in found]),
        np.array([[likely for _, likely in frame] for frame in found]),
    )


def _centroids(maps: CameraHeatMaps) -> tuple[FloatArray, FloatArray]:
    """(n_keypoints, 2) pixels, and how high the maps are there."""
    places, peaks = centroids(maps.likelihood)
    A = maps.map_from_pixel
    pixels: FloatArray = np.linalg.solve(A[:, :2], (places - A[:, 2]).T).T.astype(np.float64)
    return pixels, peaks


def off_in_pictures(seen: Seen, rows: list[int], reference: FloatArray) -> int:
    """Pictures by which the 2D points of all cameras match the reference (F, 12, 3) m best when taken later.

    rows: of the keypoints. What is off by as much in all frames does not count.
    """
    points, _ = points_2d(seen)
    spread = []
    for late in range(-_MOST_OFF, _MOST_OFF + 1):
        early = slice(max(0, -late), len(points) - max(0, late))
        later = slice(max(0, late), len(points) - max(0, -late))
        off = np.stack(
            [
                points[later, c][:, rows] - project(each, reference[early])
                for c, each in enumerate(seen.cameras)
            ]
        )
        off -= np.nanmedian(off, axis=1, keepdims=True)
        spread.append(float(np.nanmedian(np.linalg.norm(off, axis=-1))))
    return int(np.argmin(spread)) - _MOST_OFF


def _maps(
    network: PoseNetwork, pictures: list[Picture], regions: tuple[PersonRegion | None, ...]
) -> tuple[CameraHeatMaps | None, ...]:
    return tuple(
        None if region is None else network.heat_maps(picture, region)
        for picture, region in zip(pictures, regions, strict=True)
    )


def _first(
    cameras: tuple[Camera, ...], network: PoseNetwork, pictures: list[Picture]
) -> tuple[CameraHeatMaps | None, ...]:
    """The maps of the person whom most cameras agree on."""
    detector = PersonDetector(threads=2)
    detections = [
        [network.heat_maps(picture, person.region) for person in detector.people(picture)]
        for picture in pictures
    ]
    return people_apart([camera_model(camera) for camera in cameras], detections)[0]
