"""Bodies for the emulated suit."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from devices.emulators.bodies import EmulatedBody, EmulatedLocalDevice, emulated_body

STANDING_FACING_EAST = [np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0]


def random_mountings(n: int, seed: int) -> np.ndarray:
    return Rotation.random(n, random_state=seed).as_quat(scalar_first=True)


@pytest.fixture
def arm4() -> EmulatedBody:
    """A robot arm on a table: four links along their own x, modules off the joints."""
    return emulated_body(
        ("base", "upper", "lower", "tool"),
        [-1, 0, 1, 2],
        [[0, 0, 0], [0.30, 0, 0], [0.28, 0, 0.02], [0.20, 0.01, 0]],
        module_positions=[[0.15, 0.02, 0.03], [0.14, 0, 0.03], [0.1, -0.02, 0.03], [0.07, 0, 0.02]],
        sensor_to_segment=random_mountings(4, 4),
        reference_posture=Rotation.from_euler(
            "zy", [[0, -60], [0, 20], [30, 40], [30, 60]], degrees=True
        ).as_quat(scalar_first=True),
    )


@pytest.fixture
def pendulum3() -> EmulatedBody:
    """Three links hanging from a pivot, x up along each."""
    x_up = Rotation.from_euler("y", -90, degrees=True).as_quat(scalar_first=True)
    return emulated_body(
        ("upper", "middle", "lower"),
        [-1, 0, 1],
        [[0, 0, 0], [-0.28, 0, 0], [-0.30, 0, 0]],
        module_positions=[[-0.14, 0, 0], [-0.14, 0, 0], [-0.07, 0, 0]],
        module_ids=[1, 2, 3],
        reference_posture=np.tile(x_up, (3, 1)),
    )


@pytest.fixture
def human17() -> EmulatedBody:
    """Standing upright, facing east, ISB axes."""
    names, parents, offsets = (
        ["pelvis", "thorax", "head"],
        [-1, 0, 1],
        [[0, 0, 0], [0, 0.12, 0], [0, 0.45, 0]],
    )
    for side, sign in (("left", -1), ("right", 1)):
        arm = [(1, 0.3, 0.03), (None, 0, 0.16), (None, -0.3, 0), (None, -0.26, 0)]
        leg = [(0, -0.08, 0.09), (None, -0.42, 0), (None, -0.42, 0)]
        for part, (parent, up, out) in zip(
            ("shoulder_girdle", "upper_arm", "forearm", "hand", "thigh", "shank", "foot"),
            arm + leg,
            strict=True,
        ):
            parents.append(len(names) - 1 if parent is None else parent)
            names.append(f"{side}_{part}")
            offsets.append([0, up, sign * out])
    return emulated_body(
        tuple(names),
        parents,
        offsets,
        module_positions=np.tile([0.03, -0.1, 0.02], (17, 1)),
        sensor_to_segment=random_mountings(17, 17),
        reference_posture=np.tile(STANDING_FACING_EAST, (17, 1)),
        local_devices=(EmulatedLocalDevice(40, 0, np.array([0.0, 0.1, 0.0]), 3, sigma=0.01, rate_hz=10.0),),
    )
