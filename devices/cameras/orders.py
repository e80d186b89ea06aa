"""Where people will be in the next pictures, told to the cameras: one line of JSON for all of them.

    {"sequence": 812, "cameras": {"cam01": {"3": [540.0, 910.5, 700.0, 0.0], "4": null}}}

By camera and number of the person the square to look at: its middle, x and y, and its side, pixels; the
trunk's turn, rad. ``null``: the camera does not see the person. Somebody of a number of the gateway's who is
not named any more has left. Number 0 is the one person of a camera that follows one alone.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass

from devices.cameras.heat_map_messages import FOUND_BY_CAMERA

LONGEST = 1 << 16
"""Bytes of a line."""
MOST_PEOPLE = 32

Square = tuple[float, float, float, float]
"""Middle x, y and side, pixels; turn, rad."""


@dataclass(frozen=True, slots=True)
class CameraOrders:
    """Whom one camera is to follow."""

    sequence: int
    """Of the picture that the squares are for."""
    squares: Mapping[int, Square | None]
    """By person's number; None: not seen by this camera."""


def encode_orders(sequence: int, cameras: Mapping[str, Mapping[int, Square | None]]) -> bytes:
    """Return one line, for all cameras."""
    encoded = {
        name: {
            str(number): None if square is None else [round(value, 3) for value in square]
            for number, square in squares.items()
        }
        for name, squares in cameras.items()
    }
    return json.dumps({"sequence": sequence, "cameras": encoded}, separators=(",", ":")).encode() + b"\n"


def read_orders(line: bytes, camera: str) -> CameraOrders | None:
    """Return what a line tells one camera; None where it tells it nothing, or cannot be read."""
    if len(line) > LONGEST:
        return None
    try:
        content = json.loads(line)
        by_number = content["cameras"][camera]
        squares = {int(number): _square(square) for number, square in by_number.items()}
        orders = CameraOrders(int(content["sequence"]), squares)
    except (ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError):
        return None
    is_known = all(0 <= number < FOUND_BY_CAMERA for number in squares)
    return orders if is_known and len(squares) <= MOST_PEOPLE else None


def _square(values: list[float] | None) -> Square | None:
    """Return a square. Raises ``ValueError`` for what is none."""
    if values is None:
        return None
    x, y, side, turn = (float(value) for value in values)
    if not (all(map(math.isfinite, (x, y, turn))) and 1.0 <= side <= 1e5 and max(abs(x), abs(y)) <= 1e5):
        raise ValueError(f"{values} is no square of a picture")
    return x, y, side, turn
