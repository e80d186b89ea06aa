"""How far an analysis is to be trusted: sentences on what its numbers leave out."""

from __future__ import annotations

import numpy as np

from gateway.analysis.floor import FloorForces, ForceSource, feet
from gateway.analysis.inverse_dynamics import Dynamics
from gateway.analysis.smooth_motion import SmoothMotion
from gateway.body.inertia import BodyInertia

WHOLE_BODY = 0.97
"""A body that carries this share of its person's mass is all of it."""
MOST_LEFT = 0.10
"""Of the weight, RMS: beyond it the motion is badly explained."""
_STAYS_M, _MOVES_M = 1e-4, 0.05
"""A root that moves less while a foot moves more hangs from a point."""


def trust_notes(
    motion: SmoothMotion, inertia: BodyInertia, floor: FloorForces, dynamics: Dynamics, weight_n: float
) -> list[str]:
    """Return what a reader must know before the numbers. weight_n: of the body's segments."""
    notes = []
    has_feet = len(feet(motion.skeleton)) > 0
    is_whole = inertia.share > WHOLE_BODY
    if has_feet and _is_held(motion, dynamics):
        notes.append(
            "The root stays at one point while the feet move, so its path was not recorded: floor forces and "
            "the torques of legs and trunk are not to be used. Record, or play the recording as a link, with "
            "root_motion.mode: walking, or with a device that measures where the root is."
        )
    if not is_whole:
        notes.append(
            f"The body carries {100 * inertia.share:.0f} % of the person: floor forces are not estimated, "
            "and what is left over at the root is the part that is not there."
        )
    if has_feet and not np.isin(floor.source, (ForceSource.MEASURED, ForceSource.ESTIMATED)).any():
        notes.append(
            "No floor force is known: the torques of the legs, and their muscles, are those of legs that "
            "hang in the air. Give force plates with --forces, or record the whole body."
        )
    for source, word in ((ForceSource.MEASURED, "measured"), (ForceSource.ESTIMATED, "estimated")):
        share = float((floor.source == source).any(axis=1).mean()) if floor.source.size else 0.0
        if share:
            notes.append(f"Floor forces are {word} in {100 * share:.0f} % of the frames.")
    unknown = (floor.source == ForceSource.UNKNOWN).any(axis=1)
    if unknown.any():
        notes.append(
            f"In {100 * float(unknown.mean()):.0f} % of the frames a foot stands whose force nothing tells: "
            "torques, powers and muscles that it would change are left out there."
        )
    notes += floor.notes
    return [*notes, *_left_over(dynamics, weight_n, has_feet and is_whole)]


def _is_held(motion: SmoothMotion, dynamics: Dynamics) -> bool:
    """Return whether the root was held at one point while the legs swung below it."""
    swings = np.ptp(dynamics.p_w[:, feet(motion.skeleton)], axis=0)
    return bool(np.ptp(motion.root, axis=0).max() < _STAYS_M and swings.max() > _MOVES_M)


def _left_over(dynamics: Dynamics, weight_n: float, is_explained: bool) -> list[str]:
    """Return sentences on what no force explains.

    is_explained: whether floor forces ought to explain the whole motion.
    """
    left = np.linalg.norm(dynamics.residual_force, axis=1)
    rms = float(np.sqrt(np.mean(left**2)))
    notes = [
        f"Left over at the root: {rms:.0f} N RMS, {left.max():.0f} N at most; "
        f"{np.sqrt(np.mean(np.sum(dynamics.residual_moment**2, axis=1))):.0f} N m RMS."
    ]
    if is_explained and rms > MOST_LEFT * weight_n:
        wide = float((left > MOST_LEFT * weight_n).mean())
        notes.append(
            f"That is {100 * rms / weight_n:.0f} % of the weight (over {100 * MOST_LEFT:.0f} % in "
            f"{100 * wide:.0f} % of the frames): do not trust torques and muscles. Does the person sit, "
            "lean or carry something; is --mass right; would a lower --cutoff do?"
        )
    return notes
