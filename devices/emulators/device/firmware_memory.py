"""The memory of an emulated microcontroller as a file: what the reference firmware finds and leaves there.

The layout is that of ``firmware_protocol/reference/boards/image.h``: settings in two slots of flash, the
count of starts, a factory page with the chip's number, and the motion that its sensors feel.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from devices.emulators.bodies import FloatArray
from devices.emulators.device.emulated_flash import provision
from devices.emulators.motion.motions import BodyMotion
from devices.emulators.sensing.ideal_sensors import GRAVITY, MAGNETIC_FIELD, sense
from firmware_protocol import InertialSample
from firmware_protocol.device_settings import SETTINGS
from firmware_protocol.fields import layout_of
from firmware_protocol.flash_slots import SLOT_SIZE, SlotStore
from firmware_protocol.messages import UNIQUE_ID_SIZE
from firmware_protocol.samples import SENSORS

SIZE = 16 << 20
"""Bytes of the memory; the file has holes and takes far less."""

_N_SLOTS = 3
"""Two of settings and one that counts starts."""
_RESETS = 2 * SLOT_SIZE
_MOTION = 0x2000
_ERASED = 0xFF
_LARGEST = 32767


class FirmwareMemory:
    """One chip's memory in a file. Look into it and change it while the chip is off."""

    def __init__(self, path: Path) -> None:
        self.path = path

    @classmethod
    def fresh(
        cls,
        path: Path,
        unique_id: bytes,
        *,
        settings: Mapping[str, Any] | None = None,
        is_locked: bool = False,
        first_count_us: int = 0,
    ) -> FirmwareMemory:
        """Make a chip from the factory. Raises ``ValueError`` for a number of another length.

        settings: by name, committed already; None: none ever were.
        is_locked: its jumper forbids changes.
        first_count_us: counter at each start, µs.
        """
        if len(unique_id) != UNIQUE_ID_SIZE:
            raise ValueError(f"a unique id has {UNIQUE_ID_SIZE} bytes, not {len(unique_id)}")
        page = unique_id + struct.pack("<B3xI", is_locked, first_count_us)
        with path.open("wb") as file:
            # Erased flash reads as ones.
            file.write(bytes([_ERASED]) * (_N_SLOTS * SLOT_SIZE) + page)
            file.truncate(SIZE)
        memory = cls(path)
        if settings is not None:
            provision(memory, settings)
        return memory

    @property
    def settings(self) -> dict[str, Any]:
        """Return what a start finds, by name: as committed last, else of the factory."""
        return {SETTINGS[key].name: value for key, value in SlotStore(self).load().items()}

    @property
    def generation(self) -> int | None:
        """Return the generation of the settings; None: none were ever committed."""
        return SlotStore(self).generation

    @property
    def starts(self) -> int:
        """Return how often the firmware has started."""
        data = self.read(_RESETS, SLOT_SIZE)
        base = int.from_bytes(data[:4], "little")
        cleared = int(np.unpackbits(~np.frombuffer(data[4:], np.uint8)).sum())
        return cleared + (0 if base == 0xFFFFFFFF else base)

    def play(self, rows: NDArray[np.int16], interval_us: int) -> None:
        """Have the sensors feel readings (n, 9) of ``motion_rows``, so many microseconds apart."""
        head = struct.pack("<4sIII", b"MOTN", interval_us, len(rows), 0)
        self._write(_MOTION, head + rows.astype("<i2").tobytes())

    # As ``firmware_protocol.flash_slots.Flash``.

    def read(self, address: int, n: int) -> bytes:
        """Return n bytes from an address."""
        with self.path.open("rb") as file:
            file.seek(address)
            return file.read(n)

    def erase(self, slot: int) -> None:
        """Set every bit of a slot."""
        self._write(slot * SLOT_SIZE, bytes([_ERASED]) * SLOT_SIZE)

    def program(self, address: int, data: bytes) -> None:
        """Clear the bits that are 0 in the data."""
        before = self.read(address, len(data))
        self._write(address, bytes(a & b for a, b in zip(before, data, strict=True)))

    def _write(self, address: int, data: bytes) -> None:
        with self.path.open("r+b") as file:
            file.seek(address)
            file.write(data)


def motion_rows(
    motion: BodyMotion,
    segment: int,
    times_s: FloatArray,
    gravity: FloatArray = GRAVITY,
    magnetic_field: FloatArray = MAGNETIC_FIELD,
) -> NDArray[np.int16]:
    """Return what ideal sensors of a segment's module read at times (n,), in steps of a sample: (n, 9).

    gravity, magnetic_field: (3,) world, m/s² and µT.
    """
    body = motion.body
    w, *xyz = body.sensor_to_segment[segment]
    state = motion.module_state(np.array([segment]), times_s[:, None])
    values = sense(
        state, body.module_positions[[segment]], _matrix(w, np.array(xyz))[None], gravity, magnetic_field
    )
    scales = {declared.name: declared.scale or 1.0 for declared in layout_of(InertialSample).fields}
    steps = [getattr(values, name)[:, 0] / scales[name] for name in SENSORS]
    limited = np.clip(np.rint(np.hstack(steps)), -_LARGEST, _LARGEST)
    rows: NDArray[np.int16] = limited.astype(np.int16)
    return rows


def _matrix(w: float, u: FloatArray) -> FloatArray:
    """Return R (3, 3) of a unit quaternion."""
    cross = np.array([[0, -u[2], u[1]], [u[2], 0, -u[0]], [-u[1], u[0], 0]])
    R: FloatArray = (w * w - u @ u) * np.eye(3) + 2 * np.outer(u, u) + 2 * w * cross
    return R
