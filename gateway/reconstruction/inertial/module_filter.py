"""One module's filter: VQF, and what VQF has no answer to, gaps.

VQF (Laidig & Seel, Information Fusion 91, 2023) takes every sample for the next one. After a gap it either
goes on from where it was, tens of degrees off and for tens of seconds, or begins anew from one specific force
that is no plumb line. Here a short gap is bridged by samples interpolated between its ends; after a longer
one the module settles for three seconds (``settling``), while VQF goes on integrating and keeps what it knows
of the gyrometers' bias and the field; then VQF is put where the module was found.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from devices.deferred import VQF
from gateway.frames import FloatArray
from gateway.geometry import quaternion
from gateway.reconstruction.inertial import settling
from gateway.reconstruction.inertial.habits import Habits, after_gap
from gateway.reconstruction.inertial.settling import Before, Since, settle

LONGEST_BRIDGE_S = 0.1
"""As long as the assembler bridges by default. What the module did is known then; nothing has to settle."""
BIAS_PAUSE_S = 10.0
"""After settling VQF's inclination still moves to what its low-pass finds, for three of its time constants:
it would take this for a bias of the gyrometers, and after many gaps believe in one."""
LONGEST_GAP_S = 0.2
"""After a longer one the last orientation is a mere guess, and saturated gyrometers tell not even that."""
_LONGEST_GAP_NS = round(LONGEST_GAP_S * 1e9)
_AVERAGES = (
    "accLpState",
    "motionBiasEstRLpState",
    "motionBiasEstBiasLpState",
    "restGyrLpState",
    "restAccLpState",
    "magNormDipLpState",
)
_NONE = np.full(3, np.nan)


class Sample(NamedTuple):
    """Of one module, sensor axes; None where a sensor has nothing to say."""

    specific_force: FloatArray | None  # (3,) m/s²
    angular_rate: FloatArray  # (3,) rad/s
    magnetic_field: FloatArray | None  # (3,) any unit

    def between(self, other: Sample, share: float) -> Sample:
        """On the way to another one."""
        pairs = zip(self, other, strict=True)
        f, w, x = (None if a is None or b is None else (1.0 - share) * a + share * b for a, b in pairs)
        assert w is not None  # of both
        return Sample(f, w, x)


class ModuleFilter:
    """VQF with default parameters, and what it needs around gaps. Its world is level, y towards magnetic
    north; without a field the heading is arbitrary, and kept over gaps."""

    def __init__(self, interval_s: float, gravity: float, habits: Habits, segment: int) -> None:
        """interval_s: that a sample stands for; gravity: m/s²; habits: of which those of the segment are this
        module's; whoever calls ``take`` notes them."""
        self._interval_s = float(interval_s)
        self._gravity = gravity
        self._habits, self._segment = habits, segment
        self._vqf = VQF(interval_s)
        self.reset()

    def reset(self) -> None:
        """Forget everything but the parameters."""
        self.has_field = False
        """Whether the module has ever given one."""
        self._heard_ns = self._sound_ns = 0
        self._was_blind = False
        self._last: Sample | None = None
        """The last sound one, of ``_sound_ns``."""
        self._is_known = False
        self._vqf.setMotionBiasEstEnabled(True)
        self._vqf.resetState()
        self._before: Before | None = None
        """While it settles."""
        self._pause_s = 0.0
        """Until motion may tell the bias again, after that."""
        self._since = settling.nothing_since()
        self._q_wi, self._sigma = np.array([1.0, 0.0, 0.0, 0.0]), 0.0
        self._kept: _Kept | None = None

    @property
    def is_known(self) -> bool:
        """Whether there has been any sample."""
        return self._is_known

    @property
    def orientation(self) -> FloatArray:
        """Sensor to the filter's world, (4,)."""
        if self._before is not None:
            return quaternion.multiply(self._q_wi, self._vqf.getQuat3D())
        return np.asarray(self._vqf.getQuat9D() if self.has_field else self._vqf.getQuat6D())

    def is_silent(self, time_ns: int) -> bool:
        """Whether the last values are too old to go on from."""
        return time_ns - self._heard_ns > _LONGEST_GAP_NS

    def take(self, sample: Sample, time_ns: int) -> None:
        """One as it should be, whatever was before it."""
        if self._last is not None and time_ns - self._sound_ns > 1.5e9 * self._interval_s:
            self._catch_up(self._last, sample, (time_ns - self._sound_ns) * 1e-9)
        self._kept = None
        self._was_blind = False
        self._heard_ns = self._sound_ns = time_ns
        self._last = sample
        self._advance(sample)

    def take_doubtful(self, sample: Sample, time_ns: int, is_blind: bool) -> None:
        """The last one repeated, or one from the end of the gyrometers' range (``is_blind``): shown until a
        better one comes. A repeated one is believed for no longer than a gap that is bridged."""
        if self._kept is None:
            since = Since(*(sums.copy() for sums in self._since))
            self._kept = _Kept(self._vqf.state, self._before, self._pause_s, since, self._q_wi, self._sigma)
        self._was_blind |= is_blind
        if not is_blind:
            self._heard_ns = time_ns
        if is_blind or self._last is None or time_ns - self._sound_ns <= LONGEST_BRIDGE_S * 1e9:
            self._advance(sample)

    def _advance(self, sample: Sample) -> None:
        """One sample, one interval after the one before."""
        f, w, x = sample
        self._is_known = True
        self._vqf.updateGyr(w)
        if f is not None:
            self._vqf.updateAcc(f)
        if x is not None:
            self._vqf.updateMag(x)
            if not self.has_field:
                self.has_field = True
                self._habits.seconds[self._segment] = 0.0  # the mean orientation was in another world
        if self._before is None:
            if self._pause_s > 0.0:
                self._pass_pause()
            return
        q_is = self._vqf.getQuat3D()
        f, x = _NONE if f is None else f, _NONE if x is None else x
        self._q_wi, self._sigma = settle(self._before, self._since, q_is, f, x, self._interval_s)
        if self._since.seconds[0] >= settling.SETTLED_S:
            self._hand_over()

    def _pass_pause(self) -> None:
        """A sample's worth of it."""
        self._pause_s -= self._interval_s
        if self._pause_s <= 0.0:
            self._vqf.setMotionBiasEstEnabled(True)

    def _catch_up(self, last: Sample, sample: Sample, since_s: float) -> None:
        """Over the gap between two sound samples, taking back what doubtful ones did meanwhile."""
        if self._was_blind and since_s <= LONGEST_GAP_S:
            return  # the end of the range is the best guess
        if self._kept is not None:
            self._vqf.setMotionBiasEstEnabled(self._kept.before is None and self._kept.pause_s <= 0.0)
            self._vqf.state, self._before, self._pause_s, self._since, self._q_wi, self._sigma = self._kept
        n_missed = round(since_s / self._interval_s) - 1
        if since_s <= LONGEST_BRIDGE_S:
            for k in range(1, n_missed + 1):
                self._advance(last.between(sample, k / (n_missed + 1)))
            return
        gap_s = n_missed * self._interval_s
        bias = self._vqf.getBiasEstimate()[0]
        rate = 0.5 * (last.angular_rate + sample.angular_rate) - bias
        self._resume(after_gap(self._habits, self._segment, gap_s, rate), gap_s)

    def _resume(self, expected: tuple[FloatArray, float], gap_s: float) -> None:
        """Settle from the next sample on. expected: orientation after the gap (4,), and its standard
        deviation about an axis in rad, for one that was known before the gap; gap_s: the gap's length, s."""
        q_expected, sigma = expected
        if self._before is not None:
            sigma = math.hypot(sigma, self._sigma)
        state = self._vqf.state
        field_norm, dip = state["magRefNorm"], state["magRefDip"]
        self._forget_averages(state, gap_s)
        q_wi = quaternion.multiply(q_expected, quaternion.conjugate(self._vqf.getQuat3D()))
        q_wi, swing = quaternion.normalise(q_wi), math.sqrt(self._habits.swing[self._segment])
        self._before = Before(q_wi, float(sigma), swing, field_norm, dip, self._gravity)
        self._since = settling.nothing_since()

    def _forget_averages(self, state: dict[str, object], gap_s: float) -> None:
        """Of the time before the gap. The bias is kept, less certain, as far as anything was learnt of it."""
        for name in _AVERAGES:
            state[name] = [float("nan")] * len(state[name])  # type: ignore[arg-type]
        largest, step = self._vqf.coeffs["biasP0"], self._vqf.coeffs["biasV"] * gap_s / self._interval_s
        covariance = np.array(state["biasP"])
        covariance[::4] = np.minimum(covariance[::4] + step, largest)
        bias = np.array(state["bias"]) * (1.0 - (covariance[::4] / largest) ** 2)
        state |= {"bias": bias.tolist(), "biasP": covariance.tolist(), "restT": 0.0, "restDetected": False}
        self._vqf.state = state
        self._vqf.setMotionBiasEstEnabled(False)  # VQF's own inclination is not to be believed meanwhile

    def _hand_over(self) -> None:
        """Put VQF where the module was found: level, its low-pass as if it had been so for long."""
        vqf, state = self._vqf, self._vqf.state
        level = quaternion.rotate(quaternion.conjugate(self._q_wi), np.array([0.0, 0.0, self._gravity]))
        b, a = vqf.coeffs["accLpB"], vqf.coeffs["accLpA"]
        state["accLpState"] = [part * share for part in level for share in (1.0 - b[0], b[2] - a[1])]
        state["lastAccLp"] = level.tolist()
        state["accQuat"], state["delta"] = self._q_wi.tolist(), 0.0
        if self.has_field:  # as VQF begins: the next sample is one of so many
            state["kMagInit"] = self._interval_s / settling.SETTLED_S
        vqf.state = state
        self._before = None
        self._pause_s = BIAS_PAUSE_S


class _Kept(NamedTuple):
    """All that changes."""

    state: dict[str, object]
    before: Before | None
    pause_s: float
    since: Since
    q_wi: FloatArray
    sigma: float
