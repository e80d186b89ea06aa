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
from gateway.reconstruction.inertial.chain_state import State, initial_state
from gateway.reconstruction.inertial.tuning import Tuning

KEPT = (
    "R", "started", "heading", "silent_s", "force_bias", "compass_s", "field_watch", "field_offset", "sun",
    "unaided_square", "rest", "joint_nis", "vibration", "corrections",
)  # fmt: skip
KEPT_OF_ARMS, KEPT_OF_DEVICES = ("error", "covariance"), ("shift", "covariance", "age_s")
"""Of the state, what is the same seen backward."""


def turned_back(state: State, tuning: Tuning, gravity: FloatArray) -> State:
    """The state to go backward with from where ``state`` is: orientations, biases, lever arms and shown
    headings are kept; the rows' averages begin anew. The clock stands at 0, where the last frame lies: it has
    been taken, and turning by its rate once more would be off by a whole interval.

    Recordings end in mid-motion as often as at rest: a backward filter that knew nothing would first of all
    take that motion's acceleration for a tilt. But it is as unsure as a beginning: what the forward filter
    knows would count twice where the two are put together, and an error at its end would be carried back.
    gravity: (3,) m/s².
    """
    before, devices = state.segments, state.devices
    turned = initial_state(len(before), len(devices))
    back, sign = turned.segments, np.array([1.0, 1.0, 1.0, -1.0, -1.0, -1.0])
    for name in KEPT:
        back[name][...] = before[name]
    for name in KEPT_OF_ARMS:
        back["arms"][name][...] = before["arms"][name]
    for name in KEPT_OF_DEVICES:
        turned.devices[name][...] = devices[name]
    turned.clock.last_ns, turned.clock.first_ns = 0, 0
    back["bias"][...], back["rate"][...] = -before["bias"], -before["rate"]
    back["rest"]["rate"][...] *= -1.0
    back["P"][...] = before["P"] * np.outer(sign, sign)
    back["C"][...] = before["C"] * np.outer(sign, sign)
    forgotten = np.array([tuning.start_tilt] * 2 + [tuning.start_heading] + [tuning.bias] * 3) ** 2
    back["P"][:, range(6), range(6)] += forgotten
    back["field_offset"]["variance"][...] = tuning.heading**2
    for s in range(len(back)):
        force, rate = before[s].averages.last_force, before[s].rate
        back[s].starting_square = tuning.starting_share * start_acceleration(gravity, force, rate, tuning)
    return turned


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
