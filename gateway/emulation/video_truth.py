"""People whose keypoints are known, rendered as the heat maps that a perfect pose network would give."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gateway.body.camera import Camera, project
from gateway.body.joint_angles import posture
from gateway.body.skeleton import BodyMarkers, Skeleton
from gateway.frames import CameraHeatMaps, FloatArray, HeatMapFrame
from gateway.geometry import quaternion
from gateway.reconstruction.video.inverse_kinematics import video_body
from gateway.reconstruction.video.keypoint_set import KeypointSet
from gateway.reconstruction.video.proportions import PARTS, sized, standard_lengths
from gateway.reconstruction.video.region import PersonRegion, person_region
from gateway.sources.heat_maps import encoded_maps

RATE_HZ = 60.0
CELLS = 64
SPREAD = 2.0
"""Standard deviation of a keypoint's blob, cells."""
PEAK = 0.9
_STEP_HZ = 0.9
_LONG = dict.fromkeys(PARTS, 0.95) | {"hips": 0.55, "shoulders": 0.8, "head": 1.0}
"""Of the standard skeleton: a person of 1.66 m."""


@dataclass(frozen=True)
class KnownPerson:
    """A person's true motion."""

    skeleton: Skeleton
    markers: BodyMarkers
    R: FloatArray  # (F, S, 3, 3)
    joints: FloatArray  # (F, S, 3) m
    keypoints: FloatArray  # (F, n_keypoints, 3) m


def walking(
    keypoints: KeypointSet, n_frames: int, start: Sequence[float], velocity: Sequence[float],
    upside_down: bool = False, phase: float = 0.0,
) -> KnownPerson:  # fmt: skip
    """Return a person who walks from ``start`` with ``velocity`` (east, north), m and m/s; or on the
    hands."""
    lengths = standard_lengths(keypoints) * np.array([_LONG[part] for part in PARTS])
    skeleton, markers = sized(keypoints, lengths)
    body = video_body(skeleton, markers)
    times = np.arange(n_frames) / RATE_HZ
    heading = float(np.arctan2(velocity[1], velocity[0]))
    R = np.stack([_posture(skeleton, 2 * np.pi * _STEP_HZ * t + phase, heading, upside_down) for t in times])
    height = 1.1 if upside_down else 0.92
    roots = np.array([[*(np.array(start) + np.array(velocity) * t), height] for t in times])
    joints = [body.model.joints_at(*pose) for pose in zip(R, roots, strict=True)]
    points = [body.model.markers_at(*pose) for pose in zip(R, roots, strict=True)]
    return KnownPerson(skeleton, markers, R, np.stack(joints), np.stack(points))


def _posture(skeleton: Skeleton, phase: float, heading: float, upside_down: bool) -> FloatArray:
    """Return (S, 3, 3): a step of a walk with bent, swinging arms and a swaying trunk."""
    angles: dict[str, list[float]] = {}
    for side, turn in (("left", 0.0), ("right", np.pi)):
        swing = np.sin(phase + turn)
        angles[f"{side}_hip"] = [0.1 + 0.45 * swing, 0.03, 0.1]
        angles[f"{side}_knee"] = [0.35 - 0.3 * np.cos(phase + turn), 0.0, 0.0]
        angles[f"{side}_ankle"] = [0.1 * swing, 0.05, 0.0]
        angles[f"{side}_shoulder"] = [1.2, 0.5 - 0.3 * swing, -1.0]
        angles[f"{side}_elbow"] = [0.7 - 0.3 * swing, 0.0, 0.3]
        angles[f"{side}_wrist"] = [0.2 * swing, 0.0, 0.0]
    for joint in ("lumbosacral", "spine_l3", "spine_t12", "spine_thorax"):
        angles[joint] = [0.03, 0.02 * np.sin(phase), 0.03 * np.cos(phase)]
    for joint in ("neck_base", "neck_head"):
        angles[joint] = [0.05, 0.0, 0.15 * np.sin(0.5 * phase)]
    turned = quaternion.from_rotation_vector(np.array([0.0, 0.0, heading]))
    root = quaternion.multiply(turned, skeleton.neutral)
    if upside_down:
        over = quaternion.from_rotation_vector(np.array([0.0, np.pi * 0.95, 0.0]))
        root = quaternion.multiply(over, root)
    return np.stack([quaternion.to_matrix(q) for q in posture(skeleton, angles, root)])


def ring_of_cameras(n: int) -> list[Camera]:
    """Return cameras of 1080 × 1920 pixels with distortion, 4 m around the origin, 1.8 m high,
    looking at 0.9 m."""
    matrix = np.array([[1500.0, 0.0, 540.0], [0.0, 1500.0, 960.0], [0.0, 0.0, 1.0]])
    cameras = []
    for c in range(n):
        angle = 2 * np.pi * c / n + 0.3
        place = np.array([4.0 * np.cos(angle), 4.0 * np.sin(angle), 1.8])
        ahead = np.array([0.0, 0.0, 0.9]) - place
        ahead /= np.linalg.norm(ahead)
        right = np.cross(ahead, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        # Rows of the rotation are the camera's axes: x right, y down, z ahead.
        R = np.stack([right, np.cross(ahead, right), ahead])
        distortion = np.array([-0.05, 0.12, 0.0006, 0.0007, 0.0])
        cameras.append(Camera(f"ring{c}", 1080, 1920, matrix, distortion, R, -R @ place))
    return cameras


def true_regions(
    cameras: Sequence[Camera], keypoints: KeypointSet, points: FloatArray
) -> tuple[PersonRegion | None, ...]:
    """Return where a detector would find a person with keypoints (n_keypoints, 3)."""
    return tuple(person_region(camera, points, keypoints.names) for camera in cameras)


def rendered(
    cameras: Sequence[Camera], regions: Sequence[PersonRegion | None], people: FloatArray, frame: int,
    hidden: NDArray[np.bool_] | None = None, off: FloatArray | None = None,
) -> HeatMapFrame:  # fmt: skip
    """Return maps in which every person's keypoints (n_people, n_keypoints, 3), m, are blobs.

    hidden: (n_cameras, n_keypoints) of all people, not seen by a camera. off: (n_cameras, n_keypoints, 2)
    cells by which the blobs are beside their places.
    """
    maps: list[CameraHeatMaps | None] = []
    for c, (camera, region) in enumerate(zip(cameras, regions, strict=True)):
        if region is None:
            maps.append(None)
            continue
        affine = region.affine(CELLS)
        likelihood = np.zeros((people.shape[1], CELLS, CELLS))
        for points in people:
            cells = project(camera, points) @ affine[:, :2].T + affine[:, 2]
            likelihood = np.maximum(likelihood, _blobs(cells if off is None else cells + off[c]))
        if hidden is not None:
            likelihood[hidden[c]] = 0.0
        maps.append(CameraHeatMaps(likelihood.astype(np.float32), affine))
    return HeatMapFrame(frame, round(frame * 1e9 / RATE_HZ), tuple(maps))


def messages_of(cameras: Sequence[Camera], keypoints: KeypointSet, person: KnownPerson) -> list[list[bytes]]:
    """Return what the cameras send of a person, by instant: as the network ``full`` would see every
    picture."""
    instants = []
    for t, places in enumerate(person.keypoints):
        frame = rendered(cameras, true_regions(cameras, keypoints, places), places[None], t)
        instants.append(
            [
                encoded_maps(camera.name, "full", t, frame.time_ns, maps)
                for camera, maps in zip(cameras, frame.cameras, strict=True)
                if maps is not None
            ]
        )
    return instants


def _blobs(cells: FloatArray) -> FloatArray:
    """Return (n_keypoints, CELLS, CELLS) Gaussians about column and row (n_keypoints, 2)."""
    grid = np.arange(CELLS)
    across = np.exp(-0.5 * ((grid - cells[:, :1]) / SPREAD) ** 2)
    down = np.exp(-0.5 * ((grid - cells[:, 1:]) / SPREAD) ** 2)
    blobs: FloatArray = PEAK * np.nan_to_num(down[:, :, None] * across[:, None, :])
    return blobs
