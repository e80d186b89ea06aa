"""Every method on one recording, in every variant: what the table is made of."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field, replace

import numpy as np

from benchmarks.never_worse import peers, split
from benchmarks.never_worse.case import Case, Variant
from benchmarks.never_worse.judging import Claims, Errors, claims, errors
from benchmarks.never_worse.solving import METHODS, OURS, Solution, live, smoothed
from gateway.frames import FloatArray
from gateway.reconstruction import create_reconstructor
from gateway.reconstruction.reconstructor import update_many

SMOOTHED = ", smoothed"
LATER = ", ½ later"
"""Of VQF: it runs half a sample ahead; its orientations taken as those of half a sample after."""
INDEPENDENT = "independent"
ALL = (OURS, OURS + SMOOTHED, "outward", "outward" + SMOOTHED, INDEPENDENT)
"""The gateway's own methods."""
VQFS = (peers.VQF_6, peers.VQF_9)


@dataclass
class Judged:
    """What was found on one recording."""

    name: str
    part: str
    kind: str
    is_spatial: bool
    errors: dict[Variant, dict[str, Errors]] = field(default_factory=dict)
    claims: dict[Variant, dict[str, Claims]] = field(default_factory=dict)

    @property
    def variants(self) -> list[Variant]:
        """Those that were tried, the best informed first."""
        return sorted(self.errors, reverse=True)

    def vqf(self, variant: Variant, later: str = "", part: str = "total") -> float:
        """Return degrees, of the better VQF that knows no more: without the field the 6-axis one."""
        found = self.errors[variant]
        return min(float(getattr(found[name + later], part)) for name in VQFS if name + later in found)

    def ratio(self, variant: Variant, method: str = OURS) -> float:
        """Return the method's error over that."""
        return self.errors[variant][method].total / self.vqf(variant)

    @property
    def worst(self) -> tuple[float, Variant]:
        """The largest ratio, and where."""
        return max((self.ratio(variant), variant) for variant in self.variants)

    def field_ratio(self) -> float:
        """Return the largest error with the field over that without it, all else alike; NaN where there is
        none."""
        found = [
            self.errors[variant][OURS].total / self.errors[replace(variant, has_field=False)][OURS].total
            for variant in self.variants
            if variant.has_field
        ]
        return max(found, default=float("nan"))


def judge(one: split.Named, methods: Collection[str], has_peers: bool) -> Judged:
    """Return all that is to be known of a recording. Raises ``FileNotFoundError`` or ``ValueError`` where it
    is not there.

    methods: of ``ALL``. has_peers: whether others than VQF are judged too.
    """
    case = split.case(one.name)
    result = Judged(one.name, one.part, case.kind, case.is_spatial)
    others = _peers(case, has_peers)
    alone: dict[bool, FloatArray] = {}
    for variant in case.variants:
        found = result.errors[variant] = {
            name: each for name, (each, wants_field) in others.items() if variant.has_field or not wants_field
        }
        result.claims[variant] = {}
        for method, solution in _ours(case, variant, methods).items():
            found[method] = errors(case, variant, solution.q_wb)
            result.claims[variant][method] = claims(case, variant, solution)
        if INDEPENDENT in methods:
            if variant.has_field not in alone:
                alone[variant.has_field] = _independent(case, variant)
            found[INDEPENDENT] = errors(case, variant, alone[variant.has_field])
    return result


def _ours(case: Case, variant: Variant, methods: Collection[str]) -> dict[str, Solution]:
    found = {}
    for method in METHODS:
        if method != OURS and case.suit.skeleton.n_segments == 1:
            continue  # the same for one segment
        if method in methods:
            found[method] = live(method, case, variant)
        if method + SMOOTHED in methods:
            found[method + SMOOTHED] = smoothed(method, case, variant)
    return found


def _peers(case: Case, has_others: bool) -> dict[str, tuple[Errors, bool]]:
    """Return the errors by peer, and whether it used the field."""
    variant, result = case.variants[0], {}
    found = peers.vqf(case) | (peers.others(case) if has_others else {})
    for name, q_wb in found.items():
        wants_field = case.has_field and name not in peers.WITHOUT_FIELD
        if name in VQFS:
            result[name] = errors(case, variant, q_wb), wants_field
            result[name + LATER] = errors(case, variant, q_wb, is_later=True), wants_field
        elif has_others:
            result[name] = errors(case, variant, q_wb), wants_field
    return result


def _independent(case: Case, variant: Variant) -> FloatArray:
    frames = case.frames
    if not variant.has_field:
        frames = [replace(f, magnetic_field=np.full_like(f.magnetic_field, np.nan)) for f in frames]
    solver = create_reconstructor(INDEPENDENT, case.suit_of(variant), case.interval_s)
    return np.stack([frame.q_wb for frame in update_many(solver, frames)])
