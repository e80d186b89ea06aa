"""BlazePose's detector: the people in a whole picture, each with hips, shoulders and size.

Bazarevsky et al. 2020; a single-shot detector over fixed anchors, weights of MediaPipe.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from devices.cameras.opencv import cv2
from gateway.frames import FloatArray
from gateway.reconstruction.video.networks.cropping import cropped
from gateway.reconstruction.video.networks.network import Picture
from gateway.reconstruction.video.networks.tensors import FloatTensor, LiteModel
from gateway.reconstruction.video.networks.weights import DETECTOR
from gateway.reconstruction.video.region import ROOM, PersonRegion, upright_region

_STRIDES = ((8, 2), (16, 2), (32, 6))
"""Pixels between anchors, and how many stand at each place."""
MOST_PEOPLE = 4
"""Of one picture that are considered, the likeliest ones."""
_LEAST_SCORE = 0.5
_STROKE = 0.45
"""Breadth of a person over the radius."""
_SAME_PERSON = 0.3
"""Share of two boxes' union that they have in common, from which they show one person."""


@dataclass(frozen=True, slots=True)
class Person:
    """One person in a picture, pixels."""

    score: float
    hips: FloatArray  # (2,) their middle
    shoulders: FloatArray  # (2,) their middle
    radius: float
    """Of the circle about the hips that holds the person."""

    @property
    def region(self) -> PersonRegion:
        """For the landmark network."""
        return upright_region(self.hips, self.shoulders, self.radius)


class PersonDetector:
    """Raises ``GatewayError`` when its weights are missing."""

    def __init__(self, threads: int = 1) -> None:
        self._model = LiteModel(DETECTOR.verified_path(), threads)

    def people(self, picture: Picture, window: PersonRegion | None = None) -> list[Person]:
        """Return the people of a picture, or of one part of it, the likeliest first.

        Whoever stands on the head is found in a window that is turned as well.
        """
        size = self._model.size
        window = whole_picture(picture) if window is None else window
        map_to_crop = window.affine(size)
        crop = cropped(picture, map_to_crop, size)[:, :, ::-1].astype(np.float32) / np.float32(127.5) - 1
        boxes, scores = self._model.run(crop, "Identity", "Identity_1")
        found = _decoded(boxes[0], scores[0, :, 0], size)
        linear, shift = map_to_crop[:, :2], map_to_crop[:, 2]
        people = []
        for score, points in found:
            hips, edge, shoulders = np.linalg.solve(linear, (points - 0.5 - shift).T).T
            people.append(Person(score, hips, shoulders, float(np.linalg.norm(edge - hips))))
        return people

    def newcomers(self, picture: Picture, known: Sequence[PersonRegion], look: int) -> list[Person]:
        """Return people beside the ``known`` ones, who are painted over, the likeliest first.

        look: counts the looks; every other is at the whole of the picture, those between at one part of it
        after the other, for whoever is small.
        """
        painted = picture.copy()
        for region in known:
            _paint_over(painted, region)
        part, is_part = divmod(look, 2)
        if not is_part:
            return self.people(painted)
        parts = _parts(picture)
        return self.people(painted, parts[part % len(parts)])

    def everybody(self, picture: Picture, most: int) -> list[Person]:
        """Return as ``people`` does, and those beside somebody who fills the picture: looked for in parts of
        it, too, once those found are painted over."""
        people = self.people(picture)[:most]
        painted = picture.copy()
        for person in people:
            _paint_over(painted, person.region)
        for _ in range(most - len(people)):
            found = [each for part in _parts(painted) for each in self.people(painted, part)]
            new = [each for each in found if not any(_is_same(each, other) for other in people)]
            if not new:
                break
            people.append(max(new, key=lambda each: each.score))
            _paint_over(painted, people[-1].region)
        return people


def _parts(picture: Picture) -> list[PersonRegion]:
    """Return squares as wide as the shorter side, overlapping by a half, over the whole of a picture."""
    height, width = picture.shape[:2]
    side = min(height, width)
    return [
        PersonRegion(np.array([x, y], dtype=np.float64), float(side), 0.0)
        for y in np.arange(side / 2, height - side / 2 + 1, side / 2)
        for x in np.arange(0, width + 1, side / 2)
    ]


def _paint_over(picture: Picture, region: PersonRegion) -> None:
    """Draw a grey stroke from head to foot of a person: neighbours stay in sight."""
    radius = region.size / (2.0 * ROOM)
    reach = radius * np.array([np.sin(region.roll), -np.cos(region.roll)])
    ends = [tuple(round(float(value)) for value in region.centre + way * reach) for way in (1.0, -1.0)]
    cv2.line(picture, ends[0], ends[1], (128, 128, 128), round(_STROKE * radius))


def _is_same(person: Person, other: Person) -> bool:
    apart = float(np.linalg.norm(person.hips - other.hips))
    return apart < 0.5 * min(person.radius, other.radius)


def whole_picture(picture: Picture) -> PersonRegion:
    """Return a region that holds all of a picture."""
    height, width = picture.shape[:2]
    return PersonRegion(0.5 * np.array([width - 1.0, height - 1.0]), float(max(width, height)), 0.0)


@cache
def _anchors(size: int) -> FloatArray:
    """Return (n, 2) middles, 0 to 1 of the picture, in the order of the network's rows."""
    anchors = []
    for stride, at_each in _STRIDES:
        n = size // stride
        middles = (np.arange(n) + 0.5) / n
        x, y = np.meshgrid(middles, middles)
        anchors.append(np.repeat(np.stack([x.ravel(), y.ravel()], axis=1), at_each, axis=0))
    return np.concatenate(anchors)


def _decoded(boxes: FloatTensor, scores: FloatTensor, size: int) -> list[tuple[float, FloatArray]]:
    """Return of each person the score, and hips, circle's edge and shoulders, (3, 2) crop pixels from the
    edge."""
    likely = 1.0 / (1.0 + np.exp(-np.clip(scores.astype(np.float64), -60, 60)))
    rows = np.flatnonzero(likely >= _LEAST_SCORE)
    rows = rows[np.argsort(-likely[rows], kind="stable")]
    anchors = size * _anchors(size)[rows]
    values = boxes[rows].astype(np.float64)
    middles, sizes = values[:, :2] + anchors, values[:, 2:4]
    points = values[:, 4:12].reshape(-1, 4, 2) + anchors[:, None]
    found: list[tuple[float, FloatArray]] = []
    left = list(range(len(rows)))
    while left:
        same = [i for i in left if _overlap(middles[left[0]], sizes[left[0]], middles[i], sizes[i])]
        weights = likely[rows[same]]
        mean = np.average(points[same], axis=0, weights=weights)
        found.append((float(likely[rows[left[0]]]), mean[[0, 1, 2]]))
        left = [i for i in left if i not in same]
    return found


def _overlap(middle: FloatArray, size: FloatArray, other: FloatArray, other_size: FloatArray) -> bool:
    """Return whether two boxes show one person: intersection over union."""
    low = np.maximum(middle - size / 2, other - other_size / 2)
    high = np.minimum(middle + size / 2, other + other_size / 2)
    common = float(np.prod(np.clip(high - low, 0.0, None)))
    union = float(np.prod(size) + np.prod(other_size)) - common
    return common >= _SAME_PERSON * max(union, 1e-9)
