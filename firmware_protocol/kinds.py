"""The kinds of wire frame, who sends each, and how urgent each is on a CAN bus."""

from __future__ import annotations

from collections.abc import Mapping
from enum import IntEnum


class Kind(IntEnum):
    """What a wire frame carries. Numbers are never reused."""

    INERTIAL_SAMPLE = 0x10
    INERTIAL_SAMPLE_FINE = 0x11
    FUSED_SAMPLE = 0x12
    LOCAL_MEASUREMENT = 0x18
    LIGHT_SAMPLE = 0x19
    PRESSURE_SAMPLE = 0x1A
    PASS_THROUGH = 0x1B
    RELAY_BATCH = 0x20
    DEVICE_INFO = 0x30
    HEALTH = 0x31
    EVENT = 0x32
    LOG_LINE = 0x33
    SYNC_REQUEST = 0x40
    SYNC_RESPONSE = 0x41
    SAMPLING_TRIGGER = 0x42
    COMMAND = 0x50
    ACKNOWLEDGEMENT = 0x51
    TRANSFER_TO_MODULE = 0x5E
    TRANSFER_TO_HOST = 0x5F


FROM_HOST: frozenset[int] = frozenset(
    {Kind.SYNC_REQUEST, Kind.SAMPLING_TRIGGER, Kind.COMMAND, Kind.TRANSFER_TO_MODULE}
)
"""Kinds that the host sends. Their header names the module that is meant; 255 means every one."""

CAN_PRIORITY: Mapping[int, int] = {
    Kind.SYNC_REQUEST: 0,
    Kind.SAMPLING_TRIGGER: 0,
    Kind.SYNC_RESPONSE: 1,
    Kind.COMMAND: 1,
    Kind.ACKNOWLEDGEMENT: 1,
    Kind.LOCAL_MEASUREMENT: 2,
    Kind.PRESSURE_SAMPLE: 2,
    Kind.PASS_THROUGH: 2,
    Kind.INERTIAL_SAMPLE: 3,
    Kind.INERTIAL_SAMPLE_FINE: 3,
    Kind.FUSED_SAMPLE: 3,
    Kind.LIGHT_SAMPLE: 3,
    Kind.RELAY_BATCH: 3,
    Kind.EVENT: 5,
    Kind.DEVICE_INFO: 6,
    Kind.HEALTH: 6,
    Kind.LOG_LINE: 7,
    Kind.TRANSFER_TO_MODULE: 7,
    Kind.TRANSFER_TO_HOST: 7,
}
"""Arbitration priority on CAN: 0 wins over all, 7 yields to all."""

LOWEST_CAN_PRIORITY = 7
