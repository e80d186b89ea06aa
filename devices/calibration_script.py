"""The script of a body calibration: its steps, their durations, and when an emulated wearer begins.

The gateway's procedure keeps to it, and so does the emulated wearer; it imports neither.
"""

from __future__ import annotations

GET_READY_S = 3.0
"""Before every step the wearer stands and gets into position."""
STEPS: tuple[tuple[str, float], ...] = (
    ("n_pose", 4.0),
    ("t_pose", 4.0),
    ("squat", 6.0),
    ("left_leg", 7.0),
    ("right_leg", 7.0),
    ("arms", 5.0),
    ("free", 15.0),
)
"""Name and duration of the steps, s."""
PERIOD_S = sum(GET_READY_S + seconds for _, seconds in STEPS) + 1.0
"""Then all begins anew."""


def timetable() -> dict[str, tuple[float, float]]:
    """Begin and end of each step within the period, s."""
    found: dict[str, tuple[float, float]] = {}
    at = 0.0
    for name, seconds in STEPS:
        found[name] = (at + GET_READY_S, at + GET_READY_S + seconds)
        at += GET_READY_S + seconds
    return found


def begin_of_script(not_before_ns: int) -> int:
    """Return the next gateway time, ns, at which an emulated wearer begins; it is the same on one machine."""
    period_ns = round(PERIOD_S * 1e9)
    return -(-not_before_ns // period_ns) * period_ns
