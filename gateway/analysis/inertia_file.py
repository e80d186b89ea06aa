"""What the segments of a body that is no person weigh, as a YAML file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from gateway.body.body_file import Point
from gateway.body.inertia import NO_MASS_KG, BodyInertia
from gateway.body.skeleton import Skeleton
from gateway.errors import SettingsError, nearest
from gateway.support.settings_files import Strict, load_settings

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class SegmentMass(Strict):
    """One segment."""

    mass_kg: Positive
    centre_m: Point = Field(description="centre of mass from the proximal joint, segment axes")
    inertia_kg_m2: tuple[Positive, Positive, Positive] = Field(
        description="about the centre of mass, along x, y and z of the segment"
    )


class InertiaFile(Strict):
    """All that have mass; others weigh nothing."""

    segments: dict[str, SegmentMass] = Field(min_length=1)


def load_inertia(path: Path, skeleton: Skeleton) -> BodyInertia:
    """Return the masses and inertias that a file gives.

    Raises ``SettingsError`` naming the file, the entry and the remedy.
    """
    file = load_settings(path, InertiaFile)
    count = skeleton.n_segments
    mass, centre = np.full(count, NO_MASS_KG), np.zeros((count, 3))
    inertia = np.tile(np.eye(3) * NO_MASS_KG * 1e-2, (count, 1, 1))
    for name, entry in file.segments.items():
        if name not in skeleton.segment_names:
            raise SettingsError(
                f"{path}: segments.{name}: body '{skeleton.name}' has no such segment"
                + nearest(name, skeleton.segment_names)
            )
        s = skeleton.index(name)
        mass[s], centre[s], inertia[s] = entry.mass_kg, entry.centre_m, np.diag(entry.inertia_kg_m2)
    return BodyInertia(mass, centre, inertia, float(mass.sum()))
