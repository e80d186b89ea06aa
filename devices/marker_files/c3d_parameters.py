"""The parameter section of a C3D file, in any of its three byte orders.

After the C3D file format user guide (Motion Lab Systems, 2021), chapters "The header section" and "The
parameter section". Intel files are little-endian, DEC files too but with VAX floating point, SGI/MIPS files
big-endian throughout.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from devices.marker_files.trial import FloatArray
from devices.vendor_formats.sheets import FormatError

BLOCK = 512
"""Bytes; sections begin at multiples of it."""
INTEL, DEC, MIPS = 84, 85, 86
_CHARACTERS = -1
_FLOAT = 4


@dataclass(frozen=True)
class Parameter:
    """One parameter: its values as bytes, with what is needed to read them."""

    kind: int
    """-1 characters, 1 bytes, 2 integers of 16 bits, 4 floats."""
    dimensions: tuple[int, ...]
    data: bytes
    processor: int

    def numbers(self) -> FloatArray:
        """Return all values, flat; integers are taken as unsigned, as long recordings need them."""
        order = ">" if self.processor == MIPS else "<"
        if self.kind == _FLOAT:
            return floats(self.data, self.processor)
        if self.kind == _CHARACTERS:
            return np.zeros(0)
        return np.frombuffer(self.data, "u1" if self.kind == 1 else f"{order}u2").astype(np.float64)

    def texts(self) -> list[str]:
        """Return the strings of a character parameter, without the spaces that fill them."""
        if self.kind != _CHARACTERS:
            return []
        width = self.dimensions[0] if self.dimensions else 1
        text = self.data.decode("latin-1")
        return [text[i : i + width].strip(" \0") for i in range(0, len(text), width)] if width else []


def floats(data: bytes, processor: int) -> FloatArray:
    """Return single-precision numbers of a file's processor.

    VAX F: the halves of the number change places, and the exponent is two larger than that of IEEE 754.
    """
    if processor == MIPS:
        return np.frombuffer(data, ">f4").astype(np.float64)
    if processor == INTEL:
        return np.frombuffer(data, "<f4").astype(np.float64)
    # Swapping the halves gives IEEE's order of bits; a quarter corrects the exponent.
    swapped = np.frombuffer(data, "<u2").reshape(-1, 2)[:, ::-1].copy()
    values: FloatArray = swapped.view("<f4").ravel().astype(np.float64) / 4.0
    return values


def read_parameters(content: bytes, block: int, where: str) -> tuple[int, dict[str, Parameter]]:
    """Return the processor, and parameters by ``GROUP:NAME`` in capitals; the last of a name holds.

    block: number of the section's first block, from 1. Raises ``FormatError`` when the section is cut off or
    does not hold what it says.
    """
    start = (block - 1) * BLOCK
    if len(content) < start + BLOCK:
        raise FormatError(
            f"{where}: cut off: its parameters begin at byte {start}, it has {len(content)}: copy it again"
        )
    processor = content[start + 3]
    if processor not in (INTEL, DEC, MIPS):
        raise FormatError(
            f"{where}: processor type {processor} at byte {start + 3}, where C3D has 84 (Intel), 85 (DEC) or "
            "86 (MIPS): not a C3D file, or damaged: export the trial again"
        )
    end = start + content[start + 2] * BLOCK
    if len(content) < end:
        raise FormatError(
            f"{where}: cut off: its parameters end at byte {end}, it has {len(content)}: copy it again"
        )
    try:
        return processor, _parameters(content[:end], start + 4, processor)
    except (IndexError, ValueError) as error:
        raise FormatError(
            f"{where}: the parameters before byte {end} are damaged ({error}): export the trial again"
        ) from error


def _parameters(content: bytes, at: int, processor: int) -> dict[str, Parameter]:
    """Return the parameters that the chain of groups and parameters holds, from byte ``at`` on."""
    groups: dict[int, str] = {}
    found: dict[tuple[int, str], Parameter] = {}
    order = "big" if processor == MIPS else "little"
    while at + 2 <= len(content) and content[at] != 0:
        # A negative length marks a locked entry; its size is the same.
        length = abs(int.from_bytes(content[at : at + 1], "big", signed=True))
        group = int.from_bytes(content[at + 1 : at + 2], "big", signed=True)
        name = content[at + 2 : at + 2 + length].decode("latin-1").upper()
        step_at = at + 2 + length
        step = int.from_bytes(content[step_at : step_at + 2], order, signed=False)  # type: ignore[arg-type]
        if group < 0:
            # Groups may follow their parameters in the file, so names are joined at the end.
            groups[-group] = name
        else:
            found[group, name] = _parameter(content, step_at + 2, processor, name)
        if step == 0:
            break
        at = step_at + step
    return {f"{groups.get(group, group)}:{name}": value for (group, name), value in found.items()}


def _parameter(content: bytes, at: int, processor: int, name: str) -> Parameter:
    kind = int.from_bytes(content[at : at + 1], "big", signed=True)
    n_dimensions = content[at + 1]
    dimensions = tuple(content[at + 2 : at + 2 + n_dimensions])
    begin = at + 2 + n_dimensions
    # -1 is text, one byte a letter; 1, 2 and 4 are the bytes of a number.
    size = abs(kind)
    for dimension in dimensions:
        size *= dimension
    data = content[begin : begin + size]
    if len(data) < size or kind not in (-1, 1, 2, 4):
        raise ValueError(f"{name}: {size} bytes of type {kind}, {len(data)} are there")
    return Parameter(kind, dimensions, data, processor)
