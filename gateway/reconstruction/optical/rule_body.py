"""A first body from rules alone: bones as long as joint centres lie apart on average, markers where they are.

The result of steps 2 to 5 of CN1766831A, with whatever joint-centre rules the marker set names.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gateway.body.skeleton import BodyMarkers, Skeleton
from gateway.errors import GatewayError
from gateway.frames import FloatArray, IntArray
from gateway.geometry import quaternion
from gateway.reconstruction.optical.landmarks import SegmentPlaces
from gateway.reconstruction.optical.marker_set import MARKER_RADIUS, MarkerSet, names_in

FIRST_SIGMA = 0.005
"""How far a marker strays from its place until the fit knows better, m."""


@dataclass(frozen=True)
class SightedTrial:
    """The markers of one trial in the world, and where rules find the segments."""

    name: str
    markers: FloatArray  # (F, M, 3) m, in the order of the marker set
    places: SegmentPlaces

    def only(self, frames: IntArray) -> SightedTrial:
        """Return some of its frames."""
        return SightedTrial(self.name, self.markers[frames], self.places.only(frames))


def from_rules(
    marker_set: MarkerSet, sightings: Sequence[SightedTrial], vertical: str
) -> tuple[Skeleton, BodyMarkers]:
    """Return the body with the mean over all frames of every length and every marker's place.

    Raises ``GatewayError`` naming the segments that have axes in no frame, and the markers those need.
    """
    origins = np.concatenate([sighting.places.origins for sighting in sightings])
    axes = np.concatenate([sighting.places.axes for sighting in sightings])
    tips = np.concatenate([sighting.places.tips for sighting in sightings])
    seen = np.concatenate([sighting.markers for sighting in sightings])
    _refuse_unseen(marker_set, axes)
    body = marker_set.body
    scale = _scale(body, origins)
    offsets, new_tips = body.offsets * scale, body.tips * scale
    for s, parent in enumerate(body.parents.tolist()):
        if parent >= 0:
            offsets[s] = _mean_within(axes[:, parent], origins[:, s] - origins[:, parent], offsets[s])
        new_tips[s] = _mean_within(axes[:, s], tips[:, s] - origins[:, s], new_tips[s])
    labels = marker_set.labels
    segments = np.array([body.index(marker_set.carriers[label]) for label in labels], dtype=np.int64)
    places = np.stack(
        [
            _mean_within(axes[:, s], seen[:, m] - origins[:, s], np.full(3, np.nan))
            for m, s in enumerate(segments.tolist())
        ]
    )
    kept: NDArray[np.bool_] = np.asarray(np.isfinite(places).all(axis=1))
    markers = BodyMarkers(
        tuple(label for label, keep in zip(labels, kept.tolist(), strict=True) if keep),
        segments[kept],
        places[kept],
        np.full(int(kept.sum()), FIRST_SIGMA),
        vertical,
    )
    return resized(marker_set, offsets, new_tips), markers


def resized(marker_set: MarkerSet, offsets: FloatArray, tips: FloatArray) -> Skeleton:
    """Return the marker set's body with other lengths; a segment that ends in the next joint ends there
    exactly."""
    body, entries = marker_set.body, marker_set.file.segments
    names = body.segment_names
    tips = tips.copy()
    for s, parent in enumerate(body.parents.tolist()):
        if parent >= 0 and entries[names[parent]].tip == entries[names[s]].origin:
            tips[parent] = offsets[s]
    ratio = np.linalg.norm(tips, axis=1) / np.linalg.norm(body.tips, axis=1)
    contacts = tuple((s, point * ratio[s]) for s, point in body.contacts)
    return replace(body, offsets=offsets, tips=tips, contacts=contacts, stature_m=None)


def neutral_axes(body: Skeleton, axes: FloatArray, standing: FloatArray) -> FloatArray:
    """Return axes (F, S, 3, 3) turned, each segment by a constant, so that ``standing`` is the neutral
    posture.

    standing: (S, 3, 3) mean axes while the person stood neutral. All segments then have the axes of an
    upright root that faces where the root faced.
    """
    root = int(np.flatnonzero(body.parents < 0)[0])
    corrections = np.einsum("sji,jk->sik", standing, upright_axes(body, standing[root]))
    turned: FloatArray = axes @ corrections
    return turned


def upright_axes(body: Skeleton, root: FloatArray) -> FloatArray:
    """Return (3, 3) of every segment in the neutral posture, facing where a root with axes (3, 3) faces."""
    forward = root[:, 0]
    heading = np.arctan2(forward[1], forward[0])
    turn = np.array([np.cos(0.5 * heading), 0.0, 0.0, np.sin(0.5 * heading)])
    return quaternion.to_matrix(quaternion.multiply(turn, body.neutral))


def facing_axes(body: Skeleton, p_w: FloatArray, otherwise: FloatArray) -> FloatArray:
    """Return (3, 3) of an upright body that faces across the line from its left joints to its right ones.

    p_w: (S, 3) m of standing. Joints come from motion and are surer than single markers. otherwise: (3, 3)
    axes of the root, for a body without left and right.
    """
    names = body.segment_names
    pairs = [
        (names.index(name), names.index("right_" + name.removeprefix("left_")))
        for name in names
        if name.startswith("left_") and "right_" + name.removeprefix("left_") in names
    ]
    if not pairs:
        return upright_axes(body, otherwise)
    right = sum(p_w[r] - p_w[s] for s, r in pairs)
    forward = np.cross(np.array([0.0, 0.0, 1.0]), right)
    return upright_axes(body, np.stack([forward, forward, forward], axis=1))


def straightened(body: Skeleton, offsets: FloatArray) -> FloatArray:
    """Return offsets (S, 3) as long as they are, in the directions that the body file has them: of a person
    whose axes were set in the neutral posture, where a hinge hides its place along its own axis."""
    length = np.linalg.norm(offsets, axis=1, keepdims=True)
    own = np.linalg.norm(body.offsets, axis=1, keepdims=True)
    straight: FloatArray = np.where(own > 0, body.offsets * length / np.where(own > 0, own, 1.0), offsets)
    return straight


def mean_rotation(rotations: FloatArray) -> FloatArray:
    """Return the rotation nearest the mean of (F, 3, 3), NaN left out: (3, 3), by singular values (Markley
    2007)."""
    u, _, vt = np.linalg.svd(np.nanmean(rotations, axis=0))
    nearest: FloatArray = u @ np.diag([1.0, 1.0, float(np.linalg.det(u @ vt))]) @ vt
    return nearest


def _mean_within(axes: FloatArray, vectors: FloatArray, otherwise: FloatArray) -> FloatArray:
    """Return (3,) mean of vectors (F, 3) as seen in axes (F, 3, 3); ``otherwise`` where no frame knows it."""
    local = np.einsum("fij,fi->fj", axes, vectors)
    known = np.isfinite(local).all(axis=1)
    mean: FloatArray = local[known].mean(axis=0) if known.any() else otherwise
    return mean


def _scale(body: Skeleton, origins: FloatArray) -> float:
    """Return how much larger than the body file the person is, by the bones that can be compared."""
    pairs = [(s, p) for s, p in enumerate(body.parents.tolist()) if p >= 0]
    found = np.array([np.linalg.norm(origins[:, s] - origins[:, p], axis=1) for s, p in pairs])
    known = np.isfinite(found)
    if not known.any():
        return 1.0
    own = np.linalg.norm(body.offsets[[s for s, _ in pairs]], axis=1)
    means = np.array([row[ok].mean() if ok.any() else np.nan for row, ok in zip(found, known, strict=True)])
    return float(np.nansum(means) / own[np.isfinite(means)].sum())


def unseen(marker_set: MarkerSet, axes: Sequence[FloatArray]) -> dict[str, list[str]]:
    """Return the segments of which no frame of any trial tells how they lie, with the markers that lack.

    axes: (F, S, 3, 3) of each trial, as rules find them.
    """
    entries = marker_set.file.segments
    never = [
        name
        for s, name in enumerate(marker_set.body.segment_names)
        if entries[name].axes is not None
        and not any(np.isfinite(each[:, s]).all(axis=(1, 2)).any() for each in axes)
    ]
    return {
        name: [m for m in _markers_under(marker_set, _needed(marker_set, name)) if m not in marker_set.labels]
        for name in never
    }


def _needed(marker_set: MarkerSet, name: str) -> list[str]:
    """Return the points that a segment's axes are laid by."""
    rule = marker_set.file.segments[name].axes
    assert rule is not None  # whose axes are never seen has a rule for them
    return [*dict.fromkeys([*rule.primary[1:], *rule.secondary[1:]])]


def _refuse_unseen(marker_set: MarkerSet, axes: FloatArray) -> None:
    never = unseen(marker_set, [axes])
    if never:
        name, absent = next(iter(never.items()))
        needed = _needed(marker_set, name)
        raise GatewayError(
            f"marker set '{marker_set.file.name}': no frame tells how {', '.join(never)} lie: {name} needs "
            f"{', '.join(needed)} and what these rest on (see {marker_set.path.name})"
            + (f", and the trials lack {', '.join(absent)}" if absent else "")
            + ": take another trial, or another marker set"
        )


def _markers_under(marker_set: MarkerSet, names: Iterable[str]) -> list[str]:
    """Return the markers that points rest on, worn or not."""
    points, found, open_names = marker_set.file.points, dict.fromkeys(names), list(names)
    for name in open_names:
        for rule in marker_set.rules(name) if name in points else []:
            below = [each for each in names_in(getattr(rule, rule.kind)) if each not in found]
            found |= dict.fromkeys(below)
            open_names += below
    lengths = {"left", "right", MARKER_RADIUS, *marker_set.file.measurements, *marker_set.file.angles}
    return [name for name in found if name not in {*points, *lengths, *marker_set.body.segment_names}]
