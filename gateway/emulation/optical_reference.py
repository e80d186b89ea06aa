"""What an optical reference itself is worth: its lag behind the modules, and how far gyroscopes disagree.

Neither needs an estimator: the turn that the reference shows from one of its instants to the next is compared
with the gyroscopes summed over the same time.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from devices.deferred import CubicSpline, Rotation
from devices.recorded_tracks import ModuleTrack, RecordedTracks, ReferenceTrack
from gateway.emulation.recordings import reference_at
from gateway.frames import FloatArray
from gateway.geometry.comparison import orientation_error, rmse_deg

LONGEST_LAG_S = 0.05
LAG_STEP_S = 0.001
TURN_S = 0.03
"""Over which turns are compared: short against a motion, long against a frame."""
LARGEST_DISAGREEMENT = 1.0
"""rad/s: beyond it the reference has jumped, and further does not count."""
WINDOW_S = 2.0


class _Turns(NamedTuple):
    """Mean speeds of a segment between pairs of instants of its reference."""

    from_s: FloatArray  # (N,)
    to_s: FloatArray  # (N,)
    speed: FloatArray  # (N,) rad/s
    gyroscopes: CubicSpline
    """Of the summed rates, (3,) rad against s."""


def in_time(recording: RecordedTracks, from_s: float = 0.0) -> tuple[RecordedTracks, float]:
    """Return the recording with its references moved in time onto its modules, and by how much later they
    were, s.

    One constant for all segments, from rates alone: the same whatever is then scored against them.
    """
    pairs = [(m, r) for m in recording.modules for r in recording.references if m.name == r.name]
    turns = [_turns(module, reference, from_s) for module, reference in pairs]
    lags = np.arange(-LONGEST_LAG_S, LONGEST_LAG_S + 0.5 * LAG_STEP_S, LAG_STEP_S)
    lag = float(lags[np.argmin([sum(_disagreement(t, lag) for t in turns) for lag in lags])])
    moved = tuple(replace(track, times=track.times - lag) for track in recording.references)
    return replace(recording, references=moved), lag


def _turns(module: ModuleTrack, reference: ReferenceTrack, from_s: float) -> _Turns:
    known = np.isfinite(reference.q_wb).all(axis=1) & (reference.times >= from_s)
    times, q = reference.times[known], Rotation.from_quat(reference.q_wb[known], scalar_first=True)
    steps = max(1, round(TURN_S / float(np.median(np.diff(times)))))
    first = np.flatnonzero(times[steps:] - times[:-steps] < 2.0 * TURN_S)
    span = times[first + steps] - times[first]
    speed = (q[first].inv() * q[first + steps]).magnitude() / span
    return _Turns(times[first], times[first + steps], speed, CubicSpline(*_summed(module)))


def _summed(module: ModuleTrack) -> tuple[FloatArray, FloatArray]:
    """Return times (T,) and rates summed up to them, (T, 3) rad; trapezoidal."""
    finite = np.isfinite(module.angular_rate).all(axis=1)
    times, rate = module.times[finite], module.angular_rate[finite]
    steps = 0.5 * (rate[1:] + rate[:-1]) * np.diff(times)[:, None]
    return times, np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])


def _disagreement(turns: _Turns, lag_s: float) -> float:
    """Return mean square of the difference of speeds, (rad/s)², if the reference is so late."""
    turn = turns.gyroscopes(turns.to_s - lag_s) - turns.gyroscopes(turns.from_s - lag_s)
    difference = np.linalg.norm(turn, axis=1) / (turns.to_s - turns.from_s) - turns.speed
    return float(np.mean(np.minimum(difference**2, LARGEST_DISAGREEMENT**2)))


def gyroscope_disagreement(recording: RecordedTracks, from_s: float = 0.0) -> tuple[FloatArray, FloatArray]:
    """Return the RMSE of gyroscopes alone, two seconds at a time, °: total and tilt by segment, (S,) each.

    The gyroscopes begin every window with the constant turn that suits it best and have one bias and one
    3 × 3 matrix of scale and axes for the whole recording that suit it best: no estimator has these.
    """
    errors = []
    for reference in recording.references:
        module = next(track for track in recording.modules if track.name == reference.name)
        errors.append(_window_errors(module, reference, from_s))
    total, tilt = (np.array(column) for column in zip(*errors, strict=True))
    return total, tilt


def _window_errors(module: ModuleTrack, reference: ReferenceTrack, from_s: float) -> tuple[float, float]:
    times, _ = _summed(module)
    q_ref = reference_at(times, reference)
    finite = np.isfinite(module.angular_rate).all(axis=1)
    rates = _fitted_rates(times, module.angular_rate[finite], q_ref)
    length = round(WINDOW_S / float(np.median(np.diff(times))))
    total, tilt = [], []
    for begin in range(int(np.searchsorted(times, from_s)), len(times) - length, length):
        wanted = q_ref[begin : begin + length]
        known = np.asarray(np.isfinite(wanted).all(axis=1))
        if known.mean() < 0.5:
            continue
        R = _integrated(times[begin : begin + length], rates[begin : begin + length])[known]
        optical = Rotation.from_quat(wanted[known], scalar_first=True)
        # world and body turns: the gyroscopes' own world is the module's first orientation
        R = (optical * R.inv()).mean() * R
        error = orientation_error(R.as_quat(scalar_first=True), wanted[known])
        total.append(error.total)
        tilt.append(error.inclination)
    return float(rmse_deg(np.concatenate(total))), float(rmse_deg(np.concatenate(tilt)))


def _fitted_rates(times: FloatArray, rates: FloatArray, q_ref: FloatArray) -> FloatArray:
    """Return (T, 3): the rates through the affine map that brings their means to the optical ones."""
    known = np.asarray(np.isfinite(q_ref).all(axis=1))
    both = known[:-1] & known[1:]
    q = Rotation.from_quat(np.where(known[:, None], q_ref, [1.0, 0.0, 0.0, 0.0]), scalar_first=True)
    optical = (q[:-1].inv() * q[1:]).as_rotvec()[both] / np.diff(times)[both, None]
    means = np.column_stack([0.5 * (rates[1:] + rates[:-1]), np.ones(len(both))])[both]
    weights = np.ones(len(means))
    for _ in range(5):  # least absolute residuals: the reference jumps
        affine = np.linalg.lstsq(means * weights[:, None], optical * weights[:, None], rcond=None)[0]
        residual = np.linalg.norm(optical - means @ affine, axis=1)
        weights = 1.0 / np.sqrt(np.maximum(residual, 0.01))
    fitted: FloatArray = np.column_stack([rates, np.ones(len(rates))]) @ affine
    return fitted


def _integrated(times: FloatArray, rates: FloatArray) -> Rotation:
    """Return orientations against the first, body to first."""
    steps = Rotation.from_rotvec(0.5 * (rates[1:] + rates[:-1]) * np.diff(times)[:, None])
    R = [Rotation.identity()]
    for step in steps:
        R.append(R[-1] * step)
    return Rotation.concatenate(R)
