"""A device that loses its power at the worst moment: in the middle of obeying a command."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

OFF_S = 0.3
"""How long a device is off when it loses power and has it back, s."""


class Moment(Enum):
    """When the power goes, seen from the command."""

    BEFORE = "the command has come, nothing is done yet"
    IN_FLASH = "the flash is at work"
    AFTER = "all is done, the answer is not sent yet"


@dataclass
class PowerCut:
    """Strikes once, at one command."""

    verb: int
    skips: int = 0
    """Commands of that verb that are obeyed before."""
    moment: Moment = Moment.AFTER
    flash_step: int = 0
    """For ``IN_FLASH``: the step of the flash (from 0, see ``EmulatedFlash``) that is not finished."""
    off_s: float = OFF_S

    def strikes(self, verb: int) -> bool:
        """Return whether this command is the one; count it otherwise."""
        if verb != self.verb:
            return False
        self.skips -= 1
        return self.skips < 0
