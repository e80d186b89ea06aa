"""Keypoint sets as data: which keypoints a pose network finds, and where they sit on the body."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from gateway.body.body_file import load_body
from gateway.body.skeleton import BodyMarkers, Skeleton
from gateway.errors import SettingsError, nearest
from gateway.support.settings_files import Strict, find_file, load_settings

SIGMA = 0.025
"""How far a network's keypoint strays from its place on the body when a map is as high as it can be, m."""
Metres = Annotated[float, Field(gt=-1.0, lt=1.0, allow_inf_nan=False)]


class KeypointEntry(Strict):
    """One keypoint on the body."""

    segment: str = Field(description="segment that carries it")
    at: tuple[Metres, Metres, Metres] = Field(
        default=(0.0, 0.0, 0.0), description="from the segment's proximal joint, own axes, m"
    )
    shows: list[str] = Field(default=[], description="more segments whose orientation it tells")


class KeypointSetFile(Strict):
    """A file of ``config/keypoint_sets``."""

    name: str
    body: str = Field(description="the body that the places belong to")
    keypoints: dict[str, KeypointEntry] = Field(description="in the order of the network's maps")


@dataclass(frozen=True)
class KeypointSet:
    """The keypoints of a network on the standard skeleton."""

    name: str
    names: tuple[str, ...]
    skeleton: Skeleton
    """Of standard size."""
    markers: BodyMarkers
    """The keypoints as markers on it, in the order of the maps."""
    shows: NDArray[np.bool_]
    """(n_keypoints, n_segments) whose orientation a keypoint tells."""

    def index(self, keypoint: str) -> int:
        """Return the row of a keypoint by name. Raises ``ValueError`` for an unknown one."""
        return self.names.index(keypoint)


def load_keypoint_set(name: str) -> KeypointSet:
    """Return a keypoint set by name (``blazepose_33``, ``openpose_18``) or path. Raises ``SettingsError``."""
    path = find_file(name, "keypoint_sets")
    file = load_settings(path, KeypointSetFile)
    skeleton = load_body(file.body, path)
    known = skeleton.segment_names
    for keypoint, entry in file.keypoints.items():
        for segment in (entry.segment, *entry.shows):
            if segment not in known:
                raise SettingsError(
                    f"{path}: keypoints.{keypoint}: there is no segment '{segment}' in body "
                    f"'{skeleton.name}'" + nearest(segment, known)
                )
    entries = list(file.keypoints.values())
    segments = np.array([skeleton.index(entry.segment) for entry in entries], dtype=np.int64)
    positions = np.array([entry.at for entry in entries], dtype=np.float64)
    names = tuple(file.keypoints)
    markers = BodyMarkers(names, segments, positions, np.full(len(names), SIGMA), "z")
    return KeypointSet(file.name, names, skeleton, markers, _shown(skeleton, markers, entries))


def _shown(skeleton: Skeleton, markers: BodyMarkers, entries: list[KeypointEntry]) -> NDArray[np.bool_]:
    """Tell which segments keypoints show. A keypoint at a joint tells how the segment lies that ends there;
    one beside it its own segment."""
    shows = np.zeros((len(entries), skeleton.n_segments), dtype=bool)
    for n, (segment, place, entry) in enumerate(
        zip(markers.segments.tolist(), markers.positions, entries, strict=True)
    ):
        shows[n, segment if place.any() else skeleton.parents[segment]] = True
        for name in entry.shows:
            shows[n, skeleton.index(name)] = True
    return shows
