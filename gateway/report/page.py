"""The page of a recording, with its pictures: one HTML file that loads nothing, and prints well."""

from __future__ import annotations

import html
import json
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from devices.deferred import Rotation
from gateway.frames import FloatArray, Status
from gateway.recording.arrays import SkeletonArrays
from gateway.report.elements import (
    colours,
    document,
    panels,
    picture,
    png,
    small_multiples,
    table,
    tiles,
    warning,
)
from gateway.report.gathering import Findings, ModuleFindings
from gateway.sources.clock_mode import ClockMode
from gateway.support.extras import require_package
from gateway.support.whole_files import write_whole, writing

_STATUS_COLOURS = {
    Status.MEASURED: "#2e9e5b",
    Status.INTERPOLATED: "#a8d08d",
    Status.HELD: "#f2c14e",
    Status.PREDICTED: "#8ab6e8",
    Status.WARMING_UP: "#cdb4db",
    Status.MISSING: "#d1495b",
    Status.UNAIDED: "#e07a1f",
    Status.DOUBTFUL: "#b5179e",
}


def loss(found: Findings) -> bytes:
    """Share of packets lost, module by time."""
    figure, axes = panels(1, 0.22 * len(found.modules) + 1.2)
    sent = np.array([module.lost + module.received for module in found.modules])
    with np.errstate(invalid="ignore", divide="ignore"):
        share = 100.0 * np.array([module.lost for module in found.modules]) / sent
    ceiling = max(float(np.nanmax(share, initial=0.0)), 1.0)
    image = axes[0].imshow(share, aspect="auto", cmap="YlOrRd", vmin=0, vmax=ceiling,
                           extent=_extent(found, share), interpolation="nearest")  # fmt: skip
    axes[0].set_yticks(range(len(found.modules)), [_label(module) for module in found.modules], fontsize=7)
    axes[0].set_xlabel("s")
    figure.colorbar(image, ax=axes[0], label="lost, %", pad=0.01)
    return png(figure)


def clocks(found: Findings) -> bytes:
    """Return the rate of every module's clock against the gateway's, and how far its stamps scatter."""
    figure, axes = panels(2, 3.4)
    shades = colours(len(found.modules))
    for module, colour in zip(found.modules, shades, strict=True):
        axes[0].plot(found.bin_times_s, module.clock_ppm, lw=0.9, color=colour, label=_label(module))
        axes[1].plot(found.bin_times_s, module.residual_us * 1e-3, lw=0.9, color=colour)
    axes[0].set(title="clock rate, ppm", xlabel="s")
    axes[1].set(title="residual of arrival times, ms", xlabel="s")
    figure.legend(loc="outside lower center", ncols=6, fontsize=6, frameon=False)
    return png(figure)


def orientations(poses: SkeletonArrays) -> bytes:
    """Return heading, pitch and roll of every segment against its neutral posture, degrees."""
    angles = _heading_pitch_roll(poses)
    return small_multiples(
        poses.time_s,
        [(name, angles[:, s], ("heading", "pitch", "roll")) for s, name in enumerate(poses.segment_names)],
    )


def joints(poses: SkeletonArrays, angles: FloatArray) -> bytes:
    """Return a picture of the angles of every joint, °."""
    rows = [
        (
            joint.name,
            np.degrees(angles[:, j, : len(joint.angles)]),
            tuple(angle.name for angle in joint.angles),
        )
        for j, joint in enumerate(poses.skeleton.joints)
    ]
    return small_multiples(poses.time_s, rows)


def sigma(poses: SkeletonArrays) -> bytes:
    """Return the standard deviation of the orientations, as the method itself judges it."""
    figure, axes = panels(1, 3.2)
    for s, colour in enumerate(colours(len(poses.segment_names))):
        axes[0].plot(
            poses.time_s, np.degrees(poses.sigma[:, s]), lw=0.9, color=colour, label=poses.segment_names[s]
        )
    axes[0].set(xlabel="s", ylabel="sigma, °", yscale="log")
    figure.legend(loc="outside lower center", ncols=6, fontsize=6, frameon=False)
    return png(figure)


def status(poses: SkeletonArrays) -> bytes:
    """Return where every segment's orientation came from, over time."""
    from matplotlib.colors import ListedColormap  # noqa: PLC0415 - an extra
    from matplotlib.patches import Patch  # noqa: PLC0415

    figure, axes = panels(1, 0.22 * len(poses.segment_names) + 1.2)
    span = (0.0, max(float(poses.time_s[-1]), 1e-3), len(poses.segment_names) - 0.5, -0.5)
    colours = ListedColormap([_STATUS_COLOURS[each] for each in Status])
    axes[0].imshow(poses.status.T, aspect="auto", cmap=colours, vmin=-0.5, vmax=len(Status) - 0.5,
                   extent=span, interpolation="nearest")  # fmt: skip
    axes[0].set_yticks(range(len(poses.segment_names)), poses.segment_names, fontsize=7)
    axes[0].set_xlabel("s")
    names = [Patch(color=_STATUS_COLOURS[each], label=each.name.lower().replace("_", " ")) for each in Status]
    figure.legend(handles=names, loc="outside lower center", ncols=6, fontsize=7, frameon=False)
    return png(figure)


def _heading_pitch_roll(poses: SkeletonArrays) -> FloatArray:
    """Return (F, S, 3) degrees, continuous; NaN where not known."""
    shape = poses.q_wb.shape[:2]
    flat = poses.q_wb.reshape(-1, 4)
    known = np.isfinite(flat).all(axis=1)
    angles = np.full((len(flat), 3), np.nan)
    if known.any():
        neutral = Rotation.from_quat(poses.skeleton.neutral, scalar_first=True)
        turned = Rotation.from_quat(flat[known], scalar_first=True) * neutral.inv()
        angles[known] = turned.as_euler("ZYX")
    angles = angles.reshape(*shape, 3)
    for s in range(shape[1]):
        # np.unwrap hands a NaN on to all that follows, so instants without a pose are left out.
        whole = np.isfinite(angles[:, s, 0])
        angles[whole, s] = np.unwrap(angles[whole, s], axis=0)
    degrees: FloatArray = np.degrees(angles)
    return degrees


def _extent(found: Findings, table: FloatArray) -> tuple[float, float, float, float]:
    width = 2 * float(found.bin_times_s[0])
    return 0.0, width * table.shape[1], len(table) - 0.5, -0.5


def _label(module: Any) -> str:
    return f"{module.module} {module.segment}".strip()


_BAD_LOSS_PERCENT = 1.0


def write_report(found: Findings, target: Path) -> None:
    """Write the page. Raises ``GatewayError`` without matplotlib, or when it cannot be written."""
    require_package("matplotlib")
    text = page(found)
    with writing(target):
        write_whole(target, text.encode())


def page(found: Findings) -> str:
    """Return the page as text; the same recording always gives the same."""
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
    yield "<h2>Loss over time</h2>" + picture(loss(found), "packets lost by module over time")
    yield "<h2>Clocks</h2>"
    if found.recording.meta.settings.clock.mode is ClockMode.SHARED:
        yield "<p>All modules count one clock: there are no rates and residuals to tell apart.</p>"
    else:
        yield picture(clocks(found), "clock rates and residuals by module over time")


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
    yield "<h2>Status</h2>" + picture(status(poses), "status of every segment over time")
    names = [status.name.lower().replace("_", " ") for status in Status]
    # A segment without any pose must not divide by zero.
    totals = np.maximum(found.status_counts.sum(axis=1), 1)[:, None]
    shares = 100.0 * found.status_counts / totals
    rows = [
        [segment, *(f"{share:.2f}" if share else "" for share in row)]
        for segment, row in zip(poses.segment_names, shares, strict=True)
    ]
    yield table(("% of poses", *names), rows)

    yield "<h2>Confidence</h2>"
    if np.isfinite(poses.sigma).any():
        yield picture(sigma(poses), "standard deviation of every orientation over time")
    else:
        yield "<p>The method that made these poses gives no standard deviation of its own.</p>"
    yield "<h2>Orientations, ° against the neutral posture</h2>" + picture(
        orientations(poses), "heading, pitch and roll of every segment"
    )
    if found.joint_angles is not None and poses.skeleton.joints:
        drawn = joints(poses, found.joint_angles)
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
