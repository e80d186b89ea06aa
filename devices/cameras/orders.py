"""Where people will be in the next pictures, told to the cameras: one line of JSON for all of them.

    {"sequence": 812, "cameras": {"cam01": {"3": [540.0, 910.5, 700.0, 0.0], "4": null}}}

By camera and number of the person the square to look at: its middle, x and y, and its side, pixels; the
trunk's turn, rad. ``null``: the camera does not see the person. Somebody of a number of the gateway's who is
not named any more has left. Number 0 is the one person of a camera that follows one alone.

    "joined": {"left": {"3": ["right", 1.0, 0.0, 620.0, 0.0, 1.0, 0.0]}}

beside ``cameras``: where somebody is partly in the picture of one camera and partly in its neighbour's, the
neighbour's name, and the affine map from its pixels to those of the first, by rows.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from devices.cameras.heat_map_messages import FOUND_BY_CAMERA

LONGEST = 1 << 16
"""Bytes of a line."""
MOST_PEOPLE = 32

Square = tuple[float, float, float, float]
"""Middle x, y and side, pixels; turn, rad."""


@dataclass(frozen=True, slots=True)
class Joined:
    """A neighbour's picture that is laid beside a camera's own, about one person."""

    camera: str
    """The neighbour's name."""
    affine: tuple[float, ...]
    """(2, 3) by rows: pixel of the neighbour to pixel of the camera."""


@dataclass(frozen=True, slots=True)
class CameraOrders:
    """Whom one camera is to follow."""

    sequence: int
    """Of the picture that the squares are for."""
    squares: Mapping[int, Square | None]
    """By person's number; None: not seen by this camera."""
    joined: Mapping[int, Joined] = field(default_factory=dict)
    """By person's number, for whom a neighbour's picture is needed, too."""


def encode_orders(
    sequence: int,
    cameras: Mapping[str, Mapping[int, Square | None]],
    joined: Mapping[str, Mapping[int, Joined]] | None = None,
) -> bytes:
    """Return one line, for all cameras."""
    encoded = {
        name: {
            str(number): None if square is None else [round(value, 3) for value in square]
            for number, square in squares.items()
        }
        for name, squares in cameras.items()
    }
    content: dict[str, object] = {"sequence": sequence, "cameras": encoded}
    if joined:
        content["joined"] = {
            name: {str(number): [each.camera, *each.affine] for number, each in people.items()}
            for name, people in joined.items()
        }
    return json.dumps(content, separators=(",", ":")).encode() + b"\n"


def read_orders(line: bytes, camera: str) -> CameraOrders | None:
    """Return what a line tells one camera; None where it tells it nothing, or cannot be read."""
    if len(line) > LONGEST:
        return None
    try:
        content = json.loads(line)
        by_number = content["cameras"][camera]
        squares = {int(number): _square(square) for number, square in by_number.items()}
        neighbours = content.get("joined", {}).get(camera, {})
        joined = {int(number): _joined(each) for number, each in neighbours.items()}
        orders = CameraOrders(int(content["sequence"]), squares, joined)
    except (ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError):
        return None
    is_known = all(0 <= number < FOUND_BY_CAMERA for number in squares) and joined.keys() <= squares.keys()
    return orders if is_known and len(squares) <= MOST_PEOPLE else None


def _square(values: list[float] | None) -> Square | None:
    """Return a square. Raises ``ValueError`` for what is none."""
    if values is None:
        return None
    x, y, side, turn = (float(value) for value in values)
    if not (all(map(math.isfinite, (x, y, turn))) and 1.0 <= side <= 1e5 and max(abs(x), abs(y)) <= 1e5):
        raise ValueError(f"{values} is no square of a picture")
    return x, y, side, turn


def _joined(parts: list[Any]) -> Joined:
    """Return a neighbour. Raises ``ValueError`` for what is none."""
    camera, *values = parts
    affine = tuple(float(value) for value in values)
    if not (isinstance(camera, str) and len(affine) == 6 and all(abs(value) <= 1e5 for value in affine)):
        raise ValueError(f"{parts} is no neighbour")
    return Joined(camera, affine)
