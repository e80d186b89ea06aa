"""Joint angles of a walking-like whole-body motion, as data.

ISB axes (x anterior, y up, z right). About z a positive angle moves what hangs down forward: flexion of
hip, shoulder and elbow and dorsiflexion are positive, flexion of knee and trunk negative. Harmonics are
of the stride (two steps); the right leg swings with phase 0, the left with phase π. Amplitudes stay within
a quiet walker's ranges.
"""

from __future__ import annotations

from math import pi, radians

Term = tuple[int, float, int, float]
"""Axis (0 x, 1 y, 2 z), amplitude in rad, harmonic of the stride or 0 for a mean, phase in rad."""

_MEAN = pi / 2  # of a term of harmonic 0: sin(π/2)


def _turn(axis: int, degrees: float, harmonic: int, phase: float = 0.0) -> Term:
    return (axis, radians(degrees), harmonic, phase)


_LEG: dict[str, list[Term]] = {
    "thigh": [
        _turn(2, 12, 0, _MEAN),
        _turn(2, 20, 1),
        _turn(2, 3, 2, 0.9),
        _turn(0, 4, 1, 0.5),
        _turn(1, 5, 1, 1.1),
    ],
    "shank": [_turn(2, -26, 0, _MEAN), _turn(2, 20, 1, 0.9), _turn(2, 12, 2, 2.2), _turn(1, 4, 1, 0.3)],
    "foot": [_turn(2, 3, 0, _MEAN), _turn(2, 10, 1, 2.4), _turn(2, 6, 2, 0.4), _turn(0, 4, 1, 1.7)],
    "toes": [_turn(2, 8, 0, _MEAN), _turn(2, 8, 1, 2.9)],
}
_ARM: dict[str, list[Term]] = {
    "shoulder_girdle": [_turn(1, 4, 1, 0.2), _turn(0, 3, 2, 0.6)],
    "upper_arm": [_turn(2, 18, 1), _turn(0, 4, 2, 0.3), _turn(1, 6, 1, 0.8), _turn(2, 4, 0, _MEAN)],
    "forearm": [_turn(2, 28, 0, _MEAN), _turn(2, 14, 1, -0.4), _turn(1, 15, 1, 0.7)],
    "hand": [_turn(2, 6, 1, 0.9), _turn(0, 5, 2, 1.2), _turn(2, 5, 0, _MEAN)],
}
_TRUNK: dict[str, list[Term]] = {
    "pelvis": [_turn(2, -3, 0, _MEAN), _turn(2, 2, 2, 0.3), _turn(0, 4, 1, 1.4), _turn(1, 6, 1, 0.1)],
    "lumbar": [_turn(1, 3, 1, 3.2), _turn(0, 3, 1, 4.4)],
    "thorax": [_turn(2, -3, 0, _MEAN), _turn(1, 9, 1, 3.3), _turn(0, 4, 1, 4.5), _turn(2, 2, 2, 1.0)],
    "neck": [_turn(1, 2, 1, 0.4)],
    "head": [_turn(2, 3, 2, 2.0), _turn(1, 4, 1, 0.2), _turn(0, 2, 1, 0.7)],
}
_OTHER: list[Term] = [_turn(2, 2, 1, 0.5), _turn(0, 1, 2, 1.5)]

WALKING_ROOT: list[tuple[int, float, float, float]] = [
    (0, 1.2, 0.09, 0.0),  # to and fro along the heading, 0.6 m/s at most
    (0, 0.02, 2, 0.8),  # speed varies within each step
    (1, 0.025, 2, 2.3),  # bobs with every step
    (2, 0.025, 1, 0.6),  # sways with every stride
]
"""Axis of the root segment, amplitude in m, frequency as a multiple of the stride's, phase in rad."""


def walking_terms(segment: str) -> list[Term]:
    """Return the terms of a segment's rotation against its parent, in its own axes."""
    side, _, part = segment.partition("_")
    if side not in ("left", "right"):
        return _TRUNK.get(segment, _OTHER)
    terms = {**_LEG, **_ARM}.get(part, _OTHER)
    # Arms swing against the leg of their side.
    is_late = (side == "left") != (part in _ARM)
    delay = pi if is_late else 0.0
    # What is not flexion is mirrored at the sagittal plane.
    mirrored = (1.0, 1.0, 1.0) if side == "right" else (-1.0, -1.0, 1.0)
    return [
        (axis, amplitude * mirrored[axis], harmonic, phase + delay * harmonic)
        for axis, amplitude, harmonic, phase in terms
    ]
