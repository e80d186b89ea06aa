"""Loss and clock of every module, from the health message, as HTML."""

from __future__ import annotations

import html
from collections.abc import Collection, Mapping

from pydantic import JsonValue

from gateway.contract.messages import BridgeHealth, BridgeInfo

_COLUMNS = ("id", "segment", "lost %", "ppm", "± µs", "bat. %")
_LOSSY_PERCENT = 1.0


def module_rows(
    health: BridgeHealth | None, info: BridgeInfo | None, silent: Collection[str] = ()
) -> list[tuple[str, ...]]:
    """One row a module, as texts: of the rig, and others that were heard; why it is doubtful comes last.

    silent: segments of which nothing comes now.
    """
    modules = health.statistics.get("modules", {}) if health is not None else {}
    doubts = health.statistics.get("doubts", {}) if health is not None else {}
    why: Mapping[str, JsonValue] = doubts if isinstance(doubts, dict) else {}
    heard: Mapping[str, JsonValue] = modules if isinstance(modules, dict) else {}
    worn = {str(m.module): m.segment for m in info.modules} if info is not None else {}
    names = sorted({*heard, *worn}, key=lambda name: (len(name), name))
    rows = ((name, worn.get(name, "other device")) for name in names)
    return [
        (*_row(name, place, None if place in silent else heard.get(name)), str(why.get(name, "")))
        for name, place in rows
    ]


def module_table(rows: list[tuple[str, ...]]) -> str:
    """The rows as an HTML table; modules that lose more than a per cent stand out, and
    those that are doubtful, with the reason."""
    head = "".join(f'<th style="text-align:left;padding:1px 4px">{name}</th>' for name in _COLUMNS)
    body = "".join(_html_row(row) for row in rows)
    return (
        '<div style="padding:0 6px;overflow-x:auto"><table style="font-size:11px;border-collapse:collapse">'
        f"<tr>{head}</tr>{body}</table></div>"
    )


def _row(module: str, segment: str, summary: JsonValue) -> tuple[str, ...]:
    if not isinstance(summary, dict):
        return (module, segment, "silent", "", "", "")
    received, lost = _number(summary, "received"), _number(summary, "lost")
    share = 100.0 * lost / (received + lost) if received + lost else 0.0
    battery = summary.get("battery_percent")
    return (
        module,
        segment,
        f"{share:.2f}",
        f"{_number(summary, 'clock_ppm'):+.1f}",
        f"{_number(summary, 'residual_us'):.0f}",
        "" if battery is None else f"{battery}",
    )


def _number(summary: Mapping[str, JsonValue], name: str) -> float:
    value = summary.get(name)
    try:
        return float(value) if isinstance(value, int | float) else 0.0
    except OverflowError:  # JSON has integers of any length
        return 0.0


def _html_row(cells_and_doubt: tuple[str, ...]) -> str:
    *row, doubt = cells_and_doubt
    lost = row[2]
    is_bad = bool(doubt) or lost == "silent" or float(lost) > _LOSSY_PERCENT
    colour = "color:rgb(225,60,50)" if is_bad else ""
    cells = "".join(
        f'<td style="padding:1px 4px;white-space:nowrap">{html.escape(cell)}</td>' for cell in row
    )
    reason = (
        f'<tr style="{colour}"><td></td><td colspan="{len(_COLUMNS) - 1}" style="padding:0 4px 3px">'
        f"doubtful: {html.escape(doubt)}</td></tr>"
    )
    return f'<tr style="{colour}">{cells}</tr>{reason if doubt else ""}'
