"""How sure a segment is, as a colour."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from gateway.viewer.texts import ENGLISH, segment_name, translated

Colour = tuple[int, int, int]

COLOURS: dict[str, Colour] = {
    "measured": (150, 156, 166),
    "interpolated": (40, 160, 190),
    "held": (225, 180, 20),
    "predicted": (165, 80, 195),
    "warming_up": (80, 100, 215),
    "missing": (210, 35, 30),
    "unaided": (150, 160, 70),
    "doubtful": (200, 45, 140),
}
"""By status. A measured segment has the pale colour of its side; all others are in full colour."""
SIDE_COLOURS: dict[str, Colour] = {
    "trunk": COLOURS["measured"],
    "left": (128, 160, 204),
    "right": (204, 132, 96),
}
"""Of what is measured."""
FACE: Colour = (45, 48, 56)
"""In front of the head, whatever its status."""
UNSURE: Colour = (246, 246, 240)
"""What is measured goes towards it as its sigma grows: paler, in no hue that means something else."""
STALE: Colour = (140, 140, 140)
MOST_NAMED = 3
"""More silent segments are only counted."""
SURE_DEG, UNSURE_DEG = 2.0, 15.0
"""Up to the first a measured segment counts as sure, from the second on as unsure."""


def segment_colours(
    statuses: Sequence[str],
    sigmas_rad: Sequence[float | None],
    is_stale: bool,
    sides: Sequence[str] | None = None,
) -> NDArray[np.uint8]:
    """Return colours (s, 3), RGB; ``sides`` has trunk, left or right of each segment, by default trunk."""
    if is_stale:
        return np.tile(np.array(STALE, np.uint8), (len(statuses), 1))
    sides = sides or ["trunk"] * len(statuses)
    colours = [_colour(*each) for each in zip(statuses, sigmas_rad, sides, strict=True)]
    return np.array(colours, np.uint8)


def side_of(segment: str) -> str:
    """Return left, right or trunk, by a segment's name."""
    side = segment.partition("_")[0]
    return side if side in SIDE_COLOURS else "trunk"


def _colour(status: str, sigma_rad: float | None, side: str) -> Colour:
    colour = COLOURS[status] if status != "measured" else SIDE_COLOURS[side]
    if status != "measured" or sigma_rad is None:
        return colour
    part = (math.degrees(sigma_rad) - SURE_DEG) / (UNSURE_DEG - SURE_DEG)
    part = min(1.0, max(0.0, part))
    red, green, blue = (
        round(sure + part * (unsure - sure)) for sure, unsure in zip(colour, UNSURE, strict=True)
    )
    return red, green, blue


def silent_segments(statuses: Mapping[str, str], worn: Collection[str]) -> tuple[str, ...]:
    """Return segments without data: missing, or only predicted although a module is ``worn`` there."""
    return tuple(
        segment
        for segment, status in statuses.items()
        if status == "missing" or (status == "predicted" and segment in worn)
    )


def status_summary(statuses: Mapping[str, str], silent: Sequence[str], language: str = ENGLISH) -> str:
    """Return how many segments have which status: ``16 measured, 1 missing; no data of head``."""
    counts = Counter(statuses.values())
    if counts["measured"] == len(statuses):
        return translated(language, "all_measured", count=len(statuses))
    counted = ", ".join(
        f"{counts[kind]} {translated(language, f'is_{kind}')}" for kind in COLOURS if counts[kind]
    )
    if not silent:
        return counted
    named = ", ".join(segment_name(language, name) for name in silent[:MOST_NAMED])
    more = ", …" if len(silent) > MOST_NAMED else ""
    return f"{counted}; {translated(language, 'no_data_of', segments=named + more)}"


def legend(language: str = ENGLISH) -> str:
    """Return what the colours mean, as HTML."""
    meanings = [(translated(language, f"is_{name}"), colour) for name, colour in COLOURS.items()]
    # Measured segments have a colour by side, and fade with their uncertainty.
    meanings[:1] = [
        (translated(language, "side_left"), SIDE_COLOURS["left"]),
        (translated(language, "side_right"), SIDE_COLOURS["right"]),
        (translated(language, "side_trunk"), SIDE_COLOURS["trunk"]),
        (translated(language, "sigma_over", deg=f"{UNSURE_DEG:g}"), UNSURE),
    ]
    meanings.append((translated(language, "is_stale"), STALE))
    return chips(meanings)


def chips(meanings: Iterable[tuple[str, Colour]]) -> str:
    """Return meanings with their colours, as HTML."""
    shown = "".join(
        '<span style="display:inline-block;margin:2px 8px 2px 0;white-space:nowrap">'
        f'<span style="display:inline-block;width:10px;height:10px;border-radius:5px;margin-right:4px;'
        "border:1px solid rgba(128,128,128,.6);"
        f'background:rgb{colour}"></span>{meaning}</span>'
        for meaning, colour in meanings
    )
    return f'<div style="font-size:11px;padding:0 12px 6px">{shown}</div>'
