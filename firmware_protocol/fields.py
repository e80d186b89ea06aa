"""How one field lies on the wire and what it means: the data that all else is derived from.

A packet is a dataclass whose fields carry a ``WireField`` or a ``MaskFlag`` as metadata. Encoder,
decoder and the byte tables of ``README.md`` read these declarations and nothing else.
"""

from __future__ import annotations

import dataclasses
import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

BYTE_ORDER = "<"

INTEGER_RANGE: Mapping[str, tuple[int, int]] = {
    "B": (0, 2**8 - 1),
    "b": (-(2**7), 2**7 - 1),
    "H": (0, 2**16 - 1),
    "h": (-(2**15), 2**15 - 1),
    "I": (0, 2**32 - 1),
    "i": (-(2**31), 2**31 - 1),
    "Q": (0, 2**64 - 1),
}
"""Smallest and largest number that each integer layout code holds."""

LARGEST_FLOAT32 = (2 - 2**-23) * 2.0**127

MAX_REST_SIZE = 4096
"""Limit of a field that goes to the end and states none, bytes."""

TYPE_NAMES: Mapping[str, str] = {
    "B": "u8",
    "b": "i8",
    "H": "u16",
    "h": "i16",
    "I": "u32",
    "i": "i32",
    "Q": "u64",
    "f": "f32",
    "s": "bytes",
}
"""What firmware authors call each layout code."""


@dataclass(frozen=True, slots=True, kw_only=True)
class WireField:
    """One field of a layout."""

    name: str = ""
    """Attribute of the packet; filled in by ``layout_of``."""
    code: str
    """Layout code of one element, as in the ``struct`` module; ``s`` is a run of bytes."""
    count: int = 1
    """How many elements follow one another; 0: as many bytes as there are to the end of the body."""
    unit: str = ""
    """Unit of the decoded value."""
    scale: float | None = None
    """Decoded value = element on the wire x scale; None: the element is the value."""
    presence_bit: int | None = None
    """Bit of the mask that says whether the field is there; None: it always is."""
    absent: int | None = None
    """Reserved element that stands for "not known", decoded to None."""
    minimum: float | None = None
    maximum: float | None = None
    min_size: int = 0
    max_size: int | None = None
    """Bytes of a field that goes to the end of the body."""
    is_text: bool = False
    """Whether a run of bytes is UTF-8 text: of fixed size, with zeros after its end."""
    meanings: Mapping[int, str] = field(default_factory=dict)
    """The only values allowed, with what each stands for; empty: any."""
    sentence: str
    """What the field is, for people."""

    @property
    def struct_format(self) -> str:
        """Layout code of the whole field, for ``struct`` (without byte order); a rest has none."""
        if self.is_rest:
            return ""
        return self.code if self.count == 1 else f"{self.count}{self.code}"

    @property
    def is_rest(self) -> bool:
        """Whether the field goes to the end of the body. Only the last one may."""
        return self.count == 0

    @property
    def size(self) -> int:
        """Bytes on the wire when present; of a rest, 0."""
        return struct.calcsize(BYTE_ORDER + self.struct_format)

    @property
    def type_name(self) -> str:
        """``i16[3]``, ``u8`` and so on."""
        name = "text" if self.is_text else TYPE_NAMES[self.code]
        return name + (f"[{self.count}]" if self.count > 1 else "")

    @property
    def is_restricted(self) -> bool:
        """Whether some patterns of bytes are not values of this field."""
        return bool(
            self.code == "f" or self.is_text or self.meanings or (self.minimum, self.maximum) != (None, None)
        )

    def accepts(self, value: Any) -> bool:
        """Return whether a decoded value is finite, within the declared limits and of a declared meaning."""
        if value is None:
            return self.absent is not None
        if self.code == "s":
            return True
        least = -math.inf if self.minimum is None else self.minimum
        most = math.inf if self.maximum is None else self.maximum
        for x in value if self.count > 1 else (value,):
            if not (least <= x <= most and math.isfinite(x)) or (self.meanings and x not in self.meanings):
                return False
        return True


@dataclass(frozen=True, slots=True, kw_only=True)
class MaskFlag:
    """A bit of the mask that is itself a value."""

    name: str = ""
    """Attribute of the packet; filled in by ``layout_of``."""
    bit: int
    clips: str | None = None
    """Name of the field that the bit calls clipped; set only while that field is present."""
    sentence: str


@dataclass(frozen=True, slots=True)
class Layout:
    """The declared layout of a packet's body: a mask when any field needs one, then the fields."""

    fields: tuple[WireField, ...]
    flags: tuple[MaskFlag, ...]

    @property
    def has_mask(self) -> bool:
        """Whether the body begins with a mask byte."""
        return bool(self.flags) or any(f.presence_bit is not None for f in self.fields)

    def present(self, mask: int) -> tuple[WireField, ...]:
        """Return the fields that a body with this mask holds, in wire order."""
        return tuple(f for f in self.fields if f.presence_bit is None or mask >> f.presence_bit & 1)

    def struct_format(self, mask: int = 0) -> str:
        """Return layout of the whole body with this mask, for ``struct``."""
        codes = ["B"] if self.has_mask else []
        return BYTE_ORDER + "".join(codes + [f.struct_format for f in self.present(mask)])

    @property
    def rest(self) -> WireField | None:
        """The field that goes to the end of the body, if there is one."""
        return self.fields[-1] if self.fields and self.fields[-1].is_rest else None

    def sizes(self, mask: int = 0) -> tuple[int, int]:
        """Return the least and largest size of a body with this mask, bytes."""
        fixed = struct.calcsize(self.struct_format(mask))
        if self.rest is None:
            return fixed, fixed
        largest = MAX_REST_SIZE if self.rest.max_size is None else self.rest.max_size
        return fixed + self.rest.min_size, fixed + largest

    def valid_masks(self) -> tuple[int, ...]:
        """Return every mask a sender may use: no reserved bit, nothing clipped that is absent."""
        if not self.has_mask:
            return (0,)
        return tuple(mask for mask in range(256) if self._is_valid(mask))

    def _is_valid(self, mask: int) -> bool:
        presence = {f.name: f.presence_bit for f in self.fields if f.presence_bit is not None}
        used = sum(1 << bit for bit in presence.values()) + sum(1 << flag.bit for flag in self.flags)
        if mask & ~used:
            return False
        clipped = [flag.clips for flag in self.flags if flag.clips and mask >> flag.bit & 1]
        return all(mask >> presence[name] & 1 for name in clipped)


OPEN = ""
"""Layout code of a field of which each class states code and scale itself, in ``ELEMENTS``."""


def wire(
    code: str, count: int = 1, unit: str = "", scale: float | None = None, **rest: Any
) -> dict[str, Any]:
    """Return the metadata of a dataclass field that lies on the wire; ``rest`` as in ``WireField``."""
    return {"wire": WireField(code=code, count=count, unit=unit, scale=scale, **rest)}


def flag(bit: int, sentence: str, clips: str | None = None) -> dict[str, Any]:
    """Return the metadata of a boolean dataclass field that is a bit of the mask."""
    return {"wire": MaskFlag(bit=bit, sentence=sentence, clips=clips)}


def layout_of(packet_class: type[Any]) -> Layout:
    """Return the declared layout of a packet class, in wire order."""
    declared = [
        dataclasses.replace(f.metadata["wire"], name=f.name) for f in dataclasses.fields(packet_class)
    ]
    elements: Mapping[str, tuple[str, float]] = getattr(packet_class, "ELEMENTS", {})
    return Layout(
        fields=tuple(_completed(d, elements) for d in declared if isinstance(d, WireField)),
        flags=tuple(d for d in declared if isinstance(d, MaskFlag)),
    )


def _completed(declared: WireField, elements: Mapping[str, tuple[str, float]]) -> WireField:
    if declared.code != OPEN:
        return declared
    code, scale = elements[declared.name]
    return dataclasses.replace(declared, code=code, scale=scale)
