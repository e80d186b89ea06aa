"""The page: one HTML file that loads nothing from elsewhere, and prints well."""

from __future__ import annotations

import base64
import html
import json
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from gateway.errors import GatewayError
from gateway.frames import Status
from gateway.report import plots
from gateway.report.gathering import Findings, ModuleFindings
from gateway.stream import ClockMode

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
_BAD_LOSS_PERCENT = 1.0


def write_report(found: Findings, target: Path) -> None:
    """Write the page. Raises ``GatewayError`` without matplotlib, or when it cannot be written."""
    plots.require_matplotlib()
    text = page(found)
    try:
        target.write_text(text, encoding="utf-8")
    except OSError as error:
        raise GatewayError(f"{target} cannot be written: {error.strerror}") from error


def page(found: Findings) -> str:
    """The page as text; the same recording always gives the same."""
    title = found.summary.name or Path(found.summary.path).stem
    body = "\n".join(
        [
            f"<h1>{html.escape(title)}</h1>",
            f'<p class="sub">{html.escape(_subtitle(found))}</p>',
            *_warnings(found),
            _tiles(found),
            *_module_sections(found),
            *_pose_sections(found),
            *_event_section(found),
            *_settings_sections(found),
        ]
    )
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{html.escape(title)}</title>'
        f"<style>{_STYLE}</style></head><body>\n{body}\n</body></html>\n"
    )


def _subtitle(found: Findings) -> str:
    summary, meta = found.summary, found.recording.meta
    when = "date not known"
    if summary.begun_utc_ns:
        when = datetime.fromtimestamp(summary.begun_utc_ns * 1e-9, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
    return f"{Path(summary.path).name} · {when} · recorded by mocap-gateway {meta.software or '?'}"


def _warnings(found: Findings) -> Iterator[str]:
    summary, meta = found.summary, found.recording.meta
    if summary.defect:
        yield _warning(summary.defect)
    if found.suit is None:
        yield _warning("The recording tells no suit: modules and poses are not shown.")
    elif found.poses is None:
        yield _warning("No poses were recorded: `mocap-gateway replay FILE --output NEW.mcap` makes them.")
    if not meta.from_start:
        yield _warning(
            "It began while the gateway ran: a replay is close to what was live, not bit-identical."
        )


def _tiles(found: Findings) -> str:
    summary = found.summary
    minutes, seconds = divmod(summary.duration_s, 60)
    lost = sum(float(np.nansum(module.lost)) for module in found.modules)
    sent = lost + sum(float(np.nansum(module.received)) for module in found.modules)
    rate = found.n_poses / summary.duration_s if summary.duration_s else 0.0
    tiles = [
        (f"{int(minutes)}:{seconds:04.1f}", "duration, min:s"),
        (str(len(found.modules)), "modules and devices"),
        (f"{100 * lost / sent:.2f} %" if sent else "?", "packets lost"),
        (str(found.n_poses), f"poses, {rate:.1f} a second"),
        (_share_measured(found), "of orientations measured"),
        (f"{summary.bytes / 1e6:.1f} MB", f"in {summary.parts} file{'s' if summary.parts > 1 else ''}"),
    ]
    return '<div class="tiles">' + "".join(
        f'<div class="tile"><b>{html.escape(value)}</b><span>{html.escape(what)}</span></div>'
        for value, what in tiles
    ) + "</div>"  # fmt: skip


def _share_measured(found: Findings) -> str:
    total = int(found.status_counts.sum())
    return f"{100 * int(found.status_counts[:, Status.MEASURED].sum()) / total:.1f} %" if total else "–"


def _module_sections(found: Findings) -> Iterator[str]:
    if not found.modules:
        return
    heads = ("module", "on", "received", "lost", "loss %", "longest gap", "duplicates", "restarts",
             "clock ppm", "residual ms", "battery %", "firmware")  # fmt: skip
    yield "<h2>Modules</h2>" + _table(heads, [_module_row(module) for module in found.modules], n_texts=2)
    yield "<h2>Loss over time</h2>" + _picture(plots.loss(found), "packets lost by module over time")
    yield "<h2>Clocks</h2>"
    if found.recording.meta.settings.clock.mode is ClockMode.SHARED:
        yield "<p>All modules count one clock: there are no rates and residuals to tell apart.</p>"
    else:
        yield _picture(plots.clocks(found), "clock rates and residuals by module over time")


def _module_row(module: ModuleFindings) -> list[str]:
    totals = module.totals
    gaps = list(totals.get("gaps", {}))
    residuals = module.residual_us[np.isfinite(module.residual_us)]
    residual_ms = float(residuals[-1]) * 1e-3 if len(residuals) else float("nan")
    loss = f"{module.loss_percent:.2f}"
    return [
        str(module.module), module.segment, str(totals.get("received", "")), str(totals.get("lost", "")),
        f"!{loss}" if module.loss_percent > _BAD_LOSS_PERCENT else loss, gaps[-1] if gaps else "–",
        str(totals.get("duplicates", "")), str(totals.get("restarts", "")),
        f"{totals.get('clock_ppm', 0):+.1f}", f"{residual_ms:.2f}", str(totals.get("battery_percent", "–")),
        str(totals.get("firmware_version", "–")),
    ]  # fmt: skip


def _pose_sections(found: Findings) -> Iterator[str]:
    poses = found.poses
    if poses is None:
        return
    yield "<h2>Status</h2>" + _picture(plots.status(poses), "status of every segment over time")
    names = [status.name.lower().replace("_", " ") for status in Status]
    totals = np.maximum(found.status_counts.sum(axis=1), 1)[:, None]
    shares = 100.0 * found.status_counts / totals
    rows = [
        [segment, *(f"{share:.2f}" if share else "" for share in row)]
        for segment, row in zip(poses.segment_names, shares, strict=True)
    ]
    yield _table(("% of poses", *names), rows)
    yield "<h2>Confidence</h2>"
    if np.isfinite(poses.sigma).any():
        yield _picture(plots.sigma(poses), "standard deviation of every orientation over time")
    else:
        yield "<p>The method that made these poses gives no standard deviation of its own.</p>"
    yield "<h2>Orientations, ° against the neutral posture</h2>" + _picture(
        plots.orientations(poses), "heading, pitch and roll of every segment"
    )
    if found.joint_angles is not None and poses.skeleton.joints:
        picture = plots.joints(poses, found.joint_angles)
        yield "<h2>Joint angles, °</h2>" + _picture(picture, "angles of every joint over time")


def _event_section(found: Findings) -> Iterator[str]:
    begun_ns = found.recording.meta.begun_ns
    rows = [
        [f"{(event.time_ns - begun_ns) * 1e-9:.3f}", event.name, json.dumps(event.data, ensure_ascii=False)]
        for event in found.events
    ]
    yield "<h2>Events</h2>"
    yield _table(("s", "event", ""), rows, n_texts=3) if rows else "<p>None was recorded.</p>"
    if found.more_events:
        yield f"<p>… and {found.more_events} more.</p>"


def _settings_sections(found: Findings) -> Iterator[str]:
    meta = found.recording.meta
    if found.suit is not None:
        settings = json.dumps(meta.settings.model_dump(mode="json"), indent=1)
        yield f"<h2>Settings</h2><pre>{html.escape(settings)}</pre>"
        yield f"<h2>Rig</h2><pre>{html.escape(meta.rig)}</pre>"
    rows = [
        [key, json.dumps(value) if isinstance(value, dict) else str(value)]
        for key, value in meta.host.items()
    ]
    yield "<h2>Software</h2>" + _table(("", ""), rows, n_texts=2)


def _table(heads: Sequence[str], rows: Sequence[Sequence[str]], n_texts: int = 1) -> str:
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


def _warning(text: str) -> str:
    return f'<p class="warn">{html.escape(text)}</p>'


def _picture(png: bytes, meaning: str) -> str:
    data = base64.b64encode(png).decode()
    return f'<figure><img alt="{html.escape(meaning)}" src="data:image/png;base64,{data}"></figure>'
