"""Poses extrapolated a few milliseconds ahead, for consumers that show them later than they were measured.

The rotation over the horizon h comes from the angular rate ω and its change α, which is taken to fade with
the time constant T::

    φ = ω h + α T² (h/T − 1 + exp(−h/T))        q(t + h) = q(t) ⊗ exp(φ)

How far such predictions were off lately is measured: each pose is compared with what was predicted for it.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from devices.link import gateway_time_ns
from gateway.body.kinematics import joint_positions
from gateway.body.skeleton import Skeleton
from gateway.frames import FloatArray, SkeletonFrame, Status, StatusArray
from gateway.geometry import quaternion
from gateway.geometry.compiled import compiled
from gateway.outputs.settings import LONGEST_HORIZON_MS, MqttSettings

CHANGE_OVER_S = 0.01
"""The change of the angular rate is taken over so long, s, or from the frame before where that is longer ago.
Of 10, 20 and 30 ms the best on every recording that it was chosen on; see ``benchmarks.prediction``."""
CHANGE_FADES_S = 0.02
"""T, s. With 15 and 30 ms errors are within 5 % of these; a change that goes on for all of 50 ms makes
predictions worse than no change at all."""
ERRORS_KEPT_S = 0.3
"""Time constant of the mean square of errors, s."""
_BROKEN_S = 0.25
"""After a longer gap nothing of the motion before it is used."""

_MOVED_ON = (Status.MEASURED, Status.INTERPOLATED, Status.PREDICTED, Status.UNAIDED, Status.DOUBTFUL)
"""What is extrapolated. The others say that the orientation is none of this instant to begin with."""
_IS_MOVED_ON = np.isin(np.arange(len(Status)), _MOVED_ON)
_AS_PREDICTED = np.array(
    [Status.PREDICTED if s in (Status.MEASURED, Status.INTERPOLATED) else s for s in Status], np.uint8
)
"""What says more of a value than that it was predicted stays."""


class Prediction(NamedTuple):
    """A pose of an instant at which nothing was measured yet."""

    frame: SkeletonFrame
    """``time_ns`` is the instant that it was predicted for."""
    measured_ns: int
    """Gateway time of the pose that it was extrapolated from."""


@dataclass(frozen=True, slots=True)
class _Moment:
    """What is needed to extrapolate from one frame."""

    time_ns: int
    q_wb: FloatArray  # (S, 4)
    rate: FloatArray  # (S, 3) rad/s
    change: FloatArray  # (S, 3) rad/s²

    def turned(self, ahead_s: float) -> FloatArray:
        """Return ``q_wb`` (S, 4) so much later."""
        return _turned(self.q_wb, self.rate, self.change, ahead_s)


def predictor_of(settings: MqttSettings, skeleton: Skeleton) -> PosePredictor | None:
    """Return what the settings ask for; None: they do not."""
    if settings.predict_ms is None:
        return None
    ahead_s = None if settings.predict_ms == "publishing" else settings.predict_ms * 1e-3
    return PosePredictor(skeleton, ahead_s)


class PosePredictor:
    """Predicts the poses of one skeleton, given one frame after the other."""

    def __init__(
        self,
        skeleton: Skeleton,
        ahead_s: float | None,
        clock_ns: Callable[[], int] = gateway_time_ns,
    ) -> None:
        """ahead_s: how far; None: to the instant at which ``predict`` is called, by ``clock_ns``."""
        self._skeleton = skeleton
        self._ahead_s = ahead_s
        self._clock_ns = clock_ns
        self._parents = skeleton.parents.tolist()
        self._moments: deque[_Moment] = deque()
        self._squares = np.zeros(skeleton.n_segments)  # rad², of errors lately
        self._last: SkeletonFrame | None = None
        self._compile()

    def predict(self, frame: SkeletonFrame) -> Prediction:
        """Return where the body will be. Raises ``ValueError`` for a frame of another skeleton."""
        if len(frame.status) != self._skeleton.n_segments:
            raise ValueError(
                f"a frame of {len(frame.status)} segments, where the skeleton has {self._skeleton.n_segments}"
            )
        ahead_s = self._ahead_s
        if ahead_s is None:
            ahead_s = min(max((self._clock_ns() - frame.time_ns) * 1e-9, 0.0), LONGEST_HORIZON_MS * 1e-3)
        last = self._last
        if last is not None and not 0 < frame.time_ns - last.time_ns < _BROKEN_S * 1e9:
            self._forget()
            last = None
        moment = self._moment_of(frame)
        self._check(moment, ahead_s)
        self._moments.append(moment)
        self._last = frame
        return Prediction(self._frame_of(frame, last, moment, ahead_s), frame.time_ns)

    def _compile(self) -> None:
        """Call every kernel once: not when the first pose waits for it."""
        n = self._skeleton.n_segments
        neutral, none = np.tile(self._skeleton.neutral, (n, 1)), np.zeros((n, 3))
        joint_positions(self._skeleton.parents, self._skeleton.offsets, neutral, np.zeros(3))
        _note_errors(self._squares, _turned(neutral, none, none, 0.0), neutral, 1.0, 0.0)
        quaternion.canonical(quaternion.multiply(neutral[0], quaternion.conjugate(neutral[0])))

    def _forget(self) -> None:
        self._moments.clear()
        self._squares[:] = 0.0

    def _moment_of(self, frame: SkeletonFrame) -> _Moment:
        """Return rate and change of all segments; what does not move on has a rate of zero."""
        is_moved = _IS_MOVED_ON[frame.status]
        rate = np.where(is_moved[:, None], frame.angular_rate, 0.0)
        change = np.zeros_like(rate)
        before = None
        for moment in reversed(self._moments):
            if before is None or frame.time_ns - moment.time_ns <= CHANGE_OVER_S * 1e9 + 1e6:
                before = moment
        if before is not None:
            change = (rate - before.rate) / ((frame.time_ns - before.time_ns) * 1e-9)
            change[~np.isfinite(change)] = 0.0
        return _Moment(frame.time_ns, frame.q_wb, rate, change)

    def _check(self, now: _Moment, ahead_s: float) -> None:
        """Compare what has come with what was predicted for it from about ``ahead_s`` ago."""
        moments, ahead_ns = self._moments, ahead_s * 1e9
        while len(moments) > 1 and now.time_ns - moments[1].time_ns >= max(ahead_ns, CHANGE_OVER_S * 1e9):
            moments.popleft()
        if not moments:
            return
        origin = moments[0]
        for moment in moments:
            if now.time_ns - moment.time_ns >= ahead_ns:
                origin = moment
        lag_s = (now.time_ns - origin.time_ns) * 1e-9
        since_s = (now.time_ns - moments[-1].time_ns) * 1e-9
        share = -math.expm1(-since_s / ERRORS_KEPT_S)
        _note_errors(self._squares, origin.turned(lag_s), now.q_wb, ahead_s / lag_s, share)

    def _frame_of(
        self, frame: SkeletonFrame, last: SkeletonFrame | None, moment: _Moment, ahead_s: float
    ) -> SkeletonFrame:
        q_wb, status = moment.turned(ahead_s), _AS_PREDICTED[frame.status]
        self._follow_parents(frame, q_wb, status)
        change_s = CHANGE_FADES_S * -math.expm1(-ahead_s / CHANGE_FADES_S)
        return replace(
            frame,
            time_ns=frame.time_ns + round(ahead_s * 1e9),
            q_wb=q_wb,
            angular_rate=np.where(
                np.isfinite(frame.angular_rate), moment.rate + moment.change * change_s, np.nan
            ),
            p_w=self._positions(frame, last, q_wb, ahead_s),
            sigma=np.sqrt(frame.sigma**2 + self._squares),
            status=status,
            markers=None,
        )

    def _follow_parents(self, frame: SkeletonFrame, q_wb: FloatArray, status: StatusArray) -> None:
        """Let a segment whose angular rate is not known turn as its parent does; without one it is HELD."""
        for s in np.flatnonzero(np.isnan(q_wb[:, 0]) & np.isfinite(frame.q_wb[:, 0])).tolist():
            parent = self._parents[s]
            q_wb[s] = frame.q_wb[s]
            if parent >= 0 and np.isfinite(q_wb[parent, 0]):
                turn = quaternion.multiply(q_wb[parent], quaternion.conjugate(frame.q_wb[parent]))
                q_wb[s] = quaternion.canonical(quaternion.multiply(turn, frame.q_wb[s]))
            elif status[s] == Status.PREDICTED:
                status[s] = Status.HELD

    def _positions(
        self, frame: SkeletonFrame, last: SkeletonFrame | None, q_wb: FloatArray, ahead_s: float
    ) -> FloatArray:
        """Return (S, 3) m: joints move with the segments that they hang from, all as the root did lately."""
        parents, offsets, origin = self._skeleton.parents, self._skeleton.offsets, np.zeros(3)
        moved = joint_positions(parents, offsets, q_wb, origin) - joint_positions(
            parents, offsets, frame.q_wb, origin
        )
        positions = frame.p_w + moved
        if last is not None:
            speed = (frame.p_w[0] - last.p_w[0]) / ((frame.time_ns - last.time_ns) * 1e-9)
            if np.isfinite(speed).all():
                positions += speed * ahead_s
        return positions


@compiled
def _turned(q_wb: FloatArray, rate: FloatArray, change: FloatArray, ahead_s: float) -> FloatArray:
    """Return orientations (S, 4) ``ahead_s`` later, of rates (S, 3) rad/s and their changes (S, 3) rad/s²."""
    turned = np.empty_like(q_wb)
    fading = CHANGE_FADES_S
    weight = fading**2 * (ahead_s / fading - 1.0 + math.exp(-ahead_s / fading))
    for s in range(len(q_wb)):
        turn = quaternion.from_rotation_vector(rate[s] * ahead_s + change[s] * weight)
        turned[s] = quaternion.canonical(quaternion.multiply(q_wb[s], turn))
    return turned


@compiled
def _note_errors(
    squares: FloatArray, predicted: FloatArray, found: FloatArray, scale: float, share: float
) -> None:
    """Take the errors of a prediction, times ``scale``, into the running means of their squares, rad²."""
    for s in range(len(squares)):
        error = quaternion.angle_between(predicted[s], found[s]) * scale
        if np.isfinite(error):
            squares[s] += share * (error * error - squares[s])
