"""What pages of reports are made of: one HTML file that loads nothing from elsewhere, and prints well."""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence

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
@media print{body{margin:0;max-width:none;font-size:11px}h2{break-after:avoid}tr,.tile{break-inside:avoid}
@page{margin:14mm}}
"""


def document(title: str, body: str) -> str:
    """The whole page. body: HTML."""
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{html.escape(title)}</title>'
        f"<style>{_STYLE}</style></head><body>\n{body}\n</body></html>\n"
    )


def tiles(figures: Sequence[tuple[str, str]]) -> str:
    """Large figures with what they are."""
    return '<div class="tiles">' + "".join(
        f'<div class="tile"><b>{html.escape(value)}</b><span>{html.escape(what)}</span></div>'
        for value, what in figures
    ) + "</div>"  # fmt: skip


def table(heads: Sequence[str], rows: Sequence[Sequence[str]], n_texts: int = 1) -> str:
    """A table; the first ``n_texts`` columns are set to the left, a cell that begins with ! is marked."""
    head = "".join(
        f'<th class="{"t" if i < n_texts else ""}">{html.escape(text)}</th>' for i, text in enumerate(heads)
    )
    return f"<table><thead><tr>{head}</tr></thead>" + "".join(
        "<tr>" + "".join(_cell(text, i < n_texts) for i, text in enumerate(row)) + "</tr>" for row in rows
    ) + "</table>"  # fmt: skip


def _cell(text: str, is_text: bool) -> str:
    kinds = " ".join(kind for kind, holds in (("t", is_text), ("bad", text.startswith("!"))) if holds)
    return f'<td class="{kinds}">{html.escape(text.removeprefix("!"))}</td>'


def warning(text: str) -> str:
    """A sentence that must not be missed."""
    return f'<p class="warn">{html.escape(text)}</p>'


def picture(png: bytes, meaning: str) -> str:
    """A PNG picture; meaning: for those who do not see it."""
    data = base64.b64encode(png).decode()
    return f'<figure><img alt="{html.escape(meaning)}" src="data:image/png;base64,{data}"></figure>'
