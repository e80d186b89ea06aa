"""Whether cameras agree: rays through one keypoint in two pictures of one instant should meet.

They do not when the calibration belongs to other cameras, or when one camera is ahead of the others: then
they meet better at other instants.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from devices.cameras.heat_map_messages import HeatMapReceiver
from gateway.body.camera import Camera
from gateway.errors import GatewayError
from gateway.frames import FloatArray
from gateway.heat_map_frames import heat_maps_of
from gateway.reconstruction.video.initial import rays_through
from gateway.reconstruction.video.projection import camera_model

LONGEST_OFFSET = 15
"""Pictures by which a camera may be off for it to be found."""
FAR_APART = 0.08
"""Median distance of two rays to one keypoint from which a calibration counts as wrong, m; a right one has
10 to 30 mm with the noise of the network."""
_LEAST_LIKELIHOOD = 0.5
_LEAST_GAIN, _LEAST_RATIO = 0.006, 0.7
"""By which an offset must bring rays nearer, m and as a share, to count: who stands still shows none."""
_MOST_INSTANTS = 300
_PARALLEL = 0.1
"""Sine of the angle between two rays under which they say little."""
_FEWEST = 20
"""Pairs of rays."""


@dataclass(frozen=True)
class Consistency:
    """How well the cameras agree."""

    apart: dict[str, float]
    """By camera, m: median distance of its rays to those of the others."""
    offsets: dict[str, int]
    """By camera: pictures by which it is behind the first one; only those that are not 0."""
    apart_shifted: dict[str, float]
    """As ``apart``, with the offsets taken out."""

    def refuse_wrong(self, calibration: Path) -> None:
        """Raises ``GatewayError`` for cameras that are not synchronised, or not those of the calibration."""
        if self.offsets:
            name = max(self.offsets, key=lambda each: abs(self.offsets[each]))
            told = ", ".join(f"{each} by {n:+d}" for each, n in self.offsets.items())
            earliest = min(0, *self.offsets.values())
            cure = " ".join(
                f"--offset {each}={self.offsets.get(each, 0) - earliest}"
                for each in self.apart
                if self.offsets.get(each, 0) != earliest
            )
            raise GatewayError(
                f"the cameras are not synchronised: behind the first are {told} pictures (rays of {name} "
                f"pass the others' at {1e3 * self.apart[name]:.0f} mm, shifted at "
                f"{1e3 * self.apart_shifted[name]:.0f} mm): {cure}"
            )
        if self.apart and min(self.apart.values()) > FAR_APART:
            name, far = max(self.apart.items(), key=lambda item: item[1])
            raise GatewayError(
                f"{calibration} does not fit these pictures: rays through the same keypoint pass each other "
                f"at {1e3 * min(self.apart.values()):.0f} to {1e3 * far:.0f} mm (camera '{name}'): is it of "
                "these cameras, in this order?"
            )
        wrong = [name for name, far in self.apart.items() if far > FAR_APART and len(self.apart) > 2]
        if wrong:
            raise GatewayError(
                f"{calibration}: camera '{wrong[0]}' does not fit the others (its rays pass theirs at "
                f"{1e3 * self.apart[wrong[0]]:.0f} mm): was it moved, or is the file another camera's?"
            )


def consistency_of(cameras: Sequence[Camera], messages: Sequence[Sequence[bytes]]) -> Consistency:
    """From the heat maps of a capture, a message a camera and instant."""
    directions, likely = _rays(cameras, messages[:_MOST_INSTANTS])
    positions = np.stack([camera.position for camera in cameras])
    pairs = {
        (a, b): _apart_by_offset(
            positions[b] - positions[a], directions[:, a], directions[:, b], likely[:, [a, b]]
        )
        for a, b in itertools.combinations(range(len(cameras)), 2)
    }
    offsets = _best_offsets(pairs, len(cameras))
    names = [camera.name for camera in cameras]
    return Consistency(
        _by_camera(pairs, names, [0] * len(names)),
        {name: offset for name, offset in zip(names, offsets, strict=True) if offset},
        _by_camera(pairs, names, offsets),
    )


def _rays(cameras: Sequence[Camera], messages: Sequence[Sequence[bytes]]) -> tuple[FloatArray, FloatArray]:
    """Directions (F, C, K, 3), NaN where nobody is seen, and likelihoods (F, C, K)."""
    models = [camera_model(camera) for camera in cameras]
    found: list[list[tuple[FloatArray, FloatArray] | None]] = []
    n_keypoints = 0
    for instant in messages:
        maps = [heat_maps_of(HeatMapReceiver().receive(message)[0]) for message in instant]
        found.append(
            [
                None if each is None else rays_through(model, each)
                for model, each in zip(models, maps, strict=True)
            ]
        )
        n_keypoints = max([n_keypoints, *(len(each.likelihood) for each in maps if each is not None)])
    directions = np.full((len(messages), len(cameras), n_keypoints, 3), np.nan)
    likely = np.zeros(directions.shape[:3])
    for t, rays in enumerate(found):
        for c, each in enumerate(rays):
            if each is not None:
                directions[t, c], likely[t, c] = each
    return directions, likely


def _apart_by_offset(
    between: FloatArray, first: FloatArray, second: FloatArray, likely: FloatArray
) -> FloatArray:
    """(2 n + 1,) median distance of the rays of two cameras, m, the second's taken -n to n pictures later.

    between: (3,) from the first camera to the second. NaN where too few keypoints are seen by both.
    """
    curve = np.full(2 * LONGEST_OFFSET + 1, np.nan)
    n = len(first)
    for index, offset in enumerate(range(-LONGEST_OFFSET, LONGEST_OFFSET + 1)):
        early = slice(max(0, -offset), n - max(0, offset))
        late = slice(max(0, offset), n - max(0, -offset))
        common = np.cross(first[early], second[late])
        sine = np.linalg.norm(common, axis=-1)
        sure = np.minimum(likely[early, 0], likely[late, 1]) > _LEAST_LIKELIHOOD
        chosen = sure & (sine > _PARALLEL)
        if chosen.sum() >= _FEWEST:
            curve[index] = np.median(np.abs(common[chosen] @ between) / sine[chosen])
    return curve


def _best_offsets(pairs: Mapping[tuple[int, int], FloatArray], n: int) -> list[int]:
    """Pictures by which each camera is behind the first; all 0 unless others are clearly better."""
    starts = [[0] * n]
    for reference in range(n):
        offsets = [_best_of_pair(pairs, reference, c) for c in range(n)]
        starts.append([offset - offsets[0] for offset in offsets])
    best = min((_descended(pairs, start) for start in starts), key=lambda found: _total(pairs, found))
    before, after = _total(pairs, [0] * n), _total(pairs, best)
    is_clear = before - after > _LEAST_GAIN and after < _LEAST_RATIO * before
    return best if is_clear else [0] * n


def _best_of_pair(pairs: Mapping[tuple[int, int], FloatArray], a: int, b: int) -> int:
    if a == b:
        return 0
    curve = pairs[min(a, b), max(a, b)]
    if np.isnan(curve).all():
        return 0
    offset = int(np.nanargmin(curve)) - LONGEST_OFFSET
    return offset if a < b else -offset


def _descended(pairs: Mapping[tuple[int, int], FloatArray], start: list[int]) -> list[int]:
    """One camera after the other is shifted to where all agree best."""
    offsets = list(start)
    for _ in range(3):
        for c in range(1, len(offsets)):
            tried = [[*offsets[:c], o, *offsets[c + 1 :]] for o in range(-LONGEST_OFFSET, LONGEST_OFFSET + 1)]
            offsets = min([offsets, *tried], key=lambda each: _total(pairs, each))
    return offsets


def _total(pairs: Mapping[tuple[int, int], FloatArray], offsets: Sequence[int]) -> float:
    """Mean distance over all pairs at these offsets, m; infinite where one is out of reach."""
    values = [_at(curve, offsets[b] - offsets[a]) for (a, b), curve in pairs.items()]
    known = [value for value in values if not np.isnan(value)]
    return float(np.mean(known)) if known else np.inf


def _at(curve: FloatArray, offset: int) -> float:
    return float(curve[offset + LONGEST_OFFSET]) if abs(offset) <= LONGEST_OFFSET else np.inf


def _by_camera(
    pairs: Mapping[tuple[int, int], FloatArray], names: Sequence[str], offsets: Sequence[int]
) -> dict[str, float]:
    """By camera the lower median of its distances to the others: one wrong camera does not spoil the rest."""
    apart = {}
    for c, name in enumerate(names):
        values = sorted(
            value
            for (a, b), curve in pairs.items()
            if c in {a, b} and not np.isnan(value := _at(curve, offsets[b] - offsets[a]))
        )
        if values:
            apart[name] = values[(len(values) - 1) // 2]
    return apart
