"""Good wire frames of every kind, drawn at random."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from random import Random
from typing import Any

from firmware_protocol import BROADCAST, FROM_HOST, PACKETS, RELAY, Kind, WireFrame, relay_batch
from firmware_protocol.fields import INTEGER_RANGE, WireField, layout_of

UNKNOWN_KIND = 0x77
_BODIES_OF_A_KIND = 32


class Source:
    """Wire frames of every kind, each with a module time of its own."""

    def __init__(self, rng: Random, largest: int) -> None:
        self._rng = rng
        self._time_us = 0
        self._bodies = [
            (kind, body)
            for kind in PACKETS
            for body in (_body(rng, kind) for _ in range(_BODIES_OF_A_KIND))
            if len(body) <= largest
        ]
        self._bodies += [(UNKNOWN_KIND, rng.randbytes(size)) for size in range(_BODIES_OF_A_KIND)]
        self._bodies += [
            (int(Kind.RELAY_BATCH), body)
            for body in (_batch_body(rng, self._bodies, size) for size in range(_BODIES_OF_A_KIND))
            if len(body) <= largest
        ]

    def frames(self, n: int) -> list[WireFrame]:
        """Return the next ``n`` frames."""
        rng, frames = self._rng, []
        for _ in range(n):
            kind, body = rng.choice(self._bodies)
            module = RELAY if kind == Kind.RELAY_BATCH else rng.randrange(64)
            if kind in FROM_HOST and rng.random() < 0.1:
                module = BROADCAST
            self._time_us += 1
            frames.append(WireFrame(kind, module, rng.randrange(65536), self._time_us, body))
        return frames


def _batch_body(rng: Random, bodies: Sequence[tuple[int, bytes]], size: int) -> bytes:
    entries = [
        WireFrame(kind, rng.randrange(64), rng.randrange(65536), rng.randrange(2**32), body)
        for kind, body in rng.choices(bodies, k=size)
    ]
    return relay_batch(entries, 0, 0).body


def _body(rng: Random, kind: int) -> bytes:
    """Return a body that is good: every value within its limits."""
    layout = layout_of(PACKETS[kind])
    mask = rng.choice(layout.valid_masks())
    elements: list[Any] = [mask] if layout.has_mask else []
    for declared in layout.present(mask):
        if not declared.is_rest:
            elements += _elements(rng, declared)
    body = struct.pack(layout.struct_format(mask), *elements)
    if layout.rest is None:
        return body
    size = rng.randint(layout.rest.min_size, layout.rest.max_size or 200)
    return body + (bytes(rng.choices(range(32, 127), k=size)) if layout.rest.is_text else rng.randbytes(size))


def _elements(rng: Random, declared: WireField) -> list[Any]:
    if declared.code == "s":
        return [rng.randbytes(declared.count)]
    if declared.meanings:
        return [rng.choice(list(declared.meanings))]
    if declared.code == "f":
        return [rng.uniform(0.0, 1e4) for _ in range(declared.count)]
    low, high = INTEGER_RANGE[declared.code]
    high = high if declared.maximum is None else int(declared.maximum)
    return [rng.choice((low, high, 0, rng.randint(low, high))) for _ in range(declared.count)]
