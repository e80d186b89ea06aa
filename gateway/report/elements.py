"""What reports are made of: pages of one HTML file that load nothing, and pictures (extra ``plot``)."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Mapping, Sequence
from typing import Any

from gateway.frames import FloatArray

_STYLE = """
body{font:14px/1.45 system-ui,sans-serif;color:#1c2733;max-width:1060px;margin:2em auto;
padding:0 1.5em}
h1{font-size:1.7em;margin:0 0 .1em}h2{font-size:1.15em;border-bottom:2px solid #1f6fb2;margin:1.8em 0 .6em}
.sub{color:#5b6b7b;margin:0 0 1.2em}.tiles{display:flex;flex-wrap:wrap;gap:.7em}
.tile{background:#f1f5f9;border-radius:6px;padding:.5em .9em;min-width:7em}
.tile b{display:block;font-size:1.35em}.tile span{color:#5b6b7b;font-size:.85em}
table{border-collapse:collapse;width:100%;font-size:12.5px}
td,th{padding:.22em .55em;border-bottom:1px solid #dde4ea;
text-align:right}th{color:#5b6b7b;font-weight:600}td.t,th.t{text-align:left}
.warn{background:#fff3cd;border-left:4px solid #e0a800;padding:.5em .9em;margin:.8em 0}
img{width:100%;height:auto}pre{background:#f6f8fa;padding:.8em;font-size:11px;white-space:pre-wrap}
td.bad{color:#b02a37;font-weight:600}figure{margin:.5em 0;break-inside:avoid}
figure,.wide{overflow-x:auto}video{max-width:100%}
@media screen and (max-width:700px){body{margin:1em auto;padding:0 .8em}img{min-width:680px}}
@media print{body{margin:0;max-width:none;font-size:11px}h2{break-after:avoid}tr,.tile{break-inside:avoid}
@page{margin:14mm}}
"""


def document(title: str, body: str) -> str:
    """Return the whole page. body: HTML."""
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        f"<title>{html.escape(title)}</title>"
        f"<style>{_STYLE}</style></head><body>\n{body}\n</body></html>\n"
    )


def tiles(figures: Sequence[tuple[str, str]]) -> str:
    """Large figures with what they are."""
    return '<div class="tiles">' + "".join(
        f'<div class="tile"><b>{html.escape(value)}</b><span>{html.escape(what)}</span></div>'
        for value, what in figures
    ) + "</div>"  # fmt: skip


def table(heads: Sequence[str], rows: Sequence[Sequence[str]], n_texts: int = 1) -> str:
    """Return a table; the first ``n_texts`` columns are set to the left, a cell that begins with ! is
    marked."""
    head = "".join(
        f'<th class="{"t" if i < n_texts else ""}">{html.escape(text)}</th>' for i, text in enumerate(heads)
    )
    return f'<div class="wide"><table><thead><tr>{head}</tr></thead>' + "".join(
        "<tr>" + "".join(_cell(text, i < n_texts) for i, text in enumerate(row)) + "</tr>" for row in rows
    ) + "</table></div>"  # fmt: skip


def _cell(text: str, is_text: bool) -> str:
    kinds = " ".join(kind for kind, holds in (("t", is_text), ("bad", text.startswith("!"))) if holds)
    return f'<td class="{kinds}">{html.escape(text.removeprefix("!"))}</td>'


def warning(text: str) -> str:
    """Return a sentence that must not be missed."""
    return f'<p class="warn">{html.escape(text)}</p>'


def picture(png: bytes, meaning: str) -> str:
    """Return a PNG picture; meaning: for those who do not see it."""
    data = base64.b64encode(png).decode()
    return f'<figure><img alt="{html.escape(meaning)}" src="data:image/png;base64,{data}"></figure>'


_DPI = 110
_WIDTH_IN = 10.0
_COLUMNS = 3
LINES = ("#1f6fb2", "#e07a1f", "#4f9d4f")
"""Colours of the first three lines of a panel."""


def small_multiples(
    times: FloatArray,
    shown: Sequence[tuple[str, FloatArray, tuple[str, ...]]],
    shaded: Mapping[str, Sequence[tuple[float, float]]] | None = None,
) -> bytes:
    """Return a panel for each of ``shown`` (title, values (F, n), names of their lines), as PNG.

    shaded: spans of time set off behind the panel of a title, from when until when, s.
    """
    rows = -(-len(shown) // _COLUMNS)
    figure, axes = panels(len(shown), 1.55 * rows + 0.3, _COLUMNS)
    for panel, (title, values, names) in zip(axes, shown, strict=False):
        for first, last in (shaded or {}).get(title, ()):
            panel.axvspan(first, last, color="#e8edf2", lw=0)
        for line, name in enumerate(names):
            panel.plot(times, values[:, line], lw=0.8, color=LINES[line], label=name.replace("_", " "))
        panel.set_title(title.replace("_", " "), fontsize=8)
        if len(names) > 1:
            panel.legend(
                fontsize=5, loc="upper left", bbox_to_anchor=(1.0, 1.0), handlelength=1, borderpad=0.2,
                frameon=False,
            )  # fmt: skip
    for panel in axes[-_COLUMNS:]:
        panel.set_xlabel("s", fontsize=7)
    return png(figure)


def panels(count: int, height_in: float, columns: int | None = None) -> tuple[Any, list[Any]]:
    """Return a figure and its axes, those beyond ``count`` switched off.

    height_in: of the figure, inches; columns: axes side by side, all where not given.
    """
    from matplotlib.figure import Figure  # noqa: PLC0415 - an extra

    columns = columns or count
    rows = -(-count // columns)
    figure = Figure(figsize=(_WIDTH_IN, height_in), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes in grid:
        axes.tick_params(labelsize=6)
        if count > 1:
            axes.grid(lw=0.3, alpha=0.6)
    for axes in grid[count:]:
        axes.set_axis_off()
    return figure, list(grid)


def colours(count: int) -> list[Any]:
    """Return so many distinguishable colours (RGBA), in the order of the rainbow."""
    from matplotlib import colormaps  # noqa: PLC0415 - an extra

    return [colormaps["nipy_spectral"](0.05 + 0.87 * i / max(count - 1, 1)) for i in range(count)]


def png(figure: Any) -> bytes:
    """Return a figure as PNG, without metadata that would differ between machines."""
    target = io.BytesIO()
    figure.savefig(target, format="png", dpi=_DPI, metadata={"Software": None})
    return target.getvalue()
