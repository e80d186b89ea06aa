"""Consistent overhead byte stuffing (COBS): bytes without a zero, so that a zero can end a wire frame.

S. Cheshire and M. Baker, "Consistent overhead byte stuffing", IEEE/ACM Transactions on Networking 7 (1999).
Each block begins with its length, 1 to 255; a zero followed it, but for the last one and those of length 255.
"""

from __future__ import annotations

_LONGEST = 255
"""Length of a block of 254 bytes after which no zero is left out."""


def stuff(raw: bytes) -> bytes:
    """Return the same without a zero; one byte longer, and one more for every 254 bytes begun that hold no
    zero."""
    out = bytearray()
    for part in raw.split(b"\x00"):
        begun = 0
        while len(part) - begun >= _LONGEST - 1:
            out.append(_LONGEST)
            out += part[begun : begun + _LONGEST - 1]
            begun += _LONGEST - 1
        out.append(len(part) - begun + 1)
        out += part[begun:]
    if begun and begun == len(part):
        out.pop()  # the last block was a full one: nothing follows it
    return bytes(out)


def unstuff(encoded: bytes) -> bytes | None:
    """Return what was stuffed; None where a zero stands in it or its last block is cut off.

    The byte before a block is where the zero was that ended the block before.
    """
    if 0 in encoded:
        return None
    raw, place, n = bytearray(encoded), 0, len(encoded)
    ends_of_full: list[int] = []
    while place < n:
        length = raw[place]
        raw[place] = 0
        place += length
        # A full block of 254 bytes ends without a zero: the place of one is removed again.
        if length == _LONGEST:
            ends_of_full.append(place)
    if place > n:
        return None
    # From behind, so that the places still to be removed do not move.
    for end in reversed(ends_of_full):
        del raw[end : end + 1]
    return bytes(raw[1:])
