"""Angles between two results by segment, as a picture or as one self-contained page."""

from __future__ import annotations

import base64
import html
import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from devices.extras import how_to_add
from gateway.errors import GatewayError
from gateway.frames import FloatArray
from gateway.support.whole_files import write_whole, writing

_MOST_POINTS = 2000
"""Of a curve: more cannot be seen."""


@dataclass(frozen=True)
class AnglePage:
    """What is shown: S curves over T instants, and a table."""

    title: str
    notes: tuple[str, ...]
    """Sentences above the table."""
    time_s: FloatArray  # (T,)
    angle_deg: FloatArray  # (T, S)
    names: tuple[str, ...]
    """Of the segments."""
    heads: tuple[str, ...]
    rows: list[tuple[str, ...]]
    """Of the table, in the columns of ``heads``."""


def save_page(page: AnglePage, path: Path) -> None:
    """Write ``path``, whose ending says as what: .png, .svg, .pdf or .html.

    Raises ``GatewayError`` for another ending, without matplotlib, or when it cannot be written.
    """
    kind = path.suffix.lower().lstrip(".")
    if kind not in {"png", "svg", "pdf", "html"}:
        raise GatewayError(f"{path}: a plot is written as .png, .svg, .pdf or .html")
    picture = _picture(page, "png" if kind == "html" else kind)
    content = _html(page, picture).encode() if kind == "html" else picture
    with writing(path):
        write_whole(path, content)


def _picture(page: AnglePage, kind: str) -> bytes:
    try:
        from matplotlib.figure import Figure  # noqa: PLC0415 - an extra, and slow to import
    except ImportError:
        raise GatewayError(f"plots need matplotlib: {how_to_add('plot')}") from None
    n = len(page.names)
    figure = Figure(figsize=(10, 1.2 + 0.9 * n), layout="constrained")
    axes = figure.subplots(n, 1, sharex=True, squeeze=False)[:, 0]
    for axis, name, angles in zip(axes, page.names, page.angle_deg.T, strict=True):
        times, peaks = _thinned(page.time_s, angles)
        axis.plot(times, peaks, linewidth=0.8)
        axis.set_ylabel(f"{name}\n[°]", rotation=0, ha="right", va="center", fontsize=8)
        axis.set_ylim(bottom=0)
        axis.grid(alpha=0.3)
    axes[-1].set_xlabel("time [s]")
    figure.suptitle(page.title, fontsize=10)
    written = io.BytesIO()
    figure.savefig(written, format=kind, dpi=110)
    return written.getvalue()


def _thinned(time_s: FloatArray, angles: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return at most ``_MOST_POINTS`` points, each the largest angle of its stretch: no peak is lost."""
    stretch = -(-len(angles) // _MOST_POINTS)
    if stretch <= 1:
        return time_s, angles
    n = len(angles) // stretch * stretch
    blocks = np.where(np.isnan(angles[:n]), -np.inf, angles[:n]).reshape(-1, stretch)
    peaks = blocks.max(axis=1)
    return time_s[:n:stretch], np.where(np.isinf(peaks), np.nan, peaks)


def _html(page: AnglePage, picture: bytes) -> str:
    head = "".join(f"<th>{html.escape(text)}</th>" for text in page.heads)
    body = "".join(
        "<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>" for row in page.rows
    )
    notes = "".join(f"<p>{html.escape(note)}</p>" for note in page.notes)
    image = base64.b64encode(picture).decode()
    return (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{html.escape(page.title)}</title>'
        "<style>body{font:14px sans-serif;margin:2em}table{border-collapse:collapse}"
        "td,th{padding:.2em .8em;border-bottom:1px solid #ccc;text-align:right}"
        "td:first-child,th:first-child{text-align:left}img{max-width:100%}</style>"
        f"<h1>{html.escape(page.title)}</h1>{notes}<table><tr>{head}</tr>{body}</table>"
        f'<img alt="angle between the two by segment over time" src="data:image/png;base64,{image}"></html>\n'
    )
