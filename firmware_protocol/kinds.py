"""The kinds of wire frame, and how urgent each is on a CAN bus."""

from __future__ import annotations

from collections.abc import Mapping
from enum import IntEnum


class Kind(IntEnum):
    """What a wire frame carries. Numbers are never reused."""

    INERTIAL_SAMPLE = 0x10
    INERTIAL_SAMPLE_FINE = 0x11
    LOCAL_MEASUREMENT = 0x18
    RELAY_BATCH = 0x20
    DEVICE_INFO = 0x30
    HEALTH = 0x31


CAN_PRIORITY: Mapping[int, int] = {
    Kind.INERTIAL_SAMPLE: 3,
    Kind.INERTIAL_SAMPLE_FINE: 3,
    Kind.LOCAL_MEASUREMENT: 2,
    Kind.RELAY_BATCH: 3,
    Kind.DEVICE_INFO: 6,
    Kind.HEALTH: 6,
}
"""Arbitration priority on CAN: 0 wins over all, 7 yields to all."""

LOWEST_CAN_PRIORITY = 7
