"""What a device keeps: flash, which may lose power at any moment, and the settings in it. Sans-I/O.

Erasing a slot makes all of its bits 1; programming makes single bits 0 and never 1 again. What is under
way when the power goes is done in part: a byte has any of its bits cleared that were to be cleared, an
erased slot is any mixture of what it held and of 1s. ``PowerCut`` is power lost at the worst moment: in the
middle of obeying a command. All draws are seeded.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from firmware_protocol.device_settings import SETTINGS, factory_settings
from firmware_protocol.flash_slots import SLOT_SIZE, SLOTS, Flash, FlashError, SlotStore

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


ERASED = 0xFF

_RANDOM_STREAM = 21


class PowerLost(Exception):
    """The device's power went while it worked on its flash."""


class EmulatedFlash:
    """Slots of equal size, one after the other from address 0, erased singly."""

    def __init__(self, n_slots: int = len(SLOTS), slot_size: int = SLOT_SIZE, seed: int = 0) -> None:
        """Fresh from the factory: erased. seed: of what a loss of power leaves behind."""
        self.slot_size = slot_size
        self.steps = 0
        """Erased slots and programmed bytes so far: the moments at which power may be lost."""
        self.is_worn_out = False
        """Erasing and programming have no effect any more."""
        self._cells: NDArray[np.uint8] = np.full(n_slots * slot_size, ERASED, np.uint8)
        self._power_ends: int | None = None
        self._rng = np.random.default_rng([seed, _RANDOM_STREAM])

    def cut_power_after(self, steps: int | None) -> None:
        """Lose power in the middle of the step after so many more; None: not at all.

        A step is the erasing of one slot or the programming of one byte. When it is reached the flash
        raises ``PowerLost`` and has power again for the next start.
        """
        self._power_ends = None if steps is None else self.steps + steps

    def read(self, address: int, n: int) -> bytes:
        """Return the bytes at an address. Raises ``ValueError`` outside the memory."""
        self._check(address, n)
        return self._cells[address : address + n].tobytes()

    def erase(self, slot: int) -> None:
        """Make a slot 0xFF throughout. Raises ``PowerLost``, or ``ValueError`` when there is no such slot."""
        start = slot * self.slot_size
        self._check(start, self.slot_size)
        if self.is_worn_out:
            return
        cells = self._cells[start : start + self.slot_size]
        if self._steps_left(1) < 1:
            # Some bytes are done, some are not begun, some are half done.
            progress = self._rng.integers(3, size=self.slot_size)
            raised = self._rng.integers(256, size=self.slot_size, dtype=np.uint8)
            cells |= np.choose(progress, [np.uint8(0), raised, np.uint8(ERASED)]).astype(np.uint8)
            self._lose_power()
        cells[:] = ERASED
        self.steps += 1

    def program(self, address: int, data: bytes) -> None:
        """Clear the bits that are 0 in the data. Raises ``PowerLost``; ``ValueError`` outside the memory."""
        self._check(address, len(data))
        if self.is_worn_out:
            return
        whole = self._steps_left(len(data))
        self._cells[address : address + whole] &= np.frombuffer(data[:whole], np.uint8)
        self.steps += whole
        if whole < len(data):
            # Power fails amid a byte: some of its bits were cleared, others not.
            spared = np.uint8(self._rng.integers(256))
            self._cells[address + whole] &= np.uint8(data[whole]) | spared
            self._lose_power()

    def _steps_left(self, wanted: int) -> int:
        """Return how many of the wanted steps have power to their end."""
        return wanted if self._power_ends is None else min(wanted, self._power_ends - self.steps)

    def _lose_power(self) -> None:
        self._power_ends = None
        raise PowerLost(f"power lost after {self.steps} steps of the flash")

    def _check(self, address: int, n: int) -> None:
        if not 0 <= address <= address + n <= len(self._cells):
            raise ValueError(f"{n} bytes at {address}: the flash has {len(self._cells)}")


KEYS = {setting.name: key for key, setting in SETTINGS.items()}
"""Of settings, by name."""


class StoredSettings:
    """Settings by name to act by, and by key for commands.

    A new one of the same flash is what a device has after a loss of power: whatever was staged is gone.
    """

    def __init__(self, flash: Flash) -> None:
        self._store = SlotStore(flash)
        self._active = self._store.load()
        self.staged: dict[int, Any] = {}
        """Values written and not yet committed, by key."""

    @property
    def is_factory(self) -> bool:
        """No settings were ever committed, or none of them can be read."""
        return self._store.generation is None

    def __getitem__(self, name: str) -> Any:
        """Return the value acted by. Raises ``KeyError`` for a name that is no setting's."""
        return self._active[KEYS[name]]

    def value(self, key: int) -> Any:
        """Return what a host reads: the staged value if there is one, else the one acted by."""
        return self.staged.get(key, self._active[key])

    def stage(self, key: int, value: Any) -> None:
        """Keep a value for the next commit."""
        self.staged[key] = value

    def discard(self) -> None:
        """Forget what is staged."""
        self.staged.clear()

    def commit(self) -> int | None:
        """Store what is staged and act by it; the new generation, or None when the flash failed.

        Raises ``PowerLost`` when the flash says so.
        """
        return self._keep({**self._active, **self.staged})

    def reset(self) -> int | None:
        """Store the factory settings and act by them; otherwise as ``commit``."""
        return self._keep(factory_settings())

    def _keep(self, settings: dict[int, Any]) -> int | None:
        try:
            generation = self._store.commit(settings)
        except FlashError:
            return None
        self._active = settings
        self.staged.clear()
        return generation


def provision(flash: Flash, values: Mapping[str, Any]) -> None:
    """Store settings by name, and the factory values of all others, as whoever delivers a suit does."""
    SlotStore(flash).commit(factory_settings() | {KEYS[name]: value for name, value in values.items()})
