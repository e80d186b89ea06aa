"""Force plates: which foot stands on which, when, and what the floor does to it."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from devices.marker_files.force_plates import ForcePlate, ForcePlates
from gateway.analysis.floor import (
    LEAST_FORCE_N,
    FloorForces,
    ForceSource,
    feet,
    sole_paths,
    sole_points,
)
from gateway.analysis.inverse_dynamics import Dynamics
from gateway.analysis.smooth_motion import SmoothMotion, low_pass
from gateway.frames import FloatArray, IntArray
from gateway.reconstruction.optical.landmarks import to_world

LEVEL_M = 0.05
"""Plates whose heights differ by more are steps of a stair."""
_EMPTY_N = 60.0
"""What a plate shows of noise and offset is smaller."""
_SHORTEST_STEP_S = 0.1
"""What loads a plate for less is not a step."""
_FARTHEST_FOOT_M = 0.35
"""From the centre of pressure to the middle of the sole; beyond it the load is nobody's (a cane, a cart)."""

_MARGIN_M = 0.01
_DOWN_M = 0.03
_LONG_SHARE = 0.1
"""A point of the sole that is lower than the second counts as down, and beside the plate if it is farther out
than the first in more than the third of a step's frames."""


class _Soles(NamedTuple):
    """Where the soles of C feet are; F frames, P points of all soles."""

    feet: IntArray  # (C,) segments
    carriers: IntArray  # (P,) the segment of each point
    paths: FloatArray  # (F, P, 3) m, world
    middles: FloatArray  # (F, C, 3) m, world: mean of a foot's points


class _Load(NamedTuple):
    """What one plate shows at F frames of the motion, world axes; 0 where it was not sampled."""

    force: FloatArray  # (F, 3) N, smooth
    moment: FloatArray  # (F, 3) N m about the world's origin, smooth
    up: FloatArray  # (F,) N, as measured
    pressure: FloatArray  # (F, 3) m, centre of pressure


class _Step(NamedTuple):
    """One load of a plate without interruption, in frames; ``end`` and ``last`` are past it."""

    begin: int
    end: int
    first: int  # of the time around it that is nearer to it than to any other
    last: int


def measured_floor(
    plates: ForcePlates, vertical: str, motion: SmoothMotion, free: Dynamics, cutoff_hz: float | None
) -> FloorForces:
    """Return forces of the feet from plates whose file has the given axis up, and counts time as the motion
    does.

    Frames at which the plates were not sampled have none.
    cutoff_hz: of a low-pass without lag; that of the motion keeps impacts of both in step (Kristianslund et
    al. 2012). None: as measured.
    """
    soles = _soles_of(motion, free)
    heights = [to_world(plate.centre[None], vertical)[0, 2] for plate in plates.plates]
    shape = len(motion.time_s), len(soles.feet)
    force, moment = np.zeros((2, *shape, 3))
    source = np.full(shape, ForceSource.NONE, dtype=np.uint8)
    height_m = np.full(shape, np.mean(heights))
    is_stair = np.ptp(heights) > LEVEL_M
    notes = list(_notes_on_all(plates, motion.time_s, is_stair=is_stair))
    for number, (plate, height) in enumerate(zip(plates.plates, heights, strict=True), 1):
        load = _load_of(_zeroed(plate, plates.rate_hz), plates, vertical, motion.time_s, cutoff_hz)
        corners = to_world(plate.corners, vertical)
        for step in _steps(load.up, motion.time_s):
            loaded, around = slice(step.begin, step.end), slice(step.first, step.last)
            span_s = motion.time_s[step.begin], motion.time_s[step.end - 1]
            c, away = _nearest_foot(load.pressure[loaded], soles.middles[loaded])
            if not away < _FARTHEST_FOOT_M:
                notes.append(_nobodys(number, *span_s, away))
                continue
            force[around, c] += load.force[around]
            moment[around, c] += load.moment[around]
            source[loaded, c] = ForceSource.MEASURED
            height_m[loaded, c] = height
            foot = soles.feet[c]
            if not is_stair and _is_beside(soles.paths[loaded, soles.carriers == foot], corners):
                notes.append(_partly_beside(motion.skeleton.segment_names[foot], number, *span_s))
    return FloorForces(soles.feet, force, moment, source, height_m, tuple(notes))


def _soles_of(motion: SmoothMotion, free: Dynamics) -> _Soles:
    on = feet(motion.skeleton)
    carriers, points = sole_points(motion.skeleton)
    paths = sole_paths(carriers, points, free.p_w, free.rotation_wb)
    middles = np.stack([paths[:, carriers == s].mean(axis=1) for s in on], axis=1)
    return _Soles(on, carriers, paths, middles)


def _load_of(
    plate: ForcePlate, plates: ForcePlates, vertical: str, time_s: FloatArray, cutoff_hz: float | None
) -> _Load:
    """Return what one of the plates shows at instants (F,) s; the nearest sample counts."""
    samples = np.round((time_s - plates.begins_s) * plates.rate_hz).astype(np.int64)
    is_sampled = (samples >= 0) & (samples < len(plate.force))
    at = samples.clip(0, len(plate.force) - 1)
    force, moment, pressure = _in_world(plate, vertical)
    smooth_force, smooth_moment = (
        low_pass(values, plates.rate_hz, cutoff_hz)[at] * is_sampled[:, None] for values in (force, moment)
    )
    return _Load(smooth_force, smooth_moment, force[at, 2] * is_sampled, pressure[at])


def _notes_on_all(plates: ForcePlates, time_s: FloatArray, *, is_stair: bool) -> Iterator[str]:
    """Yield what is to be known of all plates together, a sentence each."""
    if is_stair:
        yield "The plates are of different heights: where a foot is on none, no force of it is known."
    ends_s = plates.begins_s + len(plates.plates[0].force) / plates.rate_hz
    if time_s[0] > ends_s or time_s[-1] < plates.begins_s:
        yield (
            f"The plates were sampled from {plates.begins_s:.2f} to {ends_s:.2f} s, the motion from "
            f"{time_s[0]:.2f} to {time_s[-1]:.2f} s: no force of them is used."
        )


def _partly_beside(foot: str, number: int, begin_s: float, end_s: float) -> str:
    return (
        f"The {foot.replace('_', ' ')} stands partly beside plate {number} at {begin_s:.2f}–{end_s:.2f} s: "
        "its force is larger than measured."
    )


def _nobodys(number: int, begin_s: float, end_s: float, away_m: float) -> str:
    return (
        f"What loads plate {number} at {begin_s:.2f}–{end_s:.2f} s is {away_m:.2f} m from the next sole and "
        "counts as nobody's: a cane, a cart, another person, or a plate that is not where the file has it."
    )


def _zeroed(plate: ForcePlate, rate_hz: float) -> ForcePlate:
    """Return the plate less what it shows while empty; as it is if that is never for long."""
    is_empty = np.abs(plate.force).max(axis=1) < _EMPTY_N
    if is_empty.sum() < _SHORTEST_STEP_S * rate_hz:
        return plate
    force, moment = (np.median(values[is_empty], axis=0) for values in (plate.force, plate.moment))
    return replace(plate, force=plate.force - force, moment=plate.moment - moment)


def _in_world(plate: ForcePlate, vertical: str) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return force (N, 3) N, moment about the world's origin (N, 3) N m, centre of pressure (N, 3) m."""
    stacked = np.stack(
        [plate.force, plate.moment + np.cross(plate.centre, plate.force), plate.centre_of_pressure()], axis=1
    )
    turned = to_world(stacked, vertical)
    return turned[:, 0], turned[:, 1], turned[:, 2]


def _steps(up: FloatArray, time_s: FloatArray) -> Iterator[_Step]:
    """Yield each load of a plate that lasts long enough for a step. up: (F,) N."""
    loaded = np.concatenate([[False], up > LEAST_FORCE_N, [False]]).astype(np.int8)
    begins, ends = np.flatnonzero(np.diff(loaded) == 1), np.flatnonzero(np.diff(loaded) == -1)
    interval = (time_s[-1] - time_s[0]) / (len(time_s) - 1)
    long = (ends - begins) * interval >= _SHORTEST_STEP_S
    begins, ends = begins[long], ends[long]
    between = (ends[:-1] + begins[1:]) // 2
    edges: IntArray = np.concatenate([[0], between, [len(up)]])
    spans = zip(begins.tolist(), ends.tolist(), edges[:-1].tolist(), edges[1:].tolist(), strict=False)
    return itertools.starmap(_Step, spans)


def _is_beside(sole: FloatArray, corners: FloatArray) -> bool:
    """Return whether points of a sole (F, P, 3) that are down lie outside a plate (4, 3) for long."""
    middle = corners.mean(axis=0)
    outside = np.zeros(sole.shape[:2], dtype=bool)
    for side in (corners[0] - corners[1], corners[1] - corners[2]):
        half = 0.5 * np.linalg.norm(side)
        along = (sole - middle) @ (side / np.linalg.norm(side))
        outside |= np.abs(along) > half + _MARGIN_M
    down = sole[..., 2] - sole[..., 2].min() < _DOWN_M
    return float((outside & down).any(axis=1).mean()) > _LONG_SHARE


def _nearest_foot(pressure: FloatArray, middles: FloatArray) -> tuple[int, float]:
    """Return which foot's sole is nearest to the pressure over a step, and how far it is, m."""
    away = np.linalg.norm(pressure[:, None, :2] - middles[..., :2], axis=-1)
    mean = np.nanmean(away, axis=0)
    nearest = int(np.argmin(mean))
    return nearest, float(mean[nearest])
