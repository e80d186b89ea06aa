"""The state of all modules that every packet touches, as rows that compiled code shares."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from firmware_protocol import InertialSample, InertialSampleFine
from gateway.clocks.module_clock import CLOCK

SEQUENCE = np.dtype(
    [
        ("received", np.int64),
        ("newest", np.int64),  # unwrapped number of the newest packet; -1 before the first
        ("first", np.int64),
        ("shift", np.int64),  # wire number minus our own: 0 until the module has restarted
        ("goes_on", np.int64),  # 0: the next number, whatever it is, follows on the newest
        ("received_in", np.int64),  # chunk of the newest packet
    ]
)
"""State of a ``SequenceCounter``."""

SHARED_KINDS = {InertialSample.KIND: 0, InertialSampleFine.KIND: 1}
"""Kinds of packet whose counters compiled code shares, and their places in ``sequences``."""

MODULE = np.dtype(
    [
        ("last_arrival_ns", np.int64),
        ("sequences", SEQUENCE, (len(SHARED_KINDS),)),
        ("clock", CLOCK),
    ]
)
"""A module; all zeros before anything was heard of it."""

MOST_MODULES = 256
"""An id has one byte."""


def module_rows() -> NDArray[np.void]:
    """Return a row for each module id (256,), of which only those that are heard take memory."""
    return np.zeros(MOST_MODULES, MODULE)
