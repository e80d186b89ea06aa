"""How module time becomes gateway time, as the configuration names it."""

from __future__ import annotations

from enum import StrEnum


class ClockMode(StrEnum):
    """Where gateway time comes from."""

    ESTIMATED = "estimated"
    """Every module has its own crystal: rate and offset are estimated from arrival times."""
    SHARED = "shared"
    """All modules count one clock already (wired suit, one controller): one offset for all."""
    SYNCHRONISED = "synchronised"
    """Modules keep their clocks together by themselves (x-IMU3 in one network): one rate and one offset for
    all that agree, estimated from the arrivals of all."""
    TABLE = "table"
    """Rates come from a table measured beforehand (`calibrate clocks`), offsets from arrival times."""
    TRIGGER = "trigger"
    """The gateway says when to sample: a sample's instant is that at which its trigger left. What modules
    send on their own timers has an estimated clock."""
