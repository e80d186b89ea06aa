"""What a CAN controller reports of its bus, as the kernel's error frames (linux/can/error.h)."""

from __future__ import annotations

from enum import Enum

from firmware_protocol.can_framing import CanFrame

_TX_TIMEOUT, _CONTROLLER, _BUS_OFF, _RESTARTED = 0x001, 0x004, 0x040, 0x100
_STATE = 1
"""Byte of an error frame that holds the controller's state."""

WANTED_ERRORS = _TX_TIMEOUT | _CONTROLLER | _BUS_OFF | _RESTARTED
"""Mask of the error frames to ask the kernel for."""


class BusError(Enum):
    """What went wrong, in order of gravity."""

    WARNING = "the error counter passed 96"
    PASSIVE = "the error counter passed 127: the controller may no longer mark others' frames as bad"
    OVERFLOW = "the controller's own buffer was full: frames were lost before the kernel saw them"
    TRANSMIT_TIMEOUT = "a frame could not be sent in time"
    BUS_OFF = "the error counter passed 255: the controller has left the bus"
    RESTARTED = "the controller takes part again after bus-off"


_BY_CLASS = {
    _TX_TIMEOUT: BusError.TRANSMIT_TIMEOUT,
    _BUS_OFF: BusError.BUS_OFF,
    _RESTARTED: BusError.RESTARTED,
}
_BY_STATE = {0x03: BusError.OVERFLOW, 0x0C: BusError.WARNING, 0x30: BusError.PASSIVE}


def errors_of(frame: CanFrame) -> list[BusError]:
    """Return what an error frame reports; empty for any other frame."""
    if not frame.is_error:
        return []
    errors = [error for mask, error in _BY_CLASS.items() if frame.identifier & mask]
    if frame.identifier & _CONTROLLER and len(frame.data) > _STATE:
        errors += [error for mask, error in _BY_STATE.items() if frame.data[_STATE] & mask]
    return errors
