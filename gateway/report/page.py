"""The page: one HTML file that loads nothing from elsewhere, and prints well."""

from __future__ import annotations

import html
import json
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from gateway.frames import Status
from gateway.report import drawing, plots
from gateway.report.elements import document, picture, table, tiles, warning
from gateway.report.gathering import Findings, ModuleFindings
from gateway.sources.module_table import ClockMode
from gateway.support.whole_files import writing

_BAD_LOSS_PERCENT = 1.0


def write_report(found: Findings, target: Path) -> None:
    """Write the page. Raises ``GatewayError`` without matplotlib, or when it cannot be written."""
    drawing.require_matplotlib()
    text = page(found)
    with writing(target):
        target.write_text(text, encoding="utf-8")


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
    return document(title, body)


def _subtitle(found: Findings) -> str:
    summary, meta = found.summary, found.recording.meta
    when = "date not known"
    if summary.begun_utc_ns:
        when = datetime.fromtimestamp(summary.begun_utc_ns * 1e-9, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
    return f"{Path(summary.path).name} · {when} · recorded by mocap-gateway {meta.software or '?'}"


def _warnings(found: Findings) -> Iterator[str]:
    summary, meta = found.summary, found.recording.meta
    if summary.defect:
        yield warning(summary.defect)
    if found.suit is None:
        yield warning("The recording tells no suit: modules and poses are not shown.")
    elif found.poses is None:
        yield warning("No poses were recorded: `mocap-gateway replay FILE --output NEW.mcap` makes them.")
    if not meta.from_start:
        yield warning(
            "It began while the gateway ran: a replay is close to what was live, not bit-identical."
        )


def _tiles(found: Findings) -> str:
    summary = found.summary
    minutes, seconds = divmod(summary.duration_s, 60)
    lost = sum(float(np.nansum(module.lost)) for module in found.modules)
    sent = lost + sum(float(np.nansum(module.received)) for module in found.modules)
    rate = found.n_poses / summary.duration_s if summary.duration_s else 0.0
    figures = [
        (f"{int(minutes)}:{seconds:04.1f}", "duration, min:s"),
        (str(len(found.modules)), "modules and devices"),
        (f"{100 * lost / sent:.2f} %" if sent else "?", "packets lost"),
        (str(found.n_poses), f"poses, {rate:.1f} a second"),
        (_share_measured(found), "of orientations measured"),
        (f"{summary.bytes / 1e6:.1f} MB", f"in {summary.parts} file{'s' if summary.parts > 1 else ''}"),
    ]
    return tiles(figures)


def _share_measured(found: Findings) -> str:
    total = int(found.status_counts.sum())
    return f"{100 * int(found.status_counts[:, Status.MEASURED].sum()) / total:.1f} %" if total else "–"


def _module_sections(found: Findings) -> Iterator[str]:
    if not found.modules:
        return
    heads = ("module", "on", "received", "lost", "loss %", "longest gap", "duplicates", "restarts",
             "clock ppm", "residual ms", "battery %", "firmware")  # fmt: skip
    yield "<h2>Modules</h2>" + table(heads, [_module_row(module) for module in found.modules], n_texts=2)
    yield "<h2>Loss over time</h2>" + picture(plots.loss(found), "packets lost by module over time")
    yield "<h2>Clocks</h2>"
    if found.recording.meta.settings.clock.mode is ClockMode.SHARED:
        yield "<p>All modules count one clock: there are no rates and residuals to tell apart.</p>"
    else:
        yield picture(plots.clocks(found), "clock rates and residuals by module over time")


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
    yield "<h2>Status</h2>" + picture(plots.status(poses), "status of every segment over time")
    names = [status.name.lower().replace("_", " ") for status in Status]
    totals = np.maximum(found.status_counts.sum(axis=1), 1)[:, None]
    shares = 100.0 * found.status_counts / totals
    rows = [
        [segment, *(f"{share:.2f}" if share else "" for share in row)]
        for segment, row in zip(poses.segment_names, shares, strict=True)
    ]
    yield table(("% of poses", *names), rows)
    yield "<h2>Confidence</h2>"
    if np.isfinite(poses.sigma).any():
        yield picture(plots.sigma(poses), "standard deviation of every orientation over time")
    else:
        yield "<p>The method that made these poses gives no standard deviation of its own.</p>"
    yield "<h2>Orientations, ° against the neutral posture</h2>" + picture(
        plots.orientations(poses), "heading, pitch and roll of every segment"
    )
    if found.joint_angles is not None and poses.skeleton.joints:
        drawn = plots.joints(poses, found.joint_angles)
        yield "<h2>Joint angles, °</h2>" + picture(drawn, "angles of every joint over time")


def _event_section(found: Findings) -> Iterator[str]:
    begun_ns = found.recording.meta.begun_ns
    rows = [
        [f"{(event.time_ns - begun_ns) * 1e-9:.3f}", event.name, json.dumps(event.data, ensure_ascii=False)]
        for event in found.events
    ]
    yield "<h2>Events</h2>"
    yield table(("s", "event", ""), rows, n_texts=3) if rows else "<p>None was recorded.</p>"
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
    yield "<h2>Software</h2>" + table(("", ""), rows, n_texts=2)
