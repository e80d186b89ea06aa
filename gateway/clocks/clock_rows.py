"""The state of one module's clock that every packet touches, as a row that compiled code shares."""

from __future__ import annotations

import numpy as np

from gateway.clocks.counter import COUNTER32

MOST_PACKETS = 2_000
"""Of one block, so that a module with a runaway rate does not make it dearer; and of the opening."""

UNKNOWN, ESTIMATED, SHARED = range(3)
"""Kinds of clock: ``UNKNOWN`` are those that compiled code leaves to Python."""

CLOCK = np.dtype(
    [
        ("kind", np.int64),
        ("counter", COUNTER32),
        # of either kind: gateway time that full counts are reckoned from
        ("start_ns", np.int64),  # shared: gateway time minus module time; estimated: arrival of the start
        ("received_ns", np.int64),  # shared: arrival of the newest stamp
        # estimated: see ``EstimatedClock``
        ("start_us", np.int64),
        ("expected_us", np.int64),  # full count that arrives at the start
        ("fit_us", np.int64),  # published: offset + rate (t - fit) + correction, which fades away
        ("offset_us", np.float64),
        ("rate", np.float64),
        ("correction_us", np.float64),
        ("fade_us", np.float64),
        ("clamped_us", np.int64),  # newest stamp that arrived before its instant, and that instant
        ("clamped_ns", np.int64),
        ("block_end_us", np.int64),
        ("packets", np.int64),  # of the block so far: the first ones of the two that follow
        ("elapsed_us", np.int64, (MOST_PACKETS + 1,)),
        ("delays_us", np.float64, (MOST_PACKETS + 1,)),
    ]
)
"""A clock; µs of the module's clock since ``start_us`` unless their name says otherwise."""
