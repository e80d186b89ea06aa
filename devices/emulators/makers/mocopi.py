"""Lets an emulated suit speak as Sony's mocopi does: bones relative to their parents, all in one datagram."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from devices.deferred import Rotation
from devices.emulators.makers.vendor_emulator import Fused, Sensed, Together, VendorEmulator
from devices.vendor_protocols.mocopi import PARENTS, Frame, encode

_Oriented = tuple[int, tuple[float, float, float, float]]
_NOWHERE = (0.0, 0.0, 0.0)


class MocopiEmulator(VendorEmulator):
    """One bone: the number of its module is its own."""

    is_fused = True
    sends_as_one = True

    def __init__(self, module: int, field_ut: float, together: Together[_Oriented]) -> None:
        super().__init__(module, field_ut)
        self._together = together

    def encode_sample(self, sensed: Sensed) -> bytes:
        """Return nothing: it sends no raw values."""
        return b""

    def encode_fused(self, fused: Fused) -> bytes:
        """Return the datagram of all bones, with the last of them."""
        done = self._together.add(
            self.module, fused.sequence, fused.time_us, (self.module, fused.orientation)
        )
        frames = (Frame(n, at_us // 1000, _relative(dict(parts))) for n, at_us, parts in done)
        return b"".join(map(encode, frames))


def mocopi_emulators(modules: Sequence[int], field_ut: float) -> Mapping[int, VendorEmulator]:
    """Return the emulators of all bones. Raises ``ValueError`` for numbers that none has."""
    if not all(module < len(PARENTS) for module in modules):
        raise ValueError(f"mocopi has bones 0 to {len(PARENTS) - 1}: take the rig mocopi_23")
    together: Together[_Oriented] = Together(modules)
    return {module: MocopiEmulator(module, field_ut, together) for module in modules}


def _relative(
    oriented: Mapping[int, tuple[float, float, float, float]],
) -> tuple[tuple[int, tuple[float, float, float, float], tuple[float, float, float]], ...]:
    """Return all bones relative to their parents; one that is not given goes with its parent."""
    # From z up to y up the three axes change places in a cycle.
    y_up = Rotation.from_quat((0.5, 0.5, 0.5, 0.5), scalar_first=True)
    turned = {-1: Rotation.identity()}
    bones = []
    for bone, parent in enumerate(PARENTS):
        orientation = oriented.get(bone)
        of_world = turned[parent]
        if orientation is not None:
            of_world = y_up.inv() * Rotation.from_quat(np.array(orientation), scalar_first=True)
        w, x, y, z = (turned[parent].inv() * of_world).as_quat(scalar_first=True).tolist()
        turned[bone] = of_world
        bones.append((bone, (w, x, y, z), _NOWHERE))
    return tuple(bones)
