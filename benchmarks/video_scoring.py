"""How far keypoints over time are from a reference's, and how steady they are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from devices.marker_files import read_markers
from gateway.frames import FloatArray
from gateway.reconstruction.optical.tracking import rigid

LIMBS = {
    f"{side}_{ours}": f"{side[0].upper()}{theirs}"
    for side in ("left", "right")
    for ours, theirs in (
        ("shoulder", "Shoulder"), ("elbow", "Elbow"), ("wrist", "Wrist"), ("hip", "Hip"), ("knee", "Knee"),
        ("ankle", "Ankle"),
    )
}  # fmt: skip
"""The 12 limb joints: keypoint to the reference's label."""
_BONES = (("shoulder", "elbow"), ("elbow", "wrist"), ("hip", "knee"), ("knee", "ankle"))


@dataclass(frozen=True)
class Agreement:
    """Distances from the reference, mm."""

    mean: float
    median: float
    p95: float
    aligned_trial: float
    """Mean after one rigid motion for the whole trial."""
    aligned_frames: float
    """Mean after one rigid motion a frame."""


def reference_limbs(path: Path, n_pictures: int) -> FloatArray:
    """(n_pictures, 12, 3) m, Z up, of a TRC file with Y up: by the times in the file, 0 the first picture.

    NaN for a picture of which the file does not tell: the example's first line is dated 1/60 s, and belongs
    to the second picture.
    """
    trial = read_markers(path)
    first = round(first_time_s(path) * trial.rate_hz)
    limbs = np.full((n_pictures, len(LIMBS), 3), np.nan)
    rows = trial.columns(tuple(LIMBS.values()))[:, :, [2, 0, 1]][: n_pictures - first]
    limbs[first : first + len(rows)] = rows
    return limbs


def first_time_s(path: Path) -> float:
    """Of the first line of a TRC file."""
    return float(path.read_text(encoding="utf-8").splitlines()[5].split("\t")[1])


def agreement(limbs: FloatArray, reference: FloatArray) -> Agreement:
    """Of limbs (F, 12, 3) m with the reference; frames that are not there (NaN) do not count."""
    apart = 1e3 * np.linalg.norm(limbs - reference, axis=2)
    both = np.isfinite(limbs + reference).all(axis=(1, 2))
    frames = [1e3 * _aligned(a, b) for a, b in zip(limbs[both], reference[both], strict=True)]
    trial = 1e3 * _aligned(limbs.reshape(-1, 3), reference.reshape(-1, 3))
    return Agreement(
        float(np.nanmean(apart)), float(np.nanmedian(apart)), float(np.nanpercentile(apart, 95)),
        float(np.nanmean(trial)), float(np.mean(frames)),
    )  # fmt: skip


def by_joint(limbs: FloatArray, reference: FloatArray) -> list[list[str]]:
    """Of every limb joint: mean distance, how much of it all frames have in common, and how much varies."""
    rows = []
    for name, off in zip(LIMBS, np.moveaxis(1e3 * (limbs - reference), 1, 0), strict=True):
        mean = float(np.nanmean(np.linalg.norm(off, axis=1)))
        constant = np.nanmean(off, axis=0)
        varying = float(np.sqrt(np.nanmean(np.sum((off - constant) ** 2, axis=1))))
        rows.append(
            [name.replace("_", " "), *(f"{v:.0f}" for v in (mean, np.linalg.norm(constant), varying))]
        )
    return rows


def jitter_mm(limbs: FloatArray) -> float:
    """Mean length of the second difference over time."""
    return float(1e3 * np.nanmean(np.linalg.norm(np.diff(limbs, 2, axis=0), axis=2)))


def length_spread_mm(limbs: FloatArray) -> float:
    """Largest standard deviation of a bone's length over time."""
    names = list(LIMBS)
    spreads = []
    for side in ("left", "right"):
        for a, b in _BONES:
            ends = limbs[:, names.index(f"{side}_{a}")] - limbs[:, names.index(f"{side}_{b}")]
            spreads.append(1e3 * float(np.nanstd(np.linalg.norm(ends, axis=1))))
    return max(spreads)


def limbs_of(keypoints: FloatArray, names: Sequence[str]) -> FloatArray:
    """(F, 12, 3) of keypoints (F, n_keypoints, 3)."""
    return keypoints[:, [list(names).index(name) for name in LIMBS]]


def _aligned(points: FloatArray, reference: FloatArray) -> FloatArray:
    """Distances (n,) after the rigid motion that fits best."""
    turn, shift = rigid(points, reference)
    return np.asarray(np.linalg.norm(points @ turn.T + shift - reference, axis=1), dtype=np.float64)
