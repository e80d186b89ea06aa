"""Whether cameras agree: rays through one keypoint in two pictures of one instant should meet.

They do not when the calibration belongs to other cameras, or when one camera is ahead of the others: then
they meet better at other instants.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from devices.cameras.heat_map_messages import HeatMapReceiver, retimed
from gateway.body.camera import Camera
from gateway.cameras.synchronisation import signed_distances, synchronisation_of
from gateway.errors import GatewayError
from gateway.frames import FloatArray
from gateway.reconstruction.video.initial import rays_through
from gateway.reconstruction.video.projection import camera_model
from gateway.sources.heat_maps import heat_maps_of

FAR_APART = 0.08
"""Median distance of two rays to one keypoint from which a calibration counts as wrong, m; a right one has
10 to 30 mm with the noise of the network."""
_SUSPECT, _TIMES_OTHERS = 0.03, 3.0
"""m, and times the other cameras' distance: from both on a camera is to be told of."""
_MOST_INSTANTS = 300
_FEWEST = 20
"""Pairs of rays."""


@dataclass(frozen=True)
class Consistency:
    """How well the cameras agree."""

    names: tuple[str, ...]
    """Of the cameras."""
    apart: dict[str, float]
    """By camera, m: median distance of its rays to those of the others."""
    offsets: dict[str, int]
    """By camera: pictures by which it is behind most of the others; only those that are not 0."""
    unrest: float
    """By which rays pass each other now on this side, now on that, m: mean of all pairs of cameras."""
    unrest_shifted: float
    """The same with the offsets taken out."""

    @property
    def skipped(self) -> list[int]:
        """By camera, the pictures at its start without which all are in step."""
        earliest = min(0, *self.offsets.values()) if self.offsets else 0
        return [self.offsets.get(name, 0) - earliest for name in self.names]

    def refuse_wrong(self, calibration: Path) -> None:
        """Raise ``GatewayError`` for cameras that are not synchronised, or not those of the calibration."""
        if self.offsets:
            name = max(self.offsets, key=lambda each: abs(self.offsets[each]))
            rest = "".join(
                f", '{each}' {_offset(n)} them" for each, n in self.offsets.items() if each != name
            )
            cure = " ".join(
                f"--offset {each}={late}" for each, late in zip(self.names, self.skipped, strict=True) if late
            )
            others = "the others" if len(self.names) > 2 else "the other"
            raise GatewayError(
                f"the cameras are not synchronised: camera '{name}' is {_offset(self.offsets[name])} {others}"
                f"{rest} (rays through one keypoint swing by {1e3 * self.unrest:.0f} mm, so shifted by "
                f"{1e3 * self.unrest_shifted:.0f} mm): {cure}, or --synchronise"
            )
        if self.apart and min(self.apart.values()) > FAR_APART:
            name, far = max(self.apart.items(), key=lambda item: item[1])
            raise GatewayError(
                f"{calibration} does not fit these pictures: rays through the same keypoint pass each other "
                f"at {1e3 * min(self.apart.values()):.0f} to {1e3 * far:.0f} mm (camera '{name}'): is it of "
                "these cameras, in this order, for pictures of this size?"
            )
        wrong = [name for name, far in self.apart.items() if far > FAR_APART and len(self.apart) > 2]
        if wrong:
            raise GatewayError(
                f"{calibration}: camera '{wrong[0]}' does not fit the others (its rays pass theirs at "
                f"{1e3 * self.apart[wrong[0]]:.0f} mm): was it moved, or is the file another camera's?"
            )

    def doubts(self) -> list[str]:
        """Return what may be wrong with cameras that are not refused, a sentence each."""
        found = []
        unused = [name for name in self.names if name not in self.apart]
        if self.apart and unused:
            found.append(
                f"{', '.join(unused)}: the person is hardly seen where the other cameras have them; if they "
                "are in these pictures, the calibration is of other cameras or for another picture size"
            )
        for name, far in self.apart.items():
            others = [each for other, each in self.apart.items() if other != name]
            if len(others) > 1 and far > max(_SUSPECT, _TIMES_OTHERS * float(np.median(others))):
                found.append(
                    f"the rays of {name} pass the others' at {1e3 * far:.0f} mm, theirs each other at "
                    f"{1e3 * float(np.median(others)):.0f}: is it of another rate, out of step (--offset), "
                    "or was it moved?"
                )
        return found


def in_step(messages: Sequence[Sequence[bytes]], skipped: Sequence[int]) -> list[list[bytes]]:
    """Return the instants that all cameras have once pictures are left out at their starts, numbered anew.

    messages: of every instant, one a camera; skipped: pictures, by camera.
    """
    times_ns = [HeatMapReceiver().receive(instant[0])[0].time_ns for instant in messages]
    n = len(messages) - max(skipped)
    return [
        [retimed(messages[t + late][c], t, times_ns[t]) for c, late in enumerate(skipped)] for t in range(n)
    ]


def views(messages: Sequence[Sequence[bytes]]) -> int:
    """Return in how many pictures of all cameras somebody is seen."""
    receiver = HeatMapReceiver()
    return sum(
        each.likelihood is not None
        for instant in messages
        for message in instant
        for each in receiver.receive(message)
    )


def _offset(offset: int) -> str:
    n = abs(offset)
    return f"{n} picture{'s' if n > 1 else ''} {'behind' if offset > 0 else 'ahead of'}"


def consistency_of(cameras: Sequence[Camera], messages: Sequence[Sequence[bytes]]) -> Consistency:
    """Find how well cameras agree, from the heat maps of a capture, a message a camera and instant."""
    directions, likely = _rays(cameras, messages[:_MOST_INSTANTS])
    positions = np.stack([camera.position for camera in cameras])
    found = synchronisation_of(positions, directions, likely)
    names = tuple(camera.name for camera in cameras)
    apart = _apart(positions, directions, likely, [0] * len(names))
    shifted = _apart(positions, directions, likely, found.offsets)
    is_calibrated = min(shifted.values(), default=0.0) <= FAR_APART  # else no offset is to be believed
    return Consistency(
        names,
        {names[c]: far for c, far in apart.items()},
        _of_most(names, found.offsets) if is_calibrated else {},
        found.before,
        found.after,
    )


def _of_most(names: Sequence[str], offsets: Sequence[int]) -> dict[str, int]:
    """Return offsets that are not 0 when those of most cameras (of as many: the first ones) are."""
    usual = max(offsets, key=offsets.count)
    return {name: offset - usual for name, offset in zip(names, offsets, strict=True) if offset != usual}


def _rays(cameras: Sequence[Camera], messages: Sequence[Sequence[bytes]]) -> tuple[FloatArray, FloatArray]:
    """Return directions (F, C, K, 3), NaN where nobody is seen, and likelihoods (F, C, K)."""
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


def _apart(
    positions: FloatArray, directions: FloatArray, likely: FloatArray, offsets: Sequence[int]
) -> dict[int, float]:
    """Return by camera, m, the lower median of its median distances to the others, so that one wrong camera
    does not spoil the rest. offsets: pictures by which each is behind; a camera that sees nobody is left out.
    """
    n = len(directions) - max(offsets) + min(offsets)
    starts = [offset - min(offsets) for offset in offsets]
    found: dict[int, list[float]] = {}
    for a, b in itertools.combinations(range(len(positions)), 2):
        first, second = slice(starts[a], starts[a] + n), slice(starts[b], starts[b] + n)
        apart = signed_distances(
            positions[b] - positions[a], directions[first, a], directions[second, b],
            np.minimum(likely[first, a], likely[second, b]),
        )  # fmt: skip
        known = np.abs(apart[np.isfinite(apart)])
        if len(known) >= _FEWEST:
            for camera in (a, b):
                found.setdefault(camera, []).append(float(np.median(known)))
    return {camera: sorted(values)[(len(values) - 1) // 2] for camera, values in sorted(found.items())}
