"""The last seconds of some series, and their plot on a page."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np
import viser

from gateway.frames import FloatArray

PLOT_SPAN_S = 10.0
_LINE_COLOURS = ("#d1495b", "#2e7d5b", "#30638e", "#edae49", "#8d5a97", "#5c5c5c")


class History:
    """Rows of values against time; those older than the span are forgotten."""

    def __init__(self, names: Sequence[str], span_s: float) -> None:
        self.names = tuple(names)
        self._span_s = span_s
        self._rows: deque[tuple[float, tuple[float, ...]]] = deque()

    def add(self, time_s: float, values: Sequence[float]) -> None:
        """Add one row; a time before the last clears the rest, as playback has jumped back."""
        if self._rows and time_s < self._rows[-1][0]:
            self._rows.clear()
        self._rows.append((time_s, tuple(values)))
        while self._rows[0][0] < time_s - self._span_s:
            self._rows.popleft()

    def arrays(self) -> tuple[FloatArray, ...]:
        """Return times relative to the last, s, then each series; one row of NaN where there is none yet."""
        if not self._rows:
            return (np.zeros(1), *(np.full(1, np.nan) for _ in self.names))
        times = np.array([time_s for time_s, _ in self._rows])
        values = np.array([row for _, row in self._rows])
        return (times - times[-1], *(np.ascontiguousarray(column) for column in values.T))


class SeriesPlot:
    """A few named series over the last seconds."""

    def __init__(self, server: viser.ViserServer, name: str) -> None:
        self._server = server
        self._title = ""
        self._history = History((), PLOT_SPAN_S)
        self._slot = server.gui.add_folder(name, expand_by_default=True)
        self._chart: viser.GuiUplotHandle | None = None
        self._is_changed = False

    def name(self, name: str) -> None:
        """Call it so from now on."""
        self._slot.label = name

    def add(self, title: str, t_ns: int, names: Sequence[str], values: Sequence[float]) -> None:
        """Add one instant; another title or other names begin another plot."""
        if title != self._title or tuple(names) != self._history.names:
            self._title, self._history = title, History(names, PLOT_SPAN_S)
            if self._chart is not None:
                self._chart.remove()
                self._chart = None
        self._history.add(t_ns * 1e-9, values)
        self._is_changed = True

    def draw(self) -> None:
        """Send the series to the pages, if there is anything new."""
        if not self._is_changed:
            return
        self._is_changed = False
        data = self._history.arrays()
        if self._chart is not None:
            self._chart.data = data
            return
        with self._slot:
            self._chart = self._server.gui.add_uplot(
                data,
                (
                    viser.uplot.Series(label="s"),
                    *(
                        viser.uplot.Series(label=name, stroke=colour, width=2)
                        for name, colour in zip(self._history.names, _LINE_COLOURS, strict=False)
                    ),
                ),
                title=self._title,
                scales={"x": viser.uplot.Scale(time=False, auto=True), "y": viser.uplot.Scale(auto=True)},
                aspect=1.6,
            )
