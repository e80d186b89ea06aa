"""A recording forward and backward through the tree filter: turned frames and state, and both put together.

A motion seen backward is a motion: at ``t' = −t`` positions, accelerations, specific forces and fields are
what they were, rates and velocities change their sign. So the same filter runs backward over the same frames.
At every instant the forward filter knows the past and the backward one the future (two-filter smoothing).
They are put together by their covariances (Fraser & Potter 1969); the rotation between them is the
innovation.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gateway.frames import FloatArray, ImuFrame, LocalReading, Quantity
from gateway.geometry import quaternion
from gateway.geometry.compiled import compiled
from gateway.geometry.vectors import is_finite
from gateway.reconstruction.inertial.tree.start import start_acceleration, starting_speed_square
from gateway.reconstruction.inertial.tree.state import State, initial_state
from gateway.reconstruction.inertial.tree.tuning import Tuning
from gateway.reconstruction.inertial.tree.update import inverse_3_into

KEPT = (
    "R", "started", "heading", "defined_square", "silent_s", "force_bias", "field_watch", "compass", "sun",
    "felt_square", "zero_rate", "aids_s", "joint_nis", "bend_square", "vibration", "rate_vibration",
    "corrections",
)  # fmt: skip


KEPT_OF_ARMS, KEPT_OF_DEVICES = ("error", "covariance"), ("shift", "covariance", "age_s")
"""Of the state, what is the same seen backward."""


def turned_back(state: State, tuning: Tuning, gravity: FloatArray, is_tree: bool) -> State:
    """Return the state with which the filter runs backward from where ``state`` is.

    gravity: (3,) m/s². is_tree: whether the filter keeps what segments have in common.

    Orientations, biases, lever arms and shown headings are kept; the rows' averages begin anew. The clock
    stands at 0, where the last frame lies: that frame has been used, and a turn by its rate once more would
    be off by a whole interval.

    Recordings end in mid-motion as often as at rest: a backward filter that began without any state would
    first take that motion's acceleration for a tilt. But of tilts, and of the heading of the whole body, it
    is as uncertain as at a start: what the forward filter knows would count twice where the two are put
    together, and an error at its end would be carried back. Not so of what lasts: biases, headings of
    segments against each other, what compasses have seen. With these forgotten, the way back would drift
    and turn to what the field says where it begins.
    """
    before, devices = state.segments, state.devices
    turned = initial_state(len(before), len(devices))
    # biases are rates: backward they change their sign, and so do their covariances with orientations
    back, sign = turned.segments, np.array([1.0, 1.0, 1.0, -1.0, -1.0, -1.0])
    for name in KEPT:
        back[name][...] = before[name]
    for name in KEPT_OF_ARMS:
        back["arms"][name][...] = before["arms"][name]
    for name in KEPT_OF_DEVICES:
        turned.devices[name][...] = devices[name]
    turned.clock.last_ns, turned.clock.first_ns = 0, 0
    back["bias"][...], back["rate"][...] = -before["bias"], -before["rate"]
    back["zero_rate"]["rate"][...] *= -1.0
    back["rate_vibration"]["samples"][...] = 0.0
    back["zero_rate"]["off_rate"][...] *= -1.0
    back["P"][...] = before["P"] * np.outer(sign, sign)
    back["C"][...] = before["C"] * np.outer(sign, sign)
    back["P"][:, range(2), range(2)] += tuning.start_tilt**2
    back["P"][:, 2, 2] += tuning.start_heading**2
    if is_tree:
        back["C"][:, 2, 2] += tuning.start_heading**2  # only what all headings have in common
    back["compass"]["rate"][...] *= -1.0
    back["compass"]["covariance"][...] *= -1.0
    for s in range(len(back)):
        force, rate = before[s].averages.last_force, before[s].rate
        starting = starting_speed_square(start_acceleration(gravity, force, rate, tuning), tuning)
        back[s].velocity.square = max(before[s].velocity.square, starting)
        back[s].velocity.waits_s = np.inf
    return turned


def seen_backward(
    frames: Sequence[ImuFrame], end_ns: int, later: Sequence[LocalReading]
) -> tuple[list[ImuFrame], list[LocalReading]]:
    """Return the frames in reverse order as a motion of their own, with time counted back from ``end_ns``.

    later: readings left over from the frames after these. Readings of before the first frame are returned
    second.
    """
    waiting = [*later, *(reading for frame in frames for reading in frame.local)]
    waiting.sort(key=lambda reading: reading.time_ns)
    turned = []
    for frame in reversed(frames):
        local = []
        while waiting and waiting[-1].time_ns >= frame.time_ns:
            local.append(_turned_reading(waiting.pop(), end_ns))
        turned.append(
            replace(
                frame, time_ns=end_ns - frame.time_ns, angular_rate=-frame.angular_rate, local=tuple(local)
            )
        )
    return turned, waiting


def _turned_reading(reading: LocalReading, end_ns: int) -> LocalReading:
    is_velocity = reading.quantity in {Quantity.VELOCITY, Quantity.AIR_VELOCITY}
    value = -reading.value if is_velocity else reading.value
    return replace(reading, time_ns=end_ns - reading.time_ns, value=value)


@compiled
def put_together(
    q_wb: FloatArray,
    P: FloatArray,
    sigma: FloatArray,
    q_back: FloatArray,
    P_back: FloatArray,
    sigma_back: FloatArray,
) -> None:
    """Combine forward and backward orientations (T, n, 4) into the forward ones, in place, (66) and (66a).

    P, P_back: (T, n, 2, 3, 3) rad², world axes: the estimates' own, and the published ones. With the rotation
    ``δ = log(R_back R⁻¹)`` the orientation moves by ``P (P + P_back)⁻¹ δ`` of its own. The published P
    of both are weighed alike, since the errors are: sigma (T, n), rad, becomes the root of its trace. Where
    only one of the two is defined, that one counts.
    """
    both, known = np.empty((3, 3)), np.empty((3, 3))
    for t in range(q_wb.shape[0]):
        for s in range(q_wb.shape[1]):
            if not is_finite(q_back[t, s]):
                continue
            if not is_finite(q_wb[t, s]):
                q_wb[t, s] = q_back[t, s]
                sigma[t, s] = sigma_back[t, s]
                P[t, s] = P_back[t, s]
                continue
            for i in range(3):
                for j in range(3):
                    both[i, j] = P[t, s, 0, i, j] + P_back[t, s, 0, i, j]
            inverse_3_into(known, both)
            gain = P[t, s, 0] @ known
            difference = quaternion.multiply(q_back[t, s], quaternion.conjugate(q_wb[t, s]))
            turn = gain @ quaternion.to_rotation_vector(difference)
            q = quaternion.multiply(quaternion.from_rotation_vector(turn), q_wb[t, s])
            q_wb[t, s] = quaternion.canonical(quaternion.normalise(q))
            published = P[t, s, 1]
            _weigh_claims(published, P_back[t, s, 1], gain)
            square = published[0, 0] + published[1, 1] + published[2, 2]
            sigma[t, s] = min(math.sqrt(square), max(sigma[t, s], sigma_back[t, s]))


@compiled
def _weigh_claims(P: FloatArray, other: FloatArray, gain: FloatArray) -> None:
    """Mix the tilt's block of P (3, 3), and the heading's, with those of the other as the gain (3, 3) mixes
    the estimates, equation (66a).
    """
    share = min(max(0.5 * (gain[0, 0] + gain[1, 1]), 0.0), 1.0)
    for i in range(2):
        for j in range(2):
            P[i, j] += share * (other[i, j] - P[i, j])
    P[2, 2] += min(max(gain[2, 2], 0.0), 1.0) * (other[2, 2] - P[2, 2])
