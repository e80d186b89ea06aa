"""Beside the picture: how it goes, what to show, plots, modules, and the buttons."""

from __future__ import annotations

import html
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import viser

from gateway.contract.messages import PoseMessage
from gateway.viewer.appearance import legend
from gateway.viewer.marker_points import MarkerInstant
from gateway.viewer.module_table import clock_of
from gateway.viewer.pose_table import attitude, bend_deg
from gateway.viewer.series_plot import SeriesPlot
from gateway.viewer.stage import STYLE, VIEWS, ViewerStage
from gateway.viewer.step_tab import rename
from gateway.viewer.texts import ENGLISH, LANGUAGES, movement_name, segment_name, translated

_UNDEFINED = float("nan")
_RESIDUALS = ("of_markers", "")


class ButtonRow(NamedTuple):
    """Buttons side by side."""

    name: str
    """Its label is the text ``<name>_row``, that of an option ``<name>_<option>``."""
    options: tuple[str, ...]
    pressed: Callable[[str], None]
    """Called with the option, in a thread of the page's server."""


class _Offer(NamedTuple):
    """What the list of plots was made of."""

    language: str
    joints: tuple[str, ...]
    segments: tuple[str, ...]
    has_markers: bool


class Panel:
    """Made once; what is chosen in it is read by what draws."""

    def __init__(self, server: viser.ViserServer, rows: Sequence[ButtonRow], stage: ViewerStage) -> None:
        gui = server.gui
        self.language = ENGLISH
        self._listeners: list[Callable[[str], None]] = []
        self._rows: list[tuple[ButtonRow, viser.GuiButtonGroupHandle]] = []
        self._choices: dict[str, viser.GuiInputHandle[bool]] = {}
        self._root: str = "–"
        """Segment whose trail is offered."""

        gui.add_html(STYLE)
        self._warnings = gui.add_html("")
        self._status = gui.add_html("")
        self._recording = gui.add_html("")
        self.tabs = tabs = gui.add_tab_group()
        self._tabs = {name: tabs.add_tab(translated(ENGLISH, name)) for name in ("view", "plot", "modules")}
        with self._tabs["view"]:
            # On the tab that is shown first, not above all tabs: on a phone they would push the content of
            # the others below the edge of the page.
            for row in rows:
                self._add_row(gui, row, _on_any_page(row.pressed))
            self._answer = gui.add_html("")
            looks = ButtonRow("camera", VIEWS, lambda _view: None)
            self._add_row(gui, looks, lambda view, client: self._look(view, client, stage))
            language = gui.add_dropdown("Language / Sprache", tuple(LANGUAGES))
            language.on_update(lambda _: self.set_language(LANGUAGES[language.value]))
            self.bones = self._add_choice(gui, "bones", False)
            self.light = self._add_choice(gui, "light", False)
            self.axes = self._add_choice(gui, "axes", False)
            self.names = self._add_choice(gui, "names", False)
            self.trail = self._add_choice(gui, "trail", False)
            self.follow = self._add_choice(gui, "follow", True)
            self._legend = gui.add_html(legend())
        with self._tabs["plot"]:
            self._plotted = gui.add_dropdown(self.translated("of"), ("–",))
            self._plot = SeriesPlot(server, self.translated("last_seconds"))
        with self._tabs["modules"]:
            self._modules = gui.add_html("")

        self._shown: dict[int, str] = {}
        self._offered: _Offer | None = None
        self._series: dict[str, tuple[str, str]] = {}
        """What can be plotted: how it is called, and its kind and name."""
        self._has_markers = False
        self.parents: Mapping[str, str] = {}
        """Of the body's segments, for the bend of each against its parent."""

    def _add_row(
        self,
        gui: viser.GuiApi,
        row: ButtonRow,
        pressed: Callable[[str, viser.ClientHandle | None], None],
    ) -> None:
        texts = tuple(self.translated(f"{row.name}_{option}") for option in row.options)
        group = gui.add_button_group(self.translated(f"{row.name}_row"), texts)

        def clicked(event: viser.GuiEvent[Any]) -> None:
            # A press may cross a change of language, and then names a text that is no longer there.
            if event.target.value in group.options:
                pressed(row.options[group.options.index(event.target.value)], event.client)

        group.on_click(clicked)
        self._rows.append((row, group))

    def _add_choice(self, gui: viser.GuiApi, name: str, is_chosen: bool) -> viser.GuiInputHandle[bool]:
        choice = gui.add_checkbox(self._label(name), is_chosen)
        self._choices[name] = choice
        return choice

    def _label(self, choice: str) -> str:
        return self.translated(choice, name=segment_name(self.language, self._root))

    def name_root(self, segment: str) -> None:
        """Name the trail after the root of the body. That of a pose is another one with every step: the foot
        that stands."""
        self._root = segment
        self._choices["trail"].label = self._label("trail")

    def translated(self, key: str, **values: object) -> str:
        """Return a text in the page's language."""
        return translated(self.language, key, **values)

    def on_language(self, listener: Callable[[str], None]) -> None:
        """Call a listener with each language that is chosen, in a thread of the page's server."""
        self._listeners.append(listener)

    def set_language(self, language: str) -> None:
        """Say everything in that language from now on."""
        self.language = language
        for row, group in self._rows:
            group.label = self.translated(f"{row.name}_row")
            group.options = tuple(self.translated(f"{row.name}_{option}") for option in row.options)
        for name, choice in self._choices.items():
            choice.label = self._label(name)
        for name, tab in self._tabs.items():
            rename(self.tabs, tab, self.translated(name))
        self._legend.content = legend(language)
        self._plotted.label = self.translated("of")
        self._plot.name(self.translated("last_seconds"))
        for listener in self._listeners:
            listener(language)

    def add_pose(self, pose: PoseMessage) -> None:
        """Add a pose to the plot: attitudes of segments, and angles of joints where poses have them."""
        joints = pose.joint_angles or {}
        self._offer(_Offer(self.language, tuple(joints), tuple(pose.segments), self._has_markers))
        kind, name = self._series.get(self._plotted.value, ("", ""))
        plain = segment_name(self.language, name)
        if kind == "of_attitude":
            q_wb = pose.segments.get(name)
            angles = attitude(q_wb) if q_wb is not None else (_UNDEFINED,) * 3
            series = [self.translated(each) for each in ("heading", "pitch", "roll")]
            self._plot.add(self.translated("plot_angles", name=plain), pose.t_ns, series, angles)
        elif kind == "of_bend" and name in self.parents:
            parent = self.parents[name]
            bend = bend_deg(pose.segments.get(parent), pose.segments.get(name))
            title = self.translated("plot_bend", name=plain, parent=segment_name(self.language, parent))
            self._plot.add(title, pose.t_ns, (self.translated("bend"),), (bend,))
        elif kind == "of_angles" and joints.get(name):
            found = joints[name] or {}
            movements = [movement_name(self.language, movement) for movement in found]
            title = self.translated("plot_angles", name=plain)
            self._plot.add(title, pose.t_ns, movements, list(found.values()))

    def _offer(self, offer: _Offer) -> None:
        """Have the list of what can be plotted name all of it; the same series stays chosen."""
        if offer == self._offered:
            return
        chosen = self._series.get(self._plotted.value)
        of_each = (
            *(("of_angles", joint) for joint in offer.joints),
            *(("of_attitude", segment) for segment in offer.segments),
            *(("of_bend", segment) for segment in offer.segments if segment in self.parents),
            *((("of_markers", ""),) if offer.has_markers else ()),
        )
        self._offered = offer
        self._series = {
            self.translated(kind, name=segment_name(self.language, name)): (kind, name)
            for kind, name in of_each
        }
        self._plotted.options = tuple(self._series)
        for option, series in self._series.items():
            if series == chosen:
                self._plotted.value = option  # type: ignore[misc]  # as in _look

    def add_markers(self, t_ns: int, markers: MarkerInstant) -> None:
        """Add the markers of the same instant to the plot: their distances from the body."""
        self._has_markers = True
        residuals = 1e3 * markers.residuals
        if self._series.get(self._plotted.value) == _RESIDUALS and markers.used.any():
            values = (float(np.sqrt(np.mean(residuals[markers.used] ** 2))), float(residuals.max()))
            series = (self.translated("markers_rms"), self.translated("markers_farthest"))
            self._plot.add(self.translated("plot_markers"), t_ns, series, values)

    def draw_plot(self) -> None:
        """Bring the plot up to date."""
        self._plot.draw()

    def show_status(self, headline: str, *details: str, is_alarm: bool, is_busy: bool = False) -> None:
        """Show the lines on top; the first is red for an alarm, and a bar runs below it while busy."""
        colour = "var(--mocap-poor)" if is_alarm else "inherit"
        lines = "<br>".join(map(html.escape, details))
        self._set(
            self._status,
            f'<div style="padding:4px 12px"><div style="font-weight:600;font-size:15px;color:{colour}">'
            f"{html.escape(headline)}</div>"
            + (
                f'<progress aria-label="{html.escape(headline)}" style="width:100%"></progress>'
                if is_busy
                else ""
            )
            + f'<div style="font-size:12px">{lines}</div></div>',
        )

    def show_warnings(self, warnings: Sequence[str]) -> None:
        """Show what is wrong though poses come, in a coloured strip above all else; nothing: no strip."""
        lines = "<br>".join(f"&#9888; {html.escape(warning)}" for warning in warnings)
        strip = (
            '<div role="alert" style="margin:4px 8px;padding:6px 10px;border-radius:6px;font-size:13px;'
            f'font-weight:600;background:rgb(255,205,60);color:rgb(40,30,0)">{lines}</div>'
        )
        self._set(self._warnings, strip if lines else "")

    def show_recording(self, status: Mapping[str, object]) -> None:
        """Show a red light and a clock while the gateway records, by its status in the health message."""
        if status.get("state") != "recording":
            self._set(self._recording, "")
            return
        size = status.get("bytes")
        mega = f", {size / 1e6:.1f} MB" if isinstance(size, int) else ""
        name = html.escape(str(status.get("file", "")).rpartition("/")[2])
        self._set(
            self._recording,
            '<div style="padding:0 12px 4px;font-size:13px"><span style="display:inline-block;width:11px;'
            'height:11px;border-radius:6px;background:rgb(225,30,30);margin-right:6px"></span>'
            f"<b>REC {clock_of(status.get('seconds'))}</b>{mega} "
            f"<span style='font-size:11px'>{name}</span></div>",
        )

    def _look(self, view: str, client: viser.ClientHandle | None, stage: ViewerStage) -> None:
        """Apply a view that was chosen, on the page where it was chosen."""
        if view == "follow":
            # the library's property has a setter, which the type checker does not see
            self.follow.value = True  # type: ignore[misc]
        stage.look(client, view)

    def show_answer(self, answer: str) -> None:
        """Show what the last button brought about."""
        self._set(self._answer, f'<div style="padding:0 12px 4px;font-size:12px">{html.escape(answer)}</div>')

    def show_modules(self, table: str) -> None:
        """Show the table of modules, HTML."""
        self._set(self._modules, table)

    def _set(self, handle: viser.GuiHtmlHandle, content: str) -> None:
        """Set the content of an element if it has changed: every assignment is sent to all pages."""
        if self._shown.get(id(handle)) != content:
            self._shown[id(handle)] = content
            handle.content = content


def _on_any_page(pressed: Callable[[str], None]) -> Callable[[str, viser.ClientHandle | None], None]:
    return lambda option, _client: pressed(option)
