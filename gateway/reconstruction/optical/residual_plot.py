"""Residuals of all markers over time, as a picture."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

import numpy as np

from devices.extras import how_to_add
from gateway.errors import GatewayError
from gateway.frames import FloatArray

_SHOWN_MM = 30.0


class _Solved(Protocol):
    @property
    def labels(self) -> tuple[str, ...]: ...
    @property
    def residuals(self) -> FloatArray: ...


def write_residual_plot(solved: _Solved, rate_hz: float, path: Path) -> None:
    """A row a marker, a column a frame. Raises ``GatewayError`` without the extra ``plot``, or for a file
    that cannot be written."""
    try:
        from matplotlib.figure import Figure  # noqa: PLC0415 - an extra
    except ImportError:
        raise GatewayError(f"--plot needs the extra 'plot': {how_to_add('plot')}") from None
    residuals = 1e3 * np.asarray(solved.residuals)
    seconds = len(residuals) / rate_hz
    figure = Figure(figsize=(10, 0.16 * len(solved.labels) + 3), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(1, 3))
    times = np.arange(len(residuals)) / rate_hz
    with np.errstate(invalid="ignore"):
        rms = np.sqrt(np.nansum(residuals**2, axis=1) / np.maximum(np.isfinite(residuals).sum(axis=1), 1))
    above.plot(times, rms, linewidth=1)
    above.set_ylabel("RMS, mm")
    above.set_ylim(bottom=0)
    image = below.imshow(
        residuals.T, aspect="auto", interpolation="nearest", vmin=0, vmax=_SHOWN_MM, cmap="viridis",
        extent=(0.0, seconds, len(solved.labels) - 0.5, -0.5),
    )  # fmt: skip
    below.set_yticks(range(len(solved.labels)), solved.labels, fontsize=6)
    below.set_xlabel("time, s (white: not seen)")
    figure.colorbar(image, ax=below, label="distance of marker and body, mm", extend="max")
    try:
        figure.savefig(path, dpi=120)
    except (OSError, ValueError) as error:
        raise GatewayError(f"{path} cannot be written: {error}") from error
