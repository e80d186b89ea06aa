"""Loss and clock of every module, from the health message, as HTML."""

from __future__ import annotations

import html
from collections import deque
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import JsonValue

from firmware_protocol import RELAY
from gateway.contract.messages import BridgeHealth, BridgeInfo
from gateway.frames import Status
from gateway.viewer.texts import ENGLISH, segment_name, translated

_COLUMNS = ("id", "segment", "col_battery", "col_lost", "ppm", "± µs")
_LOST_COLUMN = 3
_LOSSY_PERCENT = 1.0
RELAY_NAME = str(RELAY)
MUCH_LOST = 0.02
"""Share of samples lost from which on a strip warns."""
LATE_S = 0.25
"""Latency from which on it does."""
_STOPPED = "stopped"
"""Why a recording has ended that was ended by a request."""
_SPAN_NS = 10_000_000_000


def module_rows(
    health: BridgeHealth | None,
    info: BridgeInfo | None,
    silent: Collection[str] = (),
    language: str = ENGLISH,
) -> list[tuple[str, ...]]:
    """Return one row of texts a module: those of the rig, and others that were heard.

    The last cell says why it is red, with a remedy; it is empty for others.
    """
    modules = health.statistics.get("modules", {}) if health is not None else {}
    doubts = health.statistics.get("doubts", {}) if health is not None else {}
    why: Mapping[str, JsonValue] = doubts if isinstance(doubts, dict) else {}
    summaries: Mapping[str, JsonValue] = modules if isinstance(modules, dict) else {}
    worn = {str(m.module): m.segment for m in info.modules} if info is not None else {}
    # Sorted by length first, so that 2 comes before 10.
    names = sorted({*summaries, *worn}, key=lambda name: (len(name), name))
    others = {name: translated(language, "relay" if name == RELAY_NAME else "not_in_rig") for name in names}
    found: list[tuple[str, ...]] = []
    for name in names:
        place = worn.get(name, others[name])
        # A module that has gone silent still has its counters of before; shown, they would look alive.
        summary = None if place in silent else summaries.get(name)
        row = _row(name, place, summary, language)
        doubt = str(why.get(name, ""))
        found.append((*row, _why_red(isinstance(summary, dict), row[_LOST_COLUMN], doubt, language)))
    return found


def _why_red(is_reporting: bool, lost: str, doubt: str, language: str) -> str:
    """Return what is wrong with a module and the remedy, or an empty text; ``lost`` is a cell of its row."""
    if not is_reporting:
        return translated(language, "remedy_silent", tab=translated(language, "tab"))
    if doubt:
        return doubt
    return translated(language, "remedy_lossy") if float(lost) > _LOSSY_PERCENT else ""


def module_table(rows: list[tuple[str, ...]], language: str = ENGLISH) -> str:
    """Return the rows as an HTML table; modules that lose over a per cent, or are doubtful, stand out."""
    names = (translated(language, key) if key.isidentifier() and key != "ppm" else key for key in _COLUMNS)
    head = "".join(f'<th style="text-align:left;padding:1px 4px">{name}</th>' for name in names)
    body = "".join(_html_row(row) for row in rows)
    return (
        '<div style="padding:0 6px;overflow-x:auto">'
        '<table style="font-size:11px;border-collapse:collapse;width:100%">'
        f"<tr>{head}</tr>{body}</table></div>"
    )


class RecentLosses:
    """The share of all modules' samples that was lost within the last seconds, from health messages."""

    def __init__(self) -> None:
        self._counted: deque[tuple[int, float, float]] = deque()

    def add(self, health: BridgeHealth | None) -> None:
        """Take a health message; one that was taken before changes nothing."""
        if health is None or (self._counted and self._counted[-1][0] == health.t_ns):
            return
        modules = health.statistics.get("modules", {})
        summaries = (
            [one for one in modules.values() if isinstance(one, dict)] if isinstance(modules, dict) else []
        )
        received, lost = (sum(_number(one, name) for one in summaries) for name in ("received", "lost"))
        if self._counted and (health.t_ns < self._counted[-1][0] or received < self._counted[-1][1]):
            self._counted.clear()  # another start of the gateway
        self._counted.append((health.t_ns, received, lost))
        while len(self._counted) > 2 and self._counted[1][0] < health.t_ns - _SPAN_NS:
            self._counted.popleft()

    @property
    def share(self) -> float:
        """0 to 1; 0 before two messages have come."""
        if len(self._counted) < 2:
            return 0.0
        (_, received, lost), (_, received_now, lost_now) = self._counted[0], self._counted[-1]
        new_lost = max(0.0, lost_now - lost)
        return new_lost / max(1.0, received_now - received + new_lost)


class RecordingStatus:
    """What the gateway said last of its recording; the clock goes on until it says more."""

    def __init__(self) -> None:
        self._status: Mapping[str, object] = {}
        self._status_ns = 0

    def take(self, status: object, status_ns: int) -> None:
        """Take the status of a health message or an answer; one older than the last is ignored."""
        if isinstance(status, Mapping) and status_ns > self._status_ns:
            self._status, self._status_ns = status, status_ns

    def now(self, now_ns: int) -> Mapping[str, object]:
        """Return the status, its seconds extrapolated to now."""
        seconds = self._status.get("seconds")
        if self._status.get("state") != "recording" or not isinstance(seconds, int | float):
            return self._status
        return {**self._status, "seconds": seconds + max(0, now_ns - self._status_ns) * 1e-9}


def health_line(
    worn: int, silent: int, lost: float, recording: Mapping[str, object], language: str = ENGLISH
) -> str:
    """Return how modules, losses and the disk stand: ``16 of 17 modules, 0.2 % lost, 80.9 GB free``.

    lost: share of the samples, 0 to 1. recording: the gateway's status of it, which has the disk's room.
    """
    parts = [translated(language, "modules_heard", reporting=worn - silent, worn=worn)] if worn else []
    parts.append(translated(language, "share_lost", percent=f"{100 * lost:.1f}"))
    free_mb = recording.get("free_mb")
    if isinstance(free_mb, int | float):
        parts.append(translated(language, "gb_free", gb=f"{free_mb / 1e3:.1f}"))
    return ", ".join(parts)


def warnings_of(
    lost: float,
    latency_s: float,
    recording: Mapping[str, object] | None = None,
    language: str = ENGLISH,
) -> tuple[str, ...]:
    """Return warnings with their remedies; ``lost`` is a share of the samples, 0 to 1."""
    found = []
    if lost >= MUCH_LOST:
        found.append(
            translated(
                language, "warn_lost", percent=f"{100 * lost:.0f}", modules=translated(language, "modules")
            )
        )
    if latency_s >= LATE_S:
        found.append(translated(language, "warn_late", seconds=f"{latency_s:.1f}"))
    status = recording or {}
    if (why := status.get("ended", _STOPPED)) != _STOPPED:  # else it would be missed when it is wanted
        found.append(translated(language, "warn_ended", why=why))
    elif status.get("is_low"):
        found.append(translated(language, "warn_disk"))
    return tuple(found)


def clock_of(seconds: object) -> str:
    """Return ``1:05`` of 65.2; ``0:00`` of what is no number."""
    whole = int(seconds) if isinstance(seconds, int | float) else 0
    minutes = f"{whole // 60 % 60:02d}" if whole >= 3600 else f"{whole // 60}"
    return f"{f'{whole // 3600}:' if whole >= 3600 else ''}{minutes}:{whole % 60:02d}"


def recorded_rows(
    segments: Sequence[str], status: NDArray[np.integer[Any]], language: str = ENGLISH
) -> list[tuple[str, ...]]:
    """Return one row a segment of a recording: percentages measured, held and missing.

    status: (T, S) numbers of ``Status``.
    """
    kinds = (Status.MEASURED, Status.INTERPOLATED, Status.MISSING)
    return [
        (
            segment_name(language, name),
            *(f"{100.0 * float(np.mean(status[:, s] == kind)):.1f}" for kind in kinds),
        )
        for s, name in enumerate(segments)
    ]


def recorded_table(rows: list[tuple[str, ...]], language: str = ENGLISH) -> str:
    """Return rows of ``recorded_rows`` as an HTML table."""
    heads = [
        translated(language, key)
        for key in ("segment", "share_measured", "share_interpolated", "share_missing")
    ]
    cells = (
        "<tr>" + "".join(f'<td style="padding:1px 4px">{html.escape(cell)}</td>' for cell in row) + "</tr>"
        for row in rows
    )
    head = "".join(f'<th style="text-align:left;padding:1px 4px">{name}</th>' for name in heads)
    return (
        '<div style="padding:0 6px;overflow-x:auto"><table style="font-size:11px;border-collapse:collapse">'
        f"<tr>{head}</tr>{''.join(cells)}</table></div>"
    )


def _row(module: str, segment: str, summary: JsonValue, language: str) -> tuple[str, ...]:
    if not isinstance(summary, dict):
        return (module, segment_name(language, segment), "", translated(language, "col_silent"), "", "")
    received, lost = _number(summary, "received"), _number(summary, "lost")
    share = 100.0 * lost / (received + lost) if received + lost else 0.0
    battery = summary.get("battery_percent")
    return (
        module,
        segment_name(language, segment),
        "" if battery is None else f"{battery} %",
        f"{share:.2f}",
        f"{_number(summary, 'clock_ppm'):+.1f}",
        f"{_number(summary, 'residual_us'):.0f}",
    )


def _number(summary: Mapping[str, JsonValue], name: str) -> float:
    value = summary.get(name)
    try:
        return float(value) if isinstance(value, int | float) else 0.0
    except OverflowError:  # JSON has integers of any length
        return 0.0


def _html_row(cells_and_why: tuple[str, ...]) -> str:
    *row, why = cells_and_why
    colour = "color:var(--mocap-poor)" if why else ""
    cells = "".join(
        f'<td style="padding:1px 4px;white-space:nowrap">{html.escape(cell)}</td>' for cell in row
    )
    reason = (
        f'<tr style="{colour}"><td></td><td colspan="{len(_COLUMNS) - 1}" style="padding:0 4px 3px">'
        f"{html.escape(why)}</td></tr>"
    )
    return f'<tr style="{colour}">{cells}</tr>{reason if why else ""}'
