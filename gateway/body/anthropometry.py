"""Bodies fitted to a person: lengths from stature or a tape measure, masses from body mass.

Lengths by Drillis & Contini (1966, Body segment parameters, New York University TR 1166.03), as given by
Winter (2009, Biomechanics and Motor Control of Human Movement, 4th ed., fig. 4.1). Masses and centres of
mass by de Leva (1996, J. Biomech. 29(9): 1223–1230, table 4).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from gateway.body.skeleton import Skeleton
from gateway.errors import SettingsError, nearest
from gateway.frames import FloatArray
from gateway.support.settings_files import Strict

LENGTH_OF_STATURE = {
    "thigh": 0.245,
    "shank": 0.246,
    "foot_height": 0.039,
    "foot": 0.152,
    "upper_arm": 0.186,
    "forearm": 0.146,
    "hand": 0.108,
    "half_shoulder_width": 0.129,
    "half_hip_width": 0.0955,
    "hip_height": 0.530,
    "shoulder_height": 0.818,
}
"""Fractions of stature (Drillis & Contini). ``foot``: its length; ``foot_height``: of the ankle."""

MASS_OF_BODY: dict[str, tuple[float, float]] = {
    "head": (0.0694, 0.0668),
    "thorax": (0.3229, 0.3010),
    "pelvis": (0.1117, 0.1247),
    "upper_arm": (0.0271, 0.0255),
    "forearm": (0.0162, 0.0138),
    "hand": (0.0061, 0.0056),
    "thigh": (0.1416, 0.1478),
    "shank": (0.0433, 0.0481),
    "foot": (0.0137, 0.0129),
}
"""Fractions of body mass, men and women (de Leva). ``thorax`` is the upper and the middle part of the trunk
(0.1596 + 0.1633, 0.1545 + 0.1465), ``pelvis`` the lower part; the head has the neck with it."""

WIDTHS = {"hip_width": ("left_thigh", "right_thigh"), "shoulder_width": ("left_upper_arm", "right_upper_arm")}
"""Distances between the proximal joints of two segments."""

SIDES = ("left_", "right_")
_SIDEWAYS = 2  # z, to the right

Length = Annotated[float, Field(gt=0.005, lt=2.0, allow_inf_nan=False)]


class Subject(Strict):
    """The person who wears the suit."""

    height_m: float | None = Field(default=None, gt=0.4, lt=2.6, description="stature, m")
    mass_kg: float | None = Field(default=None, gt=2, lt=400, description="body mass, kg")
    sex: Literal["female", "male"] | None = Field(
        default=None, description="for the masses of segments; none: the mean of both tables"
    )
    lengths: dict[str, Length] = Field(
        default={},
        description="measured lengths, m: a segment from joint to joint, of one side (left_thigh) or of both "
        "(thigh); hip_width and shoulder_width between the joint centres",
    )

    def as_json(self) -> dict[str, Any]:
        """Return what is known of the person, as it stands in files."""
        return self.model_dump(mode="json", exclude_none=True, exclude_defaults=True)


def scaled(skeleton: Skeleton, subject: Subject, where: str = "subject") -> Skeleton:
    """Return the skeleton with the subject's lengths: first all by stature, then those that were measured.

    A measured segment takes the joints that hang on it along. Raises ``SettingsError``, which begins with
    ``where``, for a length that the body does not have.
    """
    offsets, tips, stature = skeleton.offsets.copy(), skeleton.tips.copy(), skeleton.stature_m
    points = np.array([point for _, point in skeleton.contacts]).reshape(-1, 3)
    carriers = np.array([segment for segment, _ in skeleton.contacts], dtype=np.int64)
    if subject.height_m is not None:
        if stature is None:
            raise SettingsError(
                f"{where}: body '{skeleton.name}' has no 'stature_m', so height_m says nothing about it; "
                "give its measured 'lengths'"
            )
        offsets *= subject.height_m / stature
        tips *= subject.height_m / stature
        points *= subject.height_m / stature
        stature = subject.height_m
    for name, length in subject.lengths.items():
        # Widths come after the lengths, which scale the very joints that a width places.
        if name in WIDTHS and set(WIDTHS[name]) <= set(skeleton.segment_names):
            continue
        for segment in _meant(skeleton, name, where):
            ratio = length / float(np.linalg.norm(tips[segment]))
            tips[segment] *= ratio
            # Joints further out hang on this segment, and move with its end.
            offsets[skeleton.parents == segment] *= ratio
            points[carriers == segment] *= ratio
    for name, pair in WIDTHS.items():
        if name in subject.lengths and set(pair) <= set(skeleton.segment_names):
            _set_width(skeleton, offsets, tips, pair, subject.lengths[name])
    contacts = tuple(zip(carriers.tolist(), points, strict=True))
    return replace(skeleton, offsets=offsets, tips=tips, contacts=contacts, stature_m=stature)


def lengths_of(skeleton: Skeleton) -> dict[str, float]:
    """Return the lengths of a body, m, by the names that ``Subject.lengths`` takes.

    A pair of limbs of one length has one name, such as ``thigh``.
    """
    own = {
        name: round(float(np.linalg.norm(tip)), 3)
        for name, tip in zip(skeleton.segment_names, skeleton.tips, strict=True)
    }
    found: dict[str, float] = {}
    for name, length in own.items():
        both = _without_side(name)
        # Limbs of different lengths keep their own names, or one length would be lost.
        is_pair = name != both and len({own.get(f"{side}{both}") for side in SIDES}) == 1
        found[both if is_pair else name] = length
    for name, pair in WIDTHS.items():
        if set(pair) <= set(skeleton.segment_names):
            left, right = (skeleton.offsets[skeleton.index(segment)] for segment in pair)
            found[name] = round(float(abs(right[_SIDEWAYS] - left[_SIDEWAYS])), 3)
    return found


def segment_masses(skeleton: Skeleton, mass_kg: float, sex: str | None = None) -> FloatArray:
    """Return (n_segments,) kg. NaN for a segment that the tables do not have (shoulder girdles count as
    thorax)."""
    masses = np.full(skeleton.n_segments, np.nan)
    for i, name in enumerate(skeleton.segment_names):
        fractions = MASS_OF_BODY.get(_without_side(name))
        if fractions is not None:
            male, female = fractions
            masses[i] = mass_kg * {"male": male, "female": female}.get(sex or "", 0.5 * (male + female))
    return masses


def _meant(skeleton: Skeleton, name: str, where: str) -> list[int]:
    """Return the segments of a name with or without side."""
    names = skeleton.segment_names
    found = [i for i, segment in enumerate(names) if name in (segment, _without_side(segment))]
    found = [i for i in found if np.linalg.norm(skeleton.tips[i]) > 0.0]
    if not found:
        known = {*names, *map(_without_side, names), *WIDTHS}
        raise SettingsError(f"{where}: the body has no length '{name}'" + nearest(name, known))
    return found


def _without_side(name: str) -> str:
    for side in SIDES:
        name = name.removeprefix(side)
    return name


def _set_width(
    skeleton: Skeleton, offsets: FloatArray, tips: FloatArray, pair: tuple[str, str], width: float
) -> None:
    """Stretch sideways what lies between two joints, from the segment they share; changes the arrays."""
    chains = [_ancestors(skeleton, skeleton.index(name)) for name in pair]
    own = [
        [i for i in chain if i not in other] for chain, other in zip(chains, reversed(chains), strict=True)
    ]
    left, right = (offsets[chain, _SIDEWAYS].sum() for chain in own)
    ratio = width / abs(right - left)
    for chain in own:
        offsets[chain, _SIDEWAYS] *= ratio
        tips[chain[1:], _SIDEWAYS] *= ratio


def _ancestors(skeleton: Skeleton, segment: int) -> list[int]:
    """Return a segment, its parent, and so on."""
    chain = []
    while segment >= 0:
        chain.append(segment)
        segment = int(skeleton.parents[segment])
    return chain
