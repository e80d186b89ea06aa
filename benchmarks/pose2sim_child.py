"""Pose2Sim's triangulation, in the interpreter that has Pose2Sim: started by ``video_peer``, as a file.

Imports nothing of the gateway: the two environments need not agree on anything but numpy.
"""

import sys

import numpy as np
from Pose2Sim.triangulation import triangulation_from_best_cameras

SETTINGS = {
    "triangulation": {"reproj_error_threshold_triangulation": 15, "min_cameras_for_triangulation": 2},
}
"""Pose2Sim's own defaults."""
LEAST_LIKELIHOOD = 0.3
"""Under which Pose2Sim drops a 2D point, by default."""


def main(given: str, found: str) -> None:
    """given: .npz with points (F, C, K, 2) undistorted pixels, likelihood (F, C, K), matrices (C, 3, 4)."""
    case = np.load(given)
    likelihood = np.where(case["likelihood"] < LEAST_LIKELIHOOD, np.nan, case["likelihood"])
    points = np.where(np.isnan(likelihood)[..., None], np.nan, case["points"])
    matrices = list(case["matrices"])
    n_frames, _, n_keypoints, _ = points.shape
    places = np.full((n_frames, n_keypoints, 3), np.nan)
    for f in range(n_frames):
        for k in range(n_keypoints):
            seen = (points[f, :, k, 0], points[f, :, k, 1], likelihood[f, :, k])
            places[f, k] = triangulation_from_best_cameras(SETTINGS, seen, seen, matrices, {})[0][:3]
    np.save(found, places)


main(*sys.argv[1:])
