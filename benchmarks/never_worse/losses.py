"""Recordings of a radio that loses samples: in bursts, each module by itself."""

from __future__ import annotations

import zlib
from dataclasses import replace

import numpy as np

from benchmarks.never_worse.case import Case
from gateway.frames import Status

LOST = 0.1
"""Of all samples."""
BURST_S = 0.04
"""Mean length of a loss; their lengths are drawn from an exponential distribution."""


def with_losses(case: Case, name: str) -> Case:
    """Return the case without the samples that a radio would have lost; the same ones for the same name."""
    rng = np.random.default_rng(zlib.crc32(name.encode()))
    ends = min(case.interval_s / BURST_S, 1.0)
    begins = ends * LOST / (1.0 - LOST)
    is_lost, frames = np.zeros(len(case.frames[0].status), bool), []
    for frame in case.frames:
        drawn = rng.random(len(is_lost))
        is_lost = np.where(is_lost, drawn > ends, drawn < begins)
        values = {
            sensor: np.where(is_lost[:, np.newaxis], np.nan, getattr(frame, sensor))
            for sensor in ("specific_force", "angular_rate", "magnetic_field")
        }
        status = np.where(is_lost, Status.MISSING.value, frame.status).astype(np.uint8)
        frames.append(replace(frame, status=status, **values))
    return replace(case, name=name, kind="lossy", frames=frames)
