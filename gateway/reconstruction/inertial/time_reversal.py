"""A recording seen backward: its frames, and the filter's state to begin with.

A motion seen backward is a motion: at ``t' = −t`` positions, accelerations, specific forces and fields are
what they were, rates and velocities change their sign. So the same filter runs backward over the same frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gateway.frames import FloatArray, ImuFrame, LocalReading, Quantity
from gateway.reconstruction.inertial.chain_prediction import start_acceleration
from gateway.reconstruction.inertial.chain_state import FilterState, Noise, initial_state

KEPT = (
    "R", "is_started", "is_open", "silent_s", "force_bias", "arm", "arm_covariance", "compass_s",
    "field_seen", "field_offset", "sun", "unaided_square", "device_shift", "device_covariance",
    "device_age_s", "rest", "misfit", "vibration", "corrections",
)  # fmt: skip
"""Of the state, what is the same seen backward."""


def turned_back(state: FilterState, noise: Noise, gravity: FloatArray) -> FilterState:
    """The state to go backward with from where ``state`` is: orientations, biases, lever arms and shown
    headings are kept; the rows' averages begin anew. The clock stands at 0, where the last frame lies: it has
    been taken, and turning by its rate once more would be off by a whole interval.

    Recordings end in mid-motion as often as at rest: a backward filter that knew nothing would first of all
    take that motion's acceleration for a tilt. But it is as unsure as a beginning: what the forward filter
    knows would count twice where the two are put together, and an error at its end would be carried back.
    gravity: (3,) m/s².
    """
    back = initial_state(len(state.is_started), len(state.device_age_s))
    sign = np.array([1.0, 1.0, 1.0, -1.0, -1.0, -1.0])
    for name in KEPT:
        getattr(back, name)[...] = getattr(state, name)
    back.time_ns[...] = 0
    back.bias[...], back.rate[...] = -state.bias, -state.rate
    back.rest[:, :3] *= -1.0
    back.P[...] = state.P * np.outer(sign, sign)
    back.C[...] = state.C * np.outer(sign, sign)
    forgotten = np.array([noise.start_tilt] * 2 + [noise.start_heading] + [noise.bias] * 3) ** 2
    back.P[:, range(6), range(6)] += forgotten
    back.field_offset[:, 1] = noise.heading**2
    for s, (force, rate) in enumerate(zip(state.last_force, state.rate, strict=True)):
        back.starting_square[s] = noise.starting_share * start_acceleration(gravity, force, rate)
    return back


def seen_backward(
    frames: Sequence[ImuFrame], end_ns: int, later: Sequence[LocalReading]
) -> tuple[list[ImuFrame], list[LocalReading]]:
    """Frames in reverse order as a motion of their own, whose time is counted back from ``end_ns``.

    later: readings left over from the frames after these; returned are those of before the first frame.
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
