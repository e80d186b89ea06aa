"""Several people: told apart at the start, by which detections of all cameras are of one person.

Step 9 of JP2020-042476A. Rays of one person's keypoints pass each other closely; those of two people do not.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from gateway.frames import CameraHeatMaps, FloatArray
from gateway.reconstruction.video.initial import LEAST_LIKELIHOOD, rays_through
from gateway.reconstruction.video.projection import CameraModel

LARGEST_DISTANCE = 0.12
"""Median distance of two cameras' rays, over all keypoints, up to which both show one person, m."""
_FEWEST_KEYPOINTS = 6

Person = tuple[CameraHeatMaps | None, ...]
"""The maps of one person, for every camera."""


def people_apart(
    models: Sequence[CameraModel], detections: Sequence[Sequence[CameraHeatMaps]]
) -> list[Person]:
    """The people that at least two cameras see, those seen by most cameras and most closely agreed on first.

    detections: for every camera the maps of whoever was found in its picture, in any order.
    """
    seen = [(camera, maps) for camera, found in enumerate(detections) for maps in found]
    distance = _distances(models, seen)
    left = set(range(len(seen)))
    people = []
    while (group := _closest_group(distance, [camera for camera, _ in seen], left)) is not None:
        left -= set(group)
        person: list[CameraHeatMaps | None] = [None] * len(detections)
        for row in group:
            person[seen[row][0]] = seen[row][1]
        spread = float(np.mean([distance[a, b] for a, b in combinations(group, 2)]))
        people.append((-len(group), spread, tuple(person)))
    return [person for _, _, person in sorted(people, key=lambda each: each[:2])]


def _distances(models: Sequence[CameraModel], seen: Sequence[tuple[int, CameraHeatMaps]]) -> FloatArray:
    """(n, n) m: how far the rays of two detections pass each other; infinite within a camera."""
    rays = [rays_through(models[camera], maps) for camera, maps in seen]
    distance = np.full((len(seen), len(seen)), np.inf)
    for a, b in combinations(range(len(seen)), 2):
        if seen[a][0] != seen[b][0]:
            between = models[seen[b][0]].position - models[seen[a][0]].position
            distance[a, b] = distance[b, a] = _apart(between, rays[a], rays[b])
    return distance


def _apart(between: FloatArray, a: tuple[FloatArray, FloatArray], b: tuple[FloatArray, FloatArray]) -> float:
    """Median distance, m, of rays through the same keypoints from places ``between`` apart."""
    likely = (a[1] >= LEAST_LIKELIHOOD) & (b[1] >= LEAST_LIKELIHOOD)
    if likely.sum() < _FEWEST_KEYPOINTS:
        return np.inf
    across = np.cross(a[0][likely], b[0][likely])
    return float(np.median(np.abs(across @ between) / np.linalg.norm(across, axis=1)))


def _closest_group(distance: FloatArray, cameras: list[int], left: set[int]) -> list[int] | None:
    """The two detections nearest each other, with those of other cameras that are near to all of them."""
    pairs = [(distance[a, b], a, b) for a, b in combinations(sorted(left), 2)]
    nearest = min(pairs, default=(np.inf, 0, 0))
    if not nearest[0] < LARGEST_DISTANCE:
        return None
    group = [nearest[1], nearest[2]]
    while True:
        taken = {cameras[row] for row in group}
        others = [row for row in left if cameras[row] not in taken]
        fits = [(max(distance[row, member] for member in group), row) for row in others]
        best = min(fits, default=(np.inf, 0))
        if not best[0] < LARGEST_DISTANCE:
            return group
        group.append(best[1])
