"""How much of its largest force a muscle has at its length and while it shortens or lengthens.

Length and speed of the fibres follow from those of the wire, the tendon taken as stiff, by the parameters of
the published model; the curves are mujoco's (its documentation, "Muscle actuators"). A person's wire is
brought to the model's size by the lengths of both in the neutral posture. Passive forces are left out.
"""

from __future__ import annotations

from enum import StrEnum

import numpy as np

from gateway.analysis.muscle_paths import MusclePaths
from gateway.body.anthropometry import SIDES
from gateway.frames import FloatArray

LEAST_SHARE = 0.02
"""A muscle that has less, far from its best length, still counts as having so much."""


class Curves(StrEnum):
    """What the largest force of a muscle follows."""

    NONE = "none"
    LENGTH = "length"
    LENGTH_VELOCITY = "length_velocity"


def force_shares(paths: MusclePaths, lengths: FloatArray, time_s: FloatArray, curves: Curves) -> FloatArray:
    """Return (F, W) of the largest force, 0.02 to about 1.4, of wires of these lengths (F, W) m at instants
    (F,)."""
    if curves is Curves.NONE:
        return np.ones_like(lengths)
    import mujoco  # noqa: PLC0415 - an extra

    sizes = np.array([wire.standing_length_m for wire in paths.wires]) / _standing_lengths(paths)
    in_model = lengths * sizes
    speeds = np.gradient(in_model, time_s, axis=0)
    if curves is Curves.LENGTH:
        speeds = np.zeros_like(speeds)
    shares = np.empty_like(lengths)
    for w, wire in enumerate(paths.wires):
        for f in range(len(lengths)):
            gain = mujoco.mju_muscleGain(in_model[f, w], speeds[f, w], wire.length_range, 1.0, wire.gain)
            shares[f, w] = -gain / wire.peak_force_n
    return np.maximum(shares, LEAST_SHARE)


def _standing_lengths(paths: MusclePaths) -> FloatArray:
    """Return (W,) m in the posture in which all segments' axes are parallel, as in the model."""
    still = np.tile([1.0, 0.0, 0.0, 0.0], (paths.skeleton.n_segments, 1))
    paths.place(np.zeros(3), still, dict.fromkeys(SIDES, 0.0))
    return paths.lengths()
