"""How far one clock is from another, from the motion that both have seen.

How fast a segment turns does not depend on the world that it is seen in, nor on where its axes point: the
angular speeds of all segments, correlated, give the lag before anything else is known.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from devices.deferred import Rotation, correlate, gaussian_filter1d, theilslopes
from gateway.agreement.tracks import Tracks, resampled
from gateway.errors import GatewayError
from gateway.frames import FloatArray

RATE_HZ = 100.0
SMOOTHING_S = 0.02
"""1 σ of the smoothing of angular speeds, that of both sources."""
SHORTEST_OVERLAP_S = 2.0
OVERLAP_SHARE = 0.3
"""Of the shorter one: so much must lie within the other."""
WINDOW_S = 20.0
FEWEST_WINDOWS = 4
WINDOW_SEARCH_S = 0.25
_LARGEST_PERCENT = 98.0
_CLOSEST = 0.99
"""A correlation beyond it gives a segment no more say."""
_REFINED_S = 0.1
_LEAST_SPEED = 0.02  # rad/s RMS: below it nothing has moved


@dataclass(frozen=True)
class TimeAlignment:
    """``time of the second = time of the first + lag_s + drift · (time of the first − middle_s)``."""

    lag_s: float
    drift_ppm: float
    """0 where the overlap is too short to estimate it."""
    middle_s: float
    correlation: float
    """Of the angular speeds at that lag, −1 … 1."""

    def of_second(self, time_s: FloatArray) -> FloatArray:
        """Return instants (T,) of the first on the second's clock, s."""
        later: FloatArray = time_s + self.lag_s + self.drift_ppm * 1e-6 * (time_s - self.middle_s)
        return later


def align_time(first: Tracks, second: Tracks, largest_lag_s: float | None = None) -> TimeAlignment:
    """Return lag and drift between two tracks of the same segments in the same order.

    largest_lag_s: looked for within ± this; None: wherever the two overlap by enough.
    Raises ``GatewayError`` when they do not, or when one of them does not move.
    """
    speeds = [_angular_speeds(tracks) for tracks in (first, second)]
    for (_, speed), which in zip(speeds, ("first", "second"), strict=True):
        if not np.nanmax(np.append(speed, 0.0)) > _LEAST_SPEED:
            raise GatewayError(f"nothing moves in the {which}: clocks cannot be aligned by motion")
    (start_a, a), (start_b, b) = speeds
    a, b = _without_excess(a, b)
    lags, score = _correlation(a, b)
    lag_s = lags / RATE_HZ + start_b - start_a
    allowed = np.isfinite(score)
    if largest_lag_s is not None:
        allowed &= np.abs(lag_s) <= largest_lag_s
    if not allowed.any():
        raise GatewayError("the two have too little time in common to be aligned")
    best = int(np.argmax(np.where(allowed, score, -np.inf)))
    a, b = _by_agreement(a, b, int(lags[best]))
    lag = float(lag_s[0] + _refined(_correlation(a, b)[1], allowed, best) / RATE_HZ)
    middle, drift = _drift(start_a, a, start_b, b, lag)
    if drift is None:
        return TimeAlignment(lag, 0.0, middle, float(score[best]))
    return TimeAlignment(drift[1], drift[0] * 1e6, middle, float(score[best]))


def _angular_speeds(tracks: Tracks) -> tuple[float, FloatArray]:
    """Return the instant of the first, and (T, S) rad/s at ``RATE_HZ``; NaN where not known."""
    time_s = np.arange(tracks.time_s[0], tracks.time_s[-1], 1.0 / RATE_HZ)
    q = resampled(tracks, time_s).q_wb
    speed = np.full(q.shape[:2], np.nan)
    for s in range(q.shape[1]):
        known = np.isfinite(q[:, s]).all(axis=1).reshape(-1)
        # A speed wants both neighbours.
        both = np.flatnonzero(known[:-1] & known[1:])
        if len(both):
            rotation = Rotation.from_quat(
                # SciPy refuses rows without a norm, so they stand as no turn and are not read.
                np.where(known[:, None], q[:, s], [1.0, 0, 0, 0]),
                scalar_first=True,
            )
            speed[both, s] = (rotation[both].inv() * rotation[both + 1]).magnitude() * RATE_HZ
    return float(time_s[0]) + 0.5 / RATE_HZ, _smoothed(speed)


def _without_excess(a: FloatArray, b: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return angular speeds (T, S) of both, none beyond what the quieter one of a segment has, and as much
    again.

    A segment that one of the two does not know well (a hand with one marker) may turn about in it at any
    speed, and would have all the say.
    """
    a, b = a.copy(), b.copy()
    for one, other in zip(a.T, b.T, strict=True):
        known = [values[np.isfinite(values)] for values in (one, other)]
        if all(len(values) for values in known):
            most = 2.0 * min(float(np.percentile(values, _LARGEST_PERCENT)) for values in known)
            np.minimum(one, most, out=one)
            np.minimum(other, most, out=other)
    return a, b


def _by_agreement(a: FloatArray, b: FloatArray, shift: int) -> tuple[FloatArray, FloatArray]:
    """Return angular speeds (T, S) of both, each segment weighted by how well the two agree on it where
    b is ``shift`` samples later: r² / (1 − r²), as its own lag is known.

    A few segments that one of the two hardly knows would otherwise move the lag of all by milliseconds.
    """
    begin, end = max(0, -shift), min(len(a), len(b) - shift)
    x, y = a[begin:end], b[begin + shift : end + shift]
    weights, spreads = np.zeros(a.shape[1]), np.ones((2, a.shape[1]))
    for s in range(a.shape[1]):
        known = np.isfinite(x[:, s]) & np.isfinite(y[:, s])
        if known.any():
            spreads[:, s] = np.std(x[known, s]), np.std(y[known, s])
            covariance = np.mean((x[known, s] - x[known, s].mean()) * (y[known, s] - y[known, s].mean()))
            r = covariance / max(float(np.prod(spreads[:, s])), 1e-12)
            weights[s] = r * r / (1.0 - min(r, _CLOSEST) ** 2) if r > 0.0 else 0.0
    if not weights.any():
        return a, b
    scales = np.sqrt(weights) / np.maximum(spreads, 1e-9)
    return a * scales[0], b * scales[1]


def _refined(score: FloatArray, allowed: NDArray[np.bool_], best: int) -> float:
    """Return index of the highest top near ``best``, between samples."""
    reach = round(_REFINED_S * RATE_HZ)
    near = np.abs(np.arange(len(score)) - best) <= reach
    usable = near & allowed & np.isfinite(score)
    if not usable.any():
        return float(best)
    top = int(np.argmax(np.where(usable, score, -np.inf)))
    return top + _vertex(score, top)


def _smoothed(speed: FloatArray) -> FloatArray:
    known = np.isfinite(speed)
    sigma = SMOOTHING_S * RATE_HZ
    weight = gaussian_filter1d(known.astype(float), sigma, axis=0, mode="constant")
    smooth = gaussian_filter1d(np.where(known, speed, 0.0), sigma, axis=0, mode="constant")
    result: FloatArray = np.where(known, smooth / np.maximum(weight, 1e-9), np.nan)
    return result


def _correlation(a: FloatArray, b: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return lags (samples; b later) and the normalised correlation over all segments, without unknown
    values.
    """
    n_a, n_b = len(a), len(b)
    product, power_a, power_b = (np.zeros(n_a + n_b - 1) for _ in range(3))
    # In a pause of one of them nothing overlaps.
    seen_a, seen_b = (np.isfinite(each).any(axis=1).astype(float) for each in (a, b))
    overlap = correlate(seen_b, seen_a)
    for one, other in zip(a.T, b.T, strict=True):
        known_a, known_b = np.isfinite(one), np.isfinite(other)
        # A pair of signals counts at a lag only where both are known: power is summed over the same samples.
        if not (known_a.any() and known_b.any()):
            continue
        x = np.where(known_a, one - one[known_a].mean(), 0.0)
        y = np.where(known_b, other - other[known_b].mean(), 0.0)
        product += correlate(y, x)
        power_a += correlate(known_b.astype(float), x * x)
        power_b += correlate(y * y, known_a.astype(float))
    shorter = min(seen_a.sum(), seen_b.sum())
    least = min(max(SHORTEST_OVERLAP_S * RATE_HZ, OVERLAP_SHARE * shorter), shorter)
    power = np.sqrt(np.maximum(power_a, 0.0) * np.maximum(power_b, 0.0))
    strongest = float(power.max())
    # Near the ends few samples overlap, and any two short pieces correlate well by chance.
    usable = (overlap >= least - 0.5) & (power > 1e-3 * strongest) & (strongest > 0.0)
    score = np.full(len(product), np.nan)
    score[usable] = product[usable] / power[usable]
    return np.arange(len(product), dtype=np.float64) - (n_a - 1.0), score


def _vertex(score: FloatArray, best: int) -> float:
    """Return where the parabola through the largest value and its neighbours has its top, −0.5 … 0.5."""
    if not 0 < best < len(score) - 1:
        return 0.0
    left, middle, right = score[best - 1 : best + 2]
    curvature = left - 2.0 * middle + right
    if not curvature < 0.0:
        return 0.0
    return float(np.clip(0.5 * (left - right) / curvature, -0.5, 0.5))


def _drift(
    start_a: float, a: FloatArray, start_b: float, b: FloatArray, lag: float
) -> tuple[float, tuple[float, float] | None]:
    """Return the middle of the overlap; rate and lag there from the lags of windows (Theil–Sen), None: too
    short."""
    begin = max(start_a, start_b - lag)
    end = min(start_a + len(a) / RATE_HZ, start_b - lag + len(b) / RATE_HZ)
    middle = 0.5 * (begin + end)
    windows = int((end - begin) / WINDOW_S)
    if windows < FEWEST_WINDOWS:
        return middle, None
    found = []
    reach = round(WINDOW_SEARCH_S * RATE_HZ)
    for k in range(windows):
        i = round((begin - start_a + k * WINDOW_S) * RATE_HZ)
        piece = a[i : i + round(WINDOW_S * RATE_HZ)]
        j = round((start_a + i / RATE_HZ + lag - start_b) * RATE_HZ)
        low = max(j - reach, 0)
        lags, score = _correlation(piece, b[low : j + len(piece) + reach])
        if not np.isfinite(score).any():
            continue
        best = int(np.nanargmax(score))
        shift = (lags[best] + _vertex(score, best) + low - i) / RATE_HZ + start_b - start_a
        found.append((begin + (k + 0.5) * WINDOW_S, shift, score[best]))
    good = [(t, shift) for t, shift, quality in found if quality > 0.5]
    if len(good) < FEWEST_WINDOWS:
        return middle, None
    times, shifts = np.array(good).T
    fitted = theilslopes(shifts, times - middle)
    return middle, (float(fitted.slope), float(fitted.intercept))
