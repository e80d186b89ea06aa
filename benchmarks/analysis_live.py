"""Muscles as the live page has them, against the analysis of the whole walk."""

from __future__ import annotations

import time
from typing import NamedTuple

import numpy as np

from benchmarks.analysis_trials import CUTOFF_HZ, GRAVITY, AnalysedTrial, rms
from gateway.analysis.analysing import analyse
from gateway.analysis.live import LiveMuscles
from gateway.analysis.muscles import find_muscles
from gateway.recording.exporters.formats import Axes
from gateway.recording.exporters.take import take_of

_EVERY_S = 0.05
_AT_WORK = 0.1


class LiveAgreement(NamedTuple):
    """Of all muscles at all instants that live told."""

    r: float
    rmse: float
    median_r: float
    """Of the muscles that reach an activity of 0.1."""
    ms: float
    """Processor time of one answer."""


def live_beside(trial: AnalysedTrial) -> LiveAgreement:
    """Poses one after the other, floor forces estimated in both."""
    take = take_of(trial.arrays, "walk", Axes.Z_UP)
    root = int(np.flatnonzero(trial.arrays.skeleton.parents < 0)[0])
    found = analyse(trial.arrays, "walk", trial.inertia, GRAVITY, CUTOFF_HZ)
    whole = find_muscles(found).activity
    live = LiveMuscles(trial.arrays.skeleton, trial.files.body_kg)
    activities, then, spent, due = [], [], [], -np.inf
    for k, at in enumerate(take.time_s.tolist()):
        live.add(at, take.q_wb[k], take.p_w[k, root])
        if at < due:
            continue
        due = at + _EVERY_S
        begun = time.process_time()
        answer = live.now()
        if answer is not None:
            spent.append(time.process_time() - begun)
            activities.append(answer.activity)
            then.append(whole[int(np.argmin(np.abs(take.time_s - answer.time_s)))])
    ours, ref = np.array(activities), np.array(then)
    singly = [np.corrcoef(ours[:, i], ref[:, i])[0, 1] for i in np.flatnonzero(ref.max(axis=0) > _AT_WORK)]
    together = float(np.corrcoef(ours.ravel(), ref.ravel())[0, 1])
    return LiveAgreement(together, rms(ours - ref), float(np.median(singly)), 1e3 * float(np.median(spent)))
