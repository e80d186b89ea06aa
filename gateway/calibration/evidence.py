"""What was recorded while the wearer went through the steps, evenly sampled, with tilts and headings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from devices.deferred import Rotation, offlineVQF
from gateway.body.skeleton import WornSuit
from gateway.frames import FloatArray, ImuFrame, Status

BoolArray = NDArray[np.bool_]
Span = tuple[int, int]
"""First and last instant of a step, gateway time, ns."""

_BRIDGED = 4  # intervals: a longer gap counts as not heard
_FEWEST = 0.8  # share of instants at which a module must have been heard
_AVERAGED = 15  # instants, of a field strength


@dataclass(frozen=True, eq=False)
class EvenSamples:
    """All modules on one even grid of T instants, sensor axes."""

    time_ns: FloatArray  # (T,) gateway time
    interval_s: float
    specific_force: FloatArray  # (T, M, 3) m/s²; 0 where not heard
    angular_rate: FloatArray  # (T, M, 3) rad/s, without the gyroscopes' biases
    magnetic_field: FloatArray  # (T, M, 3) µT, NaN where there is none
    has_sample: BoolArray  # (T, M)
    R_es: FloatArray  # (T, M, 3, 3) sensor axes to a level world of the module's own heading

    def rows(self, span: Span) -> slice:
        """Return the instants of a step."""
        return slice(*np.searchsorted(self.time_ns, [span[0], span[1] + 1]).tolist())

    def is_received(self, module: int, span: Span) -> bool:
        """Return whether the module was heard through nearly all of a step."""
        has_sample = self.has_sample[self.rows(span), module]
        return bool(len(has_sample)) and float(has_sample.mean()) >= _FEWEST


def even_samples(frames: Sequence[ImuFrame], suit: WornSuit) -> EvenSamples:
    """Resample frames evenly, with orientations. Raises ``ValueError`` for less than a second of them."""
    times = np.array([frame.time_ns for frame in frames], dtype=np.float64)
    if len(frames) < 20 or times[-1] - times[0] < 1e9:
        raise ValueError("nothing was recorded yet: do the steps first")
    interval_ns = float(np.median(np.diff(times)))
    grid = np.arange(times[0], times[-1], interval_ns)
    n = len(suit.module_ids)
    force, rate, field = (
        np.stack([getattr(frame, name) for frame in frames])
        for name in ("specific_force", "angular_rate", "magnetic_field")
    )
    # Values that were held or predicted are no measurements.
    is_new = np.stack([frame.status <= Status.INTERPOLATED for frame in frames])
    known = np.isfinite(force).all(axis=2) & np.isfinite(rate).all(axis=2) & is_new
    even_force, even_rate = (np.zeros((len(grid), n, 3)) for _ in range(2))
    even_field = np.full((len(grid), n, 3), np.nan)
    has_sample = np.zeros((len(grid), n), dtype=bool)
    R_es = np.full((len(grid), n, 3, 3), np.nan)
    for m in range(n):
        rows = known[:, m]
        # So few samples are a module that has just been switched on.
        if rows.sum() < 20:
            continue
        has_sample[:, m] = _near(grid, times[rows], _BRIDGED * interval_ns)
        even_force[:, m] = _evenly(grid, times[rows], force[rows, m])
        even_rate[:, m] = _evenly(grid, times[rows], rate[rows, m])
        with_field = rows & np.isfinite(field[:, m]).all(axis=1)
        if with_field.sum() > 20:
            even_field[:, m] = _evenly(grid, times[with_field], field[with_field, m])
        solved = offlineVQF(even_rate[:, m].copy(), even_force[:, m].copy(), None, interval_ns * 1e-9)
        # The bias found over the whole recording is better than any that was known before.
        even_rate[:, m] -= solved["bias"]
        R_es[:, m] = Rotation.from_quat(solved["quat6D"], scalar_first=True).as_matrix()
    return EvenSamples(grid, interval_ns * 1e-9, even_force, even_rate, even_field, has_sample, R_es)


def _evenly(grid: FloatArray, times: FloatArray, values: FloatArray) -> FloatArray:
    return np.stack([np.interp(grid, times, column) for column in values.T], axis=1)


def _near(grid: FloatArray, times: FloatArray, longest: float) -> BoolArray:
    after = np.clip(np.searchsorted(times, grid), 1, len(times) - 1)
    near: BoolArray = np.minimum(np.abs(times[after] - grid), np.abs(grid - times[after - 1])) <= longest
    return near


@dataclass(frozen=True, eq=False)
class HeldPose:
    """One module during one pose."""

    R_es: FloatArray
    """(3, 3) its mean orientation against a level world of its own heading."""
    moved_rad: float
    """Farthest it turned from there."""
    shaken: float
    """Standard deviation of the specific force, m/s²."""


def pose_of(readings: EvenSamples, module: int, span: Span) -> HeldPose | None:
    """Return None when the module was not heard."""
    if not readings.is_received(module, span):
        return None
    rows = readings.rows(span)
    rotations = Rotation.from_matrix(readings.R_es[rows, module])
    mean = rotations.mean()
    moved = (mean.inv() * rotations).magnitude()
    shaken = float(readings.specific_force[rows, module].std(axis=0).max())
    return HeldPose(mean.as_matrix(), float(moved.max()), shaken)


@dataclass(frozen=True, eq=False)
class FieldHeading:
    """What the field says of a module's heading."""

    heading: float
    """Of the module's own level world against the world, rad, anticlockwise."""
    change: float
    """Largest departure of the field's strength from its median, relative, after smoothing."""


def field_heading(
    readings: EvenSamples,
    module: int,
    poses: Sequence[Span],
    field: FloatArray,
    others: Sequence[Span] = (),
) -> FieldHeading | None:
    """Return heading from the poses, changes from the other steps too. None without a magnetometer.

    field: (3,) that of the earth, world.
    """
    spans = [*poses, *others]
    rows = np.concatenate([np.arange(*readings.rows(span).indices(len(readings.time_ns))) for span in spans])
    magnetic = readings.magnetic_field[rows, module]
    known = np.isfinite(magnetic).all(axis=1) & readings.has_sample[rows, module]
    if known.sum() < 20:
        return None

    level = np.einsum("tij,tj->ti", readings.R_es[rows[known], module], magnetic[known])
    in_pose = rows[known] < 0
    for span in poses:
        in_pose |= (readings.time_ns[rows[known]] >= span[0]) & (readings.time_ns[rows[known]] <= span[1])
    # Steps were done without a pose: then no heading is known for certain.
    if not in_pose.any():
        return None

    turn = np.arctan2(field[1], field[0]) - np.arctan2(level[in_pose, 1], level[in_pose, 0])
    heading = float(np.angle(np.mean(np.exp(1j * turn))))
    # A running mean: single readings are too noisy to judge the field by.
    strength = _running(np.linalg.norm(magnetic[known], axis=1))
    return FieldHeading(
        heading,
        float(np.abs(strength / np.median(strength) - 1.0).max()),
    )


def _running(values: FloatArray) -> FloatArray:
    """Return means over ``_AVERAGED`` successive values, or all where there are fewer."""
    n = min(_AVERAGED, len(values))
    mean: FloatArray = np.convolve(values, np.full(n, 1.0 / n), "valid")
    return mean
