"""Reconstructors by name: observations in time order to skeleton frames."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from gateway.body.skeleton import WornSuit
from gateway.reconstruction.fused import FusedReconstructor
from gateway.reconstruction.inertial.articulated import ArticulatedReconstructor
from gateway.reconstruction.inertial.independent import IndependentReconstructor
from gateway.reconstruction.inertial.joint import JointReconstructor, OutwardReconstructor
from gateway.reconstruction.reconstructor import Reconstructor, update_many

__all__ = ["FUSED", "RECONSTRUCTORS", "Reconstructor", "create_reconstructor", "update_many"]

RECONSTRUCTORS: dict[str, Callable[[WornSuit, float], Reconstructor]] = {
    "articulated": ArticulatedReconstructor,
    "fused": FusedReconstructor,
    "fused_neutral": partial(FusedReconstructor, starts_neutral=True),
    "independent": IndependentReconstructor,
    "joint": JointReconstructor,
    "outward": OutwardReconstructor,
}
"""Name to constructor; its arguments: the suit, and the nominal interval of the frames in s."""


FUSED = frozenset({"fused", "fused_neutral"})
"""Those that want orientations fused on the modules, and no raw values."""


def create_reconstructor(name: str, suit: WornSuit, nominal_interval_s: float) -> Reconstructor:
    """The reconstructor of that name. Raises ``ValueError`` for an unknown one, naming those there are."""
    if name not in RECONSTRUCTORS:
        known = ", ".join(sorted(RECONSTRUCTORS))
        raise ValueError(f"no reconstructor is called {name!r}; there are: {known}")
    return RECONSTRUCTORS[name](suit, nominal_interval_s)
