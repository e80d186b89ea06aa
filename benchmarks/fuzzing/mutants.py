"""Good inputs with small damage, the same every time."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from random import Random

_BYTES = b"\x00\x01\x7f\x80\xff\r\n\t \"'{}[]:,;-.0eE#*&<>/"
"""What separates, ends or bounds something, somewhere."""
_NUMBERS = (b"0", b"-1", b"1e999", b"nan", b"-inf", b"65536", b"4294967296", b"1e-300", b"3*(f8,i4", b"")
_NUMBER = re.compile(rb"-?\d+(\.\d+)?")
_MOST_CHANGES = 4


def mutants(good: Sequence[bytes], largest: int, seed: str, n: int) -> Iterator[bytes]:
    """Yield ``n`` inputs, each a good one with one to four changes, cut to ``largest`` bytes."""
    rng = Random(seed)
    for _ in range(n):
        data = rng.choice(good)
        for _ in range(rng.randint(1, _MOST_CHANGES)):
            data = rng.choice(_CHANGES)(data, rng.choice(good), rng)
        yield data[:largest]


def _span(data: bytes, rng: Random) -> tuple[int, int]:
    """Return the ends of a part, short ones mostly."""
    begin = rng.randrange(len(data) + 1)
    return begin, min(len(data), begin + round(rng.expovariate(1 / 8)))


def _bit(data: bytes, _: bytes, rng: Random) -> bytes:
    if not data:
        return data
    place = rng.randrange(len(data))
    return data[:place] + bytes([data[place] ^ 1 << rng.randrange(8)]) + data[place + 1 :]


def _byte(data: bytes, _: bytes, rng: Random) -> bytes:
    place = rng.randrange(len(data) + 1)
    return data[:place] + bytes([rng.choice(_BYTES)]) + data[place + rng.randint(0, 1) :]


def _without(data: bytes, _: bytes, rng: Random) -> bytes:
    begin, end = _span(data, rng)
    return data[:begin] + data[end:]


def _twice(data: bytes, _: bytes, rng: Random) -> bytes:
    begin, end = _span(data, rng)
    return data[:end] + data[begin:]


def _cut(data: bytes, _: bytes, rng: Random) -> bytes:
    return data[: rng.randrange(len(data) + 1)]


def _spliced(data: bytes, other: bytes, rng: Random) -> bytes:
    return data[: rng.randrange(len(data) + 1)] + other[rng.randrange(len(other) + 1) :]


def _other_number(data: bytes, _: bytes, rng: Random) -> bytes:
    found = list(_NUMBER.finditer(data))
    if not found:
        return data
    place = rng.choice(found)
    return data[: place.start()] + rng.choice(_NUMBERS) + data[place.end() :]


def _other_line(data: bytes, other: bytes, rng: Random) -> bytes:
    lines, others = data.splitlines(keepends=True), other.splitlines(keepends=True)
    if not lines or not others:
        return data
    lines[rng.randrange(len(lines))] = rng.choice([b"", rng.choice(others)])
    return b"".join(lines)


_CHANGES: tuple[Callable[[bytes, bytes, Random], bytes], ...] = (
    *(_bit, _byte, _without, _twice, _cut, _spliced, _other_number, _other_line),
)
