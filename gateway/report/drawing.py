"""How the pictures of all reports are drawn, as PNG bytes. Needs matplotlib (extra ``plot``)."""

from __future__ import annotations

import importlib.util
import io
from collections.abc import Sequence
from typing import Any

from devices.extras import how_to_add
from gateway.errors import GatewayError
from gateway.frames import FloatArray

_DPI = 110
_WIDTH_IN = 10.0
_COLUMNS = 3
LINES = ("#1f6fb2", "#e07a1f", "#4f9d4f")
"""Colours of the first three lines of a panel."""


def require_matplotlib() -> None:
    """Raises ``GatewayError`` where the extra is not installed."""
    if importlib.util.find_spec("matplotlib") is None:
        raise GatewayError(f"a report needs the extra 'plot': {how_to_add('plot')}")


def small_multiples(times: FloatArray, shown: Sequence[tuple[str, FloatArray, tuple[str, ...]]]) -> bytes:
    rows = -(-len(shown) // _COLUMNS)
    figure, axes = panels(len(shown), 1.55 * rows + 0.3, _COLUMNS)
    for panel, (title, values, names) in zip(axes, shown, strict=False):
        for line, name in enumerate(names):
            panel.plot(times, values[:, line], lw=0.8, color=LINES[line], label=name.replace("_", " "))
        panel.set_title(title.replace("_", " "), fontsize=8)
        panel.legend(fontsize=5, loc="upper right", handlelength=1, borderpad=0.2, framealpha=0.6)
    for panel in axes[-_COLUMNS:]:
        panel.set_xlabel("s", fontsize=7)
    return png(figure)


def panels(count: int, height_in: float, columns: int | None = None) -> tuple[Any, list[Any]]:
    """A figure and its axes, those beyond ``count`` switched off.

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
    """So many colours (RGBA) that are told apart, in the order of the rainbow."""
    from matplotlib import colormaps  # noqa: PLC0415 - an extra

    return [colormaps["nipy_spectral"](0.05 + 0.87 * i / max(count - 1, 1)) for i in range(count)]


def png(figure: Any) -> bytes:
    target = io.BytesIO()
    figure.savefig(target, format="png", dpi=_DPI, metadata={"Software": None})
    return target.getvalue()
