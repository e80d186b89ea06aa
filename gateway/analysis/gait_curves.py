"""What a clinic reads of a walk: angles, torques and powers of the legs by percent of the stride."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from gateway.analysis.analysing import Analysis
from gateway.analysis.cycles import Cycles, cycles, foot_of, normal_band
from gateway.body.inertia import part_name
from gateway.frames import FloatArray


class GaitCurve(NamedTuple):
    """One quantity of one joint over the strides of its side."""

    name: str
    """With its unit: ``left_knee_flexion_deg``."""
    title: str
    """Without its side: ``knee flexion``."""
    unit: str
    is_left: bool
    cycles: Cycles
    band: FloatArray | None
    """(51, 3) percent, mean and standard deviation of published gait; None where there is none."""


def gait_curves(found: Analysis) -> Iterator[GaitCurve]:
    """Yield angles, torques and powers of every joint between a foot that strides and the trunk.

    Of a stride with forces that are not known the torques are NaN. What no stride tells is left out.
    """
    kg = found.inertia.body_kg
    torques, power = found.known_torques / kg, found.known_power / kg
    for j, joint in enumerate(found.skeleton.joints):
        foot = foot_of(found.skeleton, j)
        own = [stride for stride in found.strides if stride.foot == foot]
        if not own:
            continue
        part = part_name(joint.name)
        is_left = joint.name.startswith("left_")
        named: list[tuple[str, str, FloatArray, FloatArray | None]] = []
        for k, angle in enumerate(joint.angles):
            what = f"{joint.name}_{angle.name}"
            degrees = np.degrees(found.angles[:, j, k])
            named.append((what, "deg", degrees, normal_band(joint.name, angle.name)))
            named.append((f"{what}_torque", "n_m_per_kg", torques[:, j, k], None))
        named.append((f"{joint.name}_power", "w_per_kg", power[:, j], None))
        for what, unit, values, band in named:
            over = cycles(values, found.time_s, own)
            if np.isfinite(over.curves).any():
                title = what.replace(joint.name, part, 1).replace("_", " ")
                yield GaitCurve(f"{what}_{unit}", title, unit, is_left, over, band)
