"""The pictures of a report, as PNG bytes. Needs matplotlib (extra ``plot``)."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from gateway.frames import FloatArray, Status
from gateway.recording.arrays import SkeletonArrays
from gateway.report.drawing import colours, panels, png, small_multiples
from gateway.report.gathering import Findings

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
    """Rate of every module's clock against the gateway's, and how far its stamps scatter."""
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
    """Heading, pitch and roll of every segment against its neutral posture, degrees."""
    angles = _heading_pitch_roll(poses)
    return small_multiples(
        poses.time_s,
        [(name, angles[:, s], ("heading", "pitch", "roll")) for s, name in enumerate(poses.segment_names)],
    )


def joints(poses: SkeletonArrays, angles: FloatArray) -> bytes:
    """Angles of every joint, degrees."""
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
    """Standard deviation of the orientations, as the method itself judges it."""
    figure, axes = panels(1, 3.2)
    for s, colour in enumerate(colours(len(poses.segment_names))):
        axes[0].plot(
            poses.time_s, np.degrees(poses.sigma[:, s]), lw=0.9, color=colour, label=poses.segment_names[s]
        )
    axes[0].set(xlabel="s", ylabel="sigma, °", yscale="log")
    figure.legend(loc="outside lower center", ncols=6, fontsize=6, frameon=False)
    return png(figure)


def status(poses: SkeletonArrays) -> bytes:
    """Where every segment's orientation came from, over time."""
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
    """(F, S, 3) degrees, continuous; NaN where not known."""
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
        whole = np.isfinite(angles[:, s, 0])
        angles[whole, s] = np.unwrap(angles[whole, s], axis=0)
    degrees: FloatArray = np.degrees(angles)
    return degrees


def _extent(found: Findings, table: FloatArray) -> tuple[float, float, float, float]:
    width = 2 * float(found.bin_times_s[0])
    return 0.0, width * table.shape[1], len(table) - 0.5, -0.5


def _label(module: Any) -> str:
    return f"{module.module} {module.segment}".strip()
