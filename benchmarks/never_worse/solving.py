"""The gateway's own methods on a case: orientations, what they claim, and their covariance."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks.never_worse.case import Case, Variant
from gateway.frames import FloatArray, SkeletonFrame
from gateway.reconstruction.inertial.tree.reconstructor import (
    ChainReconstructor,
    ChainSettings,
    JointReconstructor,
    OutwardReconstructor,
)
from gateway.reconstruction.smoothing import Smoother
from gateway.reconstruction.whole_body import WholeBodyReconstructor

METHODS: dict[str, type[ChainReconstructor]] = {"joint": JointReconstructor, "outward": OutwardReconstructor}
OURS = "joint"


class Solution(NamedTuple):
    """What a method makes of a case. T frames, S segments."""

    q_wb: FloatArray  # (T, S, 4)
    sigma: FloatArray  # (T, S) rad
    covariance: FloatArray  # (T, S, 3, 3) rad², world axes, as published


def live(method: str, case: Case, variant: Variant, settings: ChainSettings | None = None) -> Solution:
    """Return the solution as the service gives it, frame by frame.

    settings: of the estimator; whether it uses the field is the variant's affair.
    """
    body, finder = _body(method, case, variant, settings)
    prepared = body.prepare(case.frames)
    stood_s = prepared.stood_s
    covariance = np.empty((*stood_s.shape, 2, 3, 3))
    found = finder.poses(prepared.observations, prepared.frames, stood_s, covariance)
    frames = body.finish(found, prepared)
    return Solution(*_stacked(frames), covariance[:, :, 1])


def smoothed(method: str, case: Case, variant: Variant, settings: ChainSettings | None = None) -> Solution:
    """Return the solution of the whole recording at once, forward and backward."""
    body, _ = _body(method, case, variant, settings)
    with tempfile.TemporaryDirectory() as folder:
        smoother = Smoother(body, Path(folder))
        smoother.add(case.frames)
        return Solution(*_stacked(list(smoother.smoothed())), smoother.covariance())


def _body(
    method: str, case: Case, variant: Variant, settings: ChainSettings | None
) -> tuple[WholeBodyReconstructor, ChainReconstructor]:
    suit = case.suit_of(variant)
    used = replace(settings or ChainSettings(), uses_field=variant.has_field)
    finder = METHODS[method](suit, case.interval_s, used)
    return WholeBodyReconstructor(suit, finder), finder


def _stacked(frames: list[SkeletonFrame]) -> tuple[FloatArray, FloatArray]:
    return np.stack([frame.q_wb for frame in frames]), np.stack([frame.sigma for frame in frames])
