"""Masses, centres of mass and inertias of a person's segments.

From de Leva (1996, Adjustments to Zatsiorsky-Seluyanov's segment inertia parameters, J. Biomech. 29(9):
1223–1230, table 4), scaled to the lengths of the body.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from gateway.body.anthropometry import LENGTH_OF_STATURE, MASS_OF_BODY, SIDES
from gateway.body.skeleton import Skeleton
from gateway.errors import GatewayError
from gateway.frames import FloatArray


class Part(NamedTuple):
    """Where a part's mass lies, as fractions of its length."""

    centre: float
    """Of the way from the proximal (of the trunk: the upper) end."""
    sagittal: float
    """Radius of gyration about x."""
    transverse: float
    """About z."""
    longitudinal: float
    """About the long axis."""


PARTS: dict[str, tuple[Part, Part]] = {
    "head": (Part(1 - 0.5002, 0.303, 0.315, 0.261), Part(1 - 0.4841, 0.271, 0.295, 0.261)),
    "upper_arm": (Part(0.5772, 0.285, 0.269, 0.158), Part(0.5754, 0.278, 0.260, 0.148)),
    "forearm": (Part(0.4574, 0.276, 0.265, 0.121), Part(0.4559, 0.261, 0.257, 0.094)),
    "hand": (Part(0.3624, 0.288, 0.235, 0.184), Part(0.3427, 0.244, 0.208, 0.154)),
    "thigh": (Part(0.4095, 0.329, 0.329, 0.149), Part(0.3612, 0.369, 0.364, 0.162)),
    "shank": (Part(0.4395, 0.251, 0.246, 0.102), Part(0.4352, 0.267, 0.263, 0.092)),
    "foot": (Part(0.4415, 0.257, 0.245, 0.124), Part(0.4014, 0.299, 0.279, 0.139)),
    "palm": (Part(0.79, 0.628, 0.513, 0.401), Part(0.7474, 0.531, 0.454, 0.335)),
    "upper_trunk": (Part(0.2999, 0.716, 0.454, 0.659), Part(0.2077, 0.746, 0.502, 0.718)),
    "middle_trunk": (Part(0.4502, 0.482, 0.383, 0.468), Part(0.4512, 0.433, 0.354, 0.415)),
    "lower_trunk": (Part(0.6115, 0.615, 0.551, 0.587), Part(0.4920, 0.433, 0.402, 0.444)),
}
"""Men, women. Head from cervicale to vertex; hand to the fingertip, palm to the third knuckle; shank to the
ankle's centre; foot from heel to toe; trunk from suprasternale over xiphion and omphalion to the middle
of the hips."""
TRUNK_MASS = {
    "lower_trunk": (0.1117, 0.1247),
    "middle_trunk": (0.1633, 0.1465),
    "upper_trunk": (0.1596, 0.1545),
}
TRUNK_LENGTH = {
    "lower_trunk": (0.1457 / 1.741, 0.1815 / 1.735),
    "middle_trunk": (0.2155 / 1.741, 0.2053 / 1.735),
    "upper_trunk": (0.1707 / 1.741, 0.1425 / 1.735),
}
"""Of stature, from below."""

NO_MASS_KG = 1e-6
"""Of segments that the tables count to their neighbours: the solver needs more than zero."""
HEEL_BEHIND_ANKLE = 0.25
"""Of the foot's length."""
MEAN_STATURE_M = 1.738
"""Of the people measured, men and women."""
_PALM_OF_FOREARM = 0.5
"""A hand shorter than this is measured to the knuckle only."""
_COLUMN = ("l5", "l3", "t12", "thorax")


@dataclass(frozen=True)
class BodyInertia:
    """What each of S segments weighs and how that is spread, in segment axes."""

    mass: FloatArray  # (S,) kg
    centre: FloatArray  # (S, 3) m, from the proximal joint
    inertia: FloatArray  # (S, 3, 3) kg m², about the centre
    body_kg: float
    """Of the whole person."""

    @property
    def share(self) -> float:
        """Of the person's mass that the segments carry; less than 1 for part of a body."""
        return float(self.mass.sum() / self.body_kg)


def body_inertia(skeleton: Skeleton, body_kg: float, sex: str | None = None) -> BodyInertia:
    """Return a person's inertia. sex: ``male``, ``female``, or None for the mean of both tables.

    Raises ``GatewayError`` for a body with no segment that the tables know.
    """
    count = skeleton.n_segments
    found = BodyInertia(np.full(count, NO_MASS_KG), np.zeros((count, 3)), np.zeros((count, 3, 3)), body_kg)
    # Segments that the tables count to their neighbours get a trace of mass, which the solver needs.
    found.inertia[:] = np.eye(3) * NO_MASS_KG * 1e-2
    limbs = [s for s, name in enumerate(skeleton.segment_names) if part_name(name) in PARTS]
    for s in limbs:
        part = part_name(skeleton.segment_names[s])
        begin, end = _extent(skeleton, s)
        kg = body_kg * _mean(MASS_OF_BODY[part], sex)
        table = PARTS["palm" if part == "hand" and _is_palm(skeleton, s) else part]
        _add(found, s, kg, begin, end, _mean_part(table, sex))

    if not limbs:
        raise GatewayError(
            f"body '{skeleton.name}' has no segment of a person ({', '.join(MASS_OF_BODY)}): `analyse` "
            "alone takes what its segments weigh, with --inertia FILE (docs/guide/analysis.md has one)"
        )
    _add_trunk(found, skeleton, sex)
    return found


def part_name(segment: str) -> str:
    """Return the segment's name without its side."""
    for side in SIDES:
        segment = segment.removeprefix(side)
    return segment


def leg_stature(skeleton: Skeleton) -> float | None:
    """Return height of a person with these thighs and shanks (Drillis & Contini), m; None without them."""
    lengths = {
        part: [
            float(np.linalg.norm(tip))
            for name, tip in zip(skeleton.segment_names, skeleton.tips, strict=True)
            if part_name(name) == part
        ]
        for part in ("thigh", "shank")
    }
    if not all(lengths.values()):
        return None
    fractions = sum(LENGTH_OF_STATURE[part] for part in lengths)
    return sum(float(np.mean(values)) for values in lengths.values()) / fractions


def neutral_positions(skeleton: Skeleton) -> FloatArray:
    """Return (S, 3) m, proximal joints in the neutral posture, in the axes that all segments share there."""
    placed = np.zeros((skeleton.n_segments, 3))
    for s, parent in enumerate(skeleton.parents.tolist()):
        if parent >= 0:
            placed[s] = placed[parent] + skeleton.offsets[s]
    return placed


def _add_trunk(found: BodyInertia, skeleton: Skeleton, sex: str | None) -> None:
    """Add parts of the trunk, stacked from the middle of the hips toward the neck, to what carries them."""
    names = skeleton.segment_names
    if "pelvis" not in names:
        return
    placed = neutral_positions(skeleton)
    hips = [placed[names.index(f"{side}thigh")] for side in SIDES if f"{side}thigh" in names]
    base = np.mean(hips or [placed[names.index("pelvis")]], axis=0)
    neck = next((placed[names.index(name)] for name in ("neck", "head") if name in names), None)
    lengths = {part: _mean(lengths, sex) for part, lengths in TRUNK_LENGTH.items()}
    # The height of the trunk is not known, so the table's lengths are scaled by that of the legs.
    if neck is None:  # legs alone
        up, scale = np.array([0.0, 1.0, 0.0]), leg_stature(skeleton) or MEAN_STATURE_M
    else:
        up = (neck - base) / np.linalg.norm(neck - base)
        scale = float(np.linalg.norm(neck - base)) / sum(lengths.values())
    below = base
    for part, length in lengths.items():
        above = below + scale * length * up
        carrier = _carrier(names, placed, part, float((above + below) @ up) / 2, up)
        if carrier is not None:
            kg = found.body_kg * _mean(TRUNK_MASS[part], sex)
            at = placed[carrier]
            _add(found, carrier, kg, above - at, below - at, _mean_part(PARTS[part], sex))
        below = above


def _carrier(
    names: tuple[str, ...], placed: FloatArray, part: str, height: float, up: FloatArray
) -> int | None:
    """Return the segment that a part of the trunk is fixed to; None where the body has none."""
    if part == "lower_trunk":
        return names.index("pelvis")
    column = [names.index(name) for name in _COLUMN if name in names]
    under = [s for s in column if placed[s] @ up <= height]
    if not column:
        return None
    return under[-1] if under else column[0]


def _add(found: BodyInertia, s: int, kg: float, begin: FloatArray, end: FloatArray, part: Part) -> None:
    """Add a part between two points of a segment to what the segment has already; change the arrays."""
    length = float(np.linalg.norm(end - begin))
    axis = (end - begin) / length
    radii = np.array([part.sagittal, part.longitudinal, part.transverse])
    if abs(axis[0]) > abs(axis[1]):  # a foot lies along x
        radii = radii[[1, 0, 2]]
    at = begin + part.centre * length * axis
    total = found.mass[s] + kg
    centre = (found.mass[s] * found.centre[s] + kg * at) / total
    spread = np.diag(kg * (radii * length) ** 2) + _parallel(kg, at - centre)
    found.inertia[s] += spread + _parallel(found.mass[s], found.centre[s] - centre)
    found.mass[s], found.centre[s] = total, centre


def _parallel(kg: float, offset: FloatArray) -> FloatArray:
    """Return (3, 3) what a point mass adds to the inertia about a point that it is off."""
    added: FloatArray = kg * (offset @ offset * np.eye(3) - np.outer(offset, offset))
    return added


def _extent(skeleton: Skeleton, s: int) -> tuple[FloatArray, FloatArray]:
    """Return where a part begins and ends, (3,) m in segment axes."""
    tip = skeleton.tips[s]
    if part_name(skeleton.segment_names[s]) != "foot":
        return np.zeros(3), tip
    stature = leg_stature(skeleton) or skeleton.stature_m or MEAN_STATURE_M
    length, depth = LENGTH_OF_STATURE["foot"] * stature, LENGTH_OF_STATURE["foot_height"] * stature
    heel = np.array([-HEEL_BEHIND_ANKLE * length, -0.5 * depth, 0.0])
    return heel, heel + np.array([length, 0.0, 0.0])


def _is_palm(skeleton: Skeleton, s: int) -> bool:
    forearm = np.linalg.norm(skeleton.tips[skeleton.parents[s]])
    return bool(np.linalg.norm(skeleton.tips[s]) < _PALM_OF_FOREARM * forearm)


def _mean(of_both: tuple[float, float], sex: str | None) -> float:
    male, female = of_both
    return {"male": male, "female": female}.get(sex or "", 0.5 * (male + female))


def _mean_part(of_both: tuple[Part, Part], sex: str | None) -> Part:
    return Part(*(_mean(pair, sex) for pair in zip(*of_both, strict=True)))
