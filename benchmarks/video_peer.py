"""Pose2Sim's triangulation on the same 2D points, as a yardstick.

Pose2Sim lives in an environment of its own. ``MOCAP_POSE2SIM`` names that environment's Python interpreter::

    python3.11 -m venv pose2sim && pose2sim/bin/pip install pose2sim==0.10.49
    MOCAP_POSE2SIM=$PWD/pose2sim/bin/python python -m benchmarks video

Without it, the weighted linear triangulation that it describes is done here, over all cameras.
"""

from __future__ import annotations

import os
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.signal import butter, filtfilt

from gateway.body.camera import Camera
from gateway.errors import GatewayError
from gateway.frames import FloatArray
from gateway.reconstruction.video.initial import LEAST_LIKELIHOOD, nearest_to_rays
from gateway.reconstruction.video.projection import camera_model, ray, undistorted

VARIABLE = "MOCAP_POSE2SIM"
_CHILD = Path(__file__).with_name("pose2sim_child.py")
_LONGEST_S = 900.0
CORNER_HZ = 6.0
"""Of Pose2Sim's default filter: Butterworth, order 4, forwards and backwards."""


def triangulated(
    cameras: Sequence[Camera], points: FloatArray, likelihood: FloatArray
) -> tuple[str, FloatArray]:
    """Who did it, and keypoints (F, n_keypoints, 3) m, of pixels (F, n_cameras, n_keypoints, 2).

    likelihood: of the pixels. Raises ``GatewayError`` when the interpreter named cannot do it.
    """
    python = os.environ.get(VARIABLE)
    if python:
        return "Pose2Sim's triangulation", _by_pose2sim(python, cameras, points, likelihood)
    return "weighted linear triangulation", _by_rays(cameras, points, likelihood)


def filtered(points: FloatArray, rate_hz: float) -> FloatArray:
    """As Pose2Sim does by default, gaps bridged linearly before."""
    whole = points.reshape(len(points), -1).copy()
    times = np.arange(len(whole))
    for column in whole.T:
        known = np.isfinite(column)
        column[:] = np.interp(times, times[known], column[known]) if known.any() else np.nan
    b, a = butter(2, CORNER_HZ, fs=rate_hz)
    smooth: FloatArray = filtfilt(b, a, whole, axis=0).reshape(points.shape)
    return smooth


def _by_pose2sim(
    python: str, cameras: Sequence[Camera], points: FloatArray, likelihood: FloatArray
) -> FloatArray:
    straight = np.full_like(points, np.nan)
    for c, camera in enumerate(cameras):
        model = camera_model(camera)
        for f, k in np.argwhere(np.isfinite(points[:, c, :, 0])):
            x, y = undistorted(model, *points[f, c, k])
            straight[f, c, k] = (camera.matrix @ [x, y, 1.0])[:2]
    matrices = [
        np.column_stack([each.matrix @ each.rotation, each.matrix @ each.translation]) for each in cameras
    ]
    with tempfile.TemporaryDirectory() as folder:
        given, found = Path(folder, "given.npz"), Path(folder, "found.npy")
        np.savez(given, points=straight, likelihood=likelihood, matrices=np.array(matrices))
        command = [python, str(_CHILD), str(given), str(found)]
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=_LONGEST_S, check=False)
        except OSError as error:
            raise GatewayError(f"{VARIABLE}={python}: not a Python interpreter ({error.strerror})") from error
        if done.returncode:
            outcome = (done.stderr.strip().splitlines() or ["no message"])[-1]
            raise GatewayError(f"{VARIABLE}={python}: {outcome}")
        return np.asarray(np.load(found), dtype=np.float64)


def _by_rays(cameras: Sequence[Camera], points: FloatArray, likelihood: FloatArray) -> FloatArray:
    models = [camera_model(camera) for camera in cameras]
    positions = np.stack([model.position for model in models])
    places = np.full((points.shape[0], points.shape[2], 3), np.nan)
    for f, k in np.ndindex(*places.shape[:2]):
        rays = np.stack([ray(model, *points[f, c, k]) for c, model in enumerate(models)])
        weights = np.where(likelihood[f, :, k] >= LEAST_LIKELIHOOD, likelihood[f, :, k], 0.0)
        places[f, k] = nearest_to_rays(positions, rays, weights)
    return places
