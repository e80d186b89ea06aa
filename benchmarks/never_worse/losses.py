"""Recordings of poorer modules, the same ones for the same name: with losses, full of noise, or knocked."""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from benchmarks.never_worse.case import Case
from gateway.frames import ImuFrame, Status

LOST = 0.1
"""Of all samples, by a radio that loses them in bursts."""
BURST_S = 0.04
"""Mean length of a loss; their lengths are drawn from an exponential distribution."""
SILENCES_S = (0.05, 0.8)
"""Shortest and longest silence of a module in motion; their lengths are drawn evenly."""
BETWEEN_S = 10.0
"""Mean time in motion from one silence to the next, drawn from an exponential distribution."""
IN_MOTION = 1.0
"""rad/s: a module that turns more slowly does not fall silent, since nothing is lost by that."""

NOISE = {"angular_rate": 0.03, "specific_force": 0.3, "magnetic_field": 1.5}
"""Of cheap sensors, or of a filter left open: standard deviation of a sample, rad/s, m/s² and µT."""

KNOCKS_EVERY_S = 1.0
"""Mean time from one knock at a module to the next, drawn from an exponential distribution."""
KNOCK = {"angular_rate": 1.0, "specific_force": 40.0}
"""What a knock adds at once, in a direction of its own for each sensor, rad/s and m/s²."""
KNOCK_HZ, KNOCK_FADES_S = 25.0, 0.02
"""How what is knocked rings, and for how long."""


def with_knocks(case: Case, name: str) -> Case:
    """Return the case with modules that are knocked at from when the motion begins, each on its own."""
    rng, T, shape = _drawing(name), len(case.frames), case.frames[0].specific_force.shape
    age_s = np.arange(0.0, 5.0 * KNOCK_FADES_S, case.interval_s)
    ringing = np.exp(-age_s / KNOCK_FADES_S) * np.cos(2.0 * np.pi * KNOCK_HZ * age_s)
    knocks = rng.random((T, shape[0], 1)) < case.interval_s / KNOCKS_EVERY_S
    knocks &= (case.times_s >= case.moves_from_s)[:, np.newaxis, np.newaxis]
    added = {}
    for sensor, size in KNOCK.items():
        blows = rng.standard_normal((T, *shape))
        blows *= knocks * size / np.linalg.norm(blows, axis=2, keepdims=True)
        added[sensor] = np.apply_along_axis(lambda each: np.convolve(each, ringing)[:T], 0, blows)
    frames = [
        replace(frame, **{sensor: getattr(frame, sensor) + felt[k] for sensor, felt in added.items()})
        for k, frame in enumerate(case.frames)
    ]
    return replace(case, name=name, kind="knocked", frames=frames)


def with_noise(case: Case, name: str) -> Case:
    """Return the case as measured by sensors that are full of noise."""
    rng = _drawing(name)

    def noisy(frame: ImuFrame) -> ImuFrame:
        values = {sensor: getattr(frame, sensor) for sensor in NOISE}
        return replace(
            frame, **{sensor: v + rng.normal(0.0, NOISE[sensor], v.shape) for sensor, v in values.items()}
        )

    return replace(case, name=name, kind="noisy", frames=[noisy(frame) for frame in case.frames])


def with_losses(case: Case, name: str) -> Case:
    """Return the case without the samples that a radio would have lost."""
    ends = min(case.interval_s / BURST_S, 1.0)
    begins = ends * LOST / (1.0 - LOST)
    rng = _drawing(name)

    def lost() -> Iterator[NDArray[np.bool_]]:
        is_lost = np.zeros(len(case.frames[0].status), bool)
        for _ in case.frames:
            drawn = rng.random(len(is_lost))
            is_lost = np.where(is_lost, drawn > ends, drawn < begins)
            yield is_lost

    return _without(case, name, "lossy", lost())


def with_silences(case: Case, name: str) -> Case:
    """Return the case with modules that fall silent for a while in the middle of a motion."""
    rng = _drawing(name)
    begins = min(case.interval_s / BETWEEN_S, 1.0)

    def lost() -> Iterator[NDArray[np.bool_]]:
        left_s = np.zeros(len(case.frames[0].status))
        for frame in case.frames:
            n = len(left_s)
            begin, length_s = rng.random(n) < begins, rng.uniform(*SILENCES_S, n)
            turns = np.linalg.norm(frame.angular_rate, axis=1) > IN_MOTION
            left_s = np.where(left_s > 0.0, left_s - case.interval_s, np.where(begin & turns, length_s, 0.0))
            yield left_s > 0.0

    return _without(case, name, "silent", lost())


def _drawing(name: str) -> Generator:
    return np.random.default_rng(zlib.crc32(name.encode()))


def _without(case: Case, name: str, kind: str, lost: Iterator[NDArray[np.bool_]]) -> Case:
    """Return the case without the samples of modules that are lost at each frame."""
    frames = [_frame_without(frame, each) for frame, each in zip(case.frames, lost, strict=True)]
    return replace(case, name=name, kind=kind, frames=frames)


def _frame_without(frame: ImuFrame, is_lost: NDArray[np.bool_]) -> ImuFrame:
    values = {
        sensor: np.where(is_lost[:, np.newaxis], np.nan, getattr(frame, sensor))
        for sensor in ("specific_force", "angular_rate", "magnetic_field")
    }
    status = np.where(is_lost, Status.MISSING.value, frame.status).astype(np.uint8)
    return replace(frame, status=status, **values)
