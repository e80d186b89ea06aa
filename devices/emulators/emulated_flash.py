"""Flash memory as chips have it, which may lose power at any moment. Sans-I/O, seeded.

Erasing a slot makes all of its bits 1; programming makes single bits 0 and never 1 again. What is under
way when the power goes is done in part: a byte has any of its bits cleared that were to be cleared, an
erased slot is any mixture of what it held and of 1s.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from firmware_protocol.flash_slots import SLOT_SIZE, SLOTS

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
