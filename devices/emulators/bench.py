"""Modules on a table: nobody wears them yet, and the user has to find out which is which."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from devices.deferred import Rotation
from devices.emulators.bodies import NO_PARENT, emulated_body
from devices.emulators.imperfections import TYPICAL, Imperfections
from devices.emulators.motion.motions import BodyMotion
from devices.emulators.motion.waves import waves
from devices.emulators.suit_settings import SuitSettings
from devices.emulators.suit_traffic import SuitTraffic

_SPACING_M = 0.06
_PER_ROW = 5


def bench_motion(n: int, seed: int) -> BodyMotion:
    """Return modules ``module_1`` to ``module_n`` that lie still, in rows, facing up or down, at random."""
    rng = np.random.default_rng([seed, 7])
    headings = Rotation.from_euler("z", rng.uniform(-np.pi, np.pi, (n, 1)))
    # Some modules lie on their backs.
    flips = Rotation.from_euler("x", np.pi * rng.integers(2, size=(n, 1)))
    places = np.array([[k % _PER_ROW, k // _PER_ROW, 0.0] for k in range(n)]) * _SPACING_M
    numbers = range(1, n + 1)
    body = emulated_body(
        tuple(f"module_{number}" for number in numbers),
        [NO_PARENT] * n,
        np.zeros((n, 3)),
        module_positions=(headings * flips).inv().apply(places),
        module_ids=list(numbers),
        reference_posture=(headings * flips).as_quat(scalar_first=True),
    )
    return BodyMotion(body, waves(n, []))


def bench_suit(
    n: int,
    seed: int,
    *,
    is_fresh: bool = True,
    settings: SuitSettings | None = None,
    imperfections: Imperfections = TYPICAL,
) -> SuitTraffic:
    """Return n modules (1 to 63) on a table.

    is_fresh: they come from the factory and all send under id 0; otherwise they send under 1 to n.
    Raises ``ValueError`` for another n.
    """
    if not 1 <= n <= 63:
        raise ValueError(f"{n} modules on the bench: there may be 1 to 63")
    settings = settings or SuitSettings()
    if is_fresh:
        settings = replace(settings, fresh=frozenset(range(1, n + 1)))
    return SuitTraffic(bench_motion(n, seed), settings, imperfections, seed)
