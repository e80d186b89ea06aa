"""Where keypoints are when one camera alone looks on: by the floor under the feet, and a guess beyond that.

One camera tells no depth. Somebody who stands has a foot on the floor, which tells how far away it is; all
other keypoints are taken to be as far, in the upright plane through that foot that faces the camera. What
comes out is as tall and as far away as the person, and as flat as a shadow: the body laid over it gives it
its depth, within the limits of its joints.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from gateway.frames import CameraHeatMaps, FloatArray
from gateway.reconstruction.video.initial import LEAST_LIKELIHOOD, rays_through
from gateway.reconstruction.video.projection import CameraModel

FEET = {"ankle": 0.08, "heel": 0.03, "foot_index": 0.02}
"""Keypoints near the floor, and how high they are on who stands, m."""
_FEWEST = 8
"""Keypoints."""
_SHOWN = 80.0
"""Percentile of the parts' ratios to the standard body that is the person's: what points at the camera looks
short, nothing looks long."""


def from_floor(model: CameraModel, maps: CameraHeatMaps, names: Sequence[str], floor: float) -> FloatArray:
    """Return keypoints (n_keypoints, 3) m; NaN for all without a foot in sight, or with few keypoints.

    floor: its height, m.
    """
    directions, likely = rays_through(model, maps)
    sure = likely >= LEAST_LIKELIHOOD
    nothing = np.full((len(names), 3), np.nan)
    foot = _nearest_foot(model.position, directions, sure, names, floor)
    if foot is None or sure.sum() < _FEWEST:
        return nothing
    ahead = foot - model.position
    ahead[2] = 0.0
    along = np.where(sure, directions @ ahead, np.nan)
    distance = np.where(along > 0.0, float(ahead @ ahead) / along, np.nan)
    return np.asarray(model.position + distance[:, None] * directions, dtype=np.float64)


def _nearest_foot(
    position: FloatArray, directions: FloatArray, sure: NDArray[np.bool_], names: Sequence[str], floor: float
) -> FloatArray | None:
    """Return where the ray through the lowest keypoint of a foot meets the floor, (3,) m: the other may be
    lifted, and then seems farther away."""
    places = []
    for row, name in enumerate(names):
        height = FEET.get(name.partition("_")[2])
        if height is None or not sure[row] or directions[row, 2] >= 0.0:
            continue
        distance = (floor + height - position[2]) / directions[row, 2]
        if distance > 0.0:
            places.append(position + distance * directions[row])
    return min(places, key=lambda place: float(np.linalg.norm(place - position)), default=None)


def lengths_shown(lengths: FloatArray, standard: FloatArray) -> FloatArray:
    """Return (n_parts,) m of a person whose parts look as long as ``lengths``: the standard ones times a
    ratio."""
    ratios = lengths / standard
    known = ratios[np.isfinite(ratios)]
    return standard * (float(np.percentile(known, _SHOWN)) if known.size else 1.0)
