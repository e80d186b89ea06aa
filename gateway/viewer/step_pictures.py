"""Pictures of what the wearer is to do, as SVG, of lines that ``benchmarks.calibration_pictures`` makes."""

from __future__ import annotations

import html
import json
from functools import cache
from pathlib import Path

from gateway.viewer.appearance import SIDE_COLOURS

LINES = Path(__file__).with_name("step_pictures.json")
"""By step: figures, the last one is where it ends; each of lines, side and two points, x y z in metres."""
SHORTEST_M = 0.03
_HEIGHT_M, _APART_M = 2.15, 2.1
_FAINTEST = 0.25
Figure = list[list[str | float]]


@cache
def _figures() -> dict[str, list[Figure]]:
    found: dict[str, list[Figure]] = json.loads(LINES.read_text(encoding="utf-8"))
    return found


def step_picture(step: str, description: str) -> str:
    """Return a step from the front and from the right, as HTML; empty where there is no picture of it.

    description: a description of the picture, for screen readers.
    """
    figures = _figures().get(step)
    if figures is None:
        return ""
    # The lowest point of all figures is the floor: a squat then sinks instead of the floor rising.
    lowest = min(float(z) for figure in figures for _, *points in figure for z in points[2::3])
    shown = "".join(
        f'<g opacity="{_FAINTEST + (1 - _FAINTEST) * (k + 1) / len(figures):.2f}">'
        + "".join(_line(line, across, middle, lowest) for line in figure)
        + "</g>"
        for across, middle in ((1, 0.0), (0, _APART_M))
        for k, figure in enumerate(figures)
    )
    wide = 2.0 * _APART_M
    return (
        f'<div style="padding:2px 12px"><svg role="img" aria-label="{html.escape(description, quote=True)}" '
        f'viewBox="{-0.5 * _APART_M:.2f} 0 {wide:.2f} {_HEIGHT_M}" style="width:100%;max-height:170px;'
        'background:rgba(128,128,128,.12);border-radius:6px">'
        f'<g stroke-width="0.07" stroke-linecap="round">{shown}</g></svg></div>'
    )


def _line(line: list[str | float], across: int, middle: float, lowest: float) -> str:
    """Return a line as SVG, seen from the front (``across`` 1) or from the right (0)."""
    side, *points = line
    start, end = points[:3], points[3:]
    colour = f"rgb{SIDE_COLOURS[side]}" if side in ("left", "right") else "currentColor"
    x0, x1 = (float(point[across]) + middle for point in (start, end))
    y0, y1 = (_HEIGHT_M - 0.08 - (float(point[2]) - lowest) for point in (start, end))
    return f'<line x1="{x0:.2f}" y1="{y0:.2f}" x2="{x1:.2f}" y2="{y1:.2f}" stroke="{colour}"/>'
