"""What the tabs of the set-up assistant share: language, buttons that work in the loop, an answer."""

from __future__ import annotations

import asyncio
import concurrent.futures
import html
import logging
from abc import ABC, abstractmethod
from collections.abc import Awaitable, Callable, Iterable, Mapping, Sequence
from contextvars import ContextVar
from typing import Any

import viser

from gateway.errors import GatewayError
from gateway.viewer.texts import ENGLISH, translated

_log = logging.getLogger(__name__)
Ask = Callable[[str, str, Mapping[str, Any]], Awaitable[Mapping[str, Any]]]
"""Family, verb and data to the gateway's answer. Raises ``GatewayError``."""
Action = Callable[[], Awaitable[str]]
"""What a button asks for; the answer is what became of it."""
_PLACE: ContextVar[Any] = ContextVar("place")
"""Below the button of the running action: several run at once, as one that watches and one that ends it."""
NOTHING = "–"
GOOD, FAIR, POOR = "var(--mocap-good)", "var(--mocap-fair)", "var(--mocap-poor)"
"""Of texts: see ``stage.STYLE``."""
COLOURS = {"good": GOOD, "fair": FAIR, "poor": POOR, "warning": FAIR, "bad": POOR}


def line(text: str) -> str:
    """Return what a button brought about, as HTML that a screen reader announces."""
    return f'<div role="status" style="padding:2px 12px 4px;font-size:12px">{html.escape(text)}</div>'


def table(head: Sequence[str], rows: Iterable[tuple[str, Sequence[str]]]) -> str:
    """Return rows, each a colour and its cells, as an HTML table; cells are texts, not HTML."""
    cell = "padding:1px 4px;text-align:left;vertical-align:top"
    shown = "".join(
        f'<tr style="color:{colour}">'
        + "".join(f'<td style="{cell}">{html.escape(text)}</td>' for text in cells)
        + "</tr>"
        for colour, cells in rows
    )
    heads = "".join(f'<th style="{cell}">{html.escape(name)}</th>' for name in head)
    return (
        '<div style="padding:0 8px;overflow-x:auto;font-size:11px"><table style="border-collapse:collapse">'
        f"<tr>{heads}</tr>{shown}</table></div>"
    )


def set_options(chooser: viser.GuiDropdownHandle[str], options: Sequence[str], chosen: str | None) -> None:
    """Have a list offer these, with one of them chosen; the first where it does not offer that one."""
    chooser.options = tuple(options)
    # the library's property has a setter, which the type checker does not see
    chooser.value = options[0] if chosen is None or chosen not in options else chosen  # type: ignore[misc]


class Errands:
    """What buttons ask for, done in the loop while threads of the page's server go on."""

    def __init__(self) -> None:
        self.language = ENGLISH
        """Of the message where something unforeseen goes wrong."""
        self._loop = asyncio.get_running_loop()
        self._work: set[concurrent.futures.Future[None]] = set()

    def start(self, action: Action, show: Callable[[str], object]) -> None:
        """Do it, and show what became of it, or what is wrong."""

        async def work() -> None:
            try:
                text = await action()
            except GatewayError as error:
                text = str(error)
            except Exception as error:  # a button that says nothing would be pressed again and again
                _log.exception("a button of the page")
                text = translated(self.language, "unexpected", error=repr(error))
            show(text)

        future = asyncio.run_coroutine_threadsafe(work(), self._loop)
        self._work.add(future)
        future.add_done_callback(self._work.discard)


class StepTab(ABC):
    """One tab of the panel; built anew when its language changes."""

    def __init__(
        self,
        server: viser.ViserServer,
        tabs: viser.GuiTabGroupHandle,
        name: str,
        ask: Ask,
    ) -> None:
        """Add an empty tab; ``name`` is the key of its name in the texts."""
        self._server, self._ask, self._errands = server, ask, Errands()
        self._tabs, self._name = tabs, name
        self._tab = tabs.add_tab(translated(ENGLISH, name))
        self._language = ENGLISH
        self._handles: list[Any] = []
        self._places: list[Any] = []
        """Below each button: where its outcome is shown."""
        self._place: Any = None
        """Of the button that was pressed last."""

    def build(self) -> None:
        """Put everything on the tab, in its language; whatever was there goes."""
        for handle in (*self._handles, *self._places):
            handle.remove()
        self._places, self._place = [], None
        with self._tab:
            self._handles = self._add_parts()

    def set_language(self, language: str) -> None:
        """Say everything in that language from now on."""
        if language != self._language:
            self._language = self._errands.language = language
            rename(self._tabs, self._tab, self._translated(self._name))
            self.build()

    @abstractmethod
    def _add_parts(self) -> list[Any]:
        """Add buttons and the rest to the page; return all of them. Shows what is known already."""

    def _translated(self, key: str, **values: object) -> str:
        return translated(self._language, key, **values)

    def _button(self, key: str, action: Action, **options: Any) -> Any:
        """Add a button that does something; the outcome is shown below it."""
        return self._button_for_page(key, lambda _client: action(), **options)

    def _button_for_page(
        self, key: str, action: Callable[[viser.ClientHandle | None], Awaitable[str]], **options: Any
    ) -> Any:
        """Add a button whose action concerns the page on which it was pressed."""
        button = self._server.gui.add_button(self._translated(key), **options)
        place = self._server.gui.add_html("", visible=False)
        self._places.append(place)

        def pressed(event: viser.GuiEvent[Any]) -> None:
            # An outcome that stays below another button would look like that of this one.
            for other in self._places:
                if other is not place:
                    other.visible = False
            self._place = place

            async def work() -> str:
                _PLACE.set(place)
                return await action(event.client)

            self._errands.start(work, self._show_text)

        button.on_click(pressed)
        return button

    def _show_text(self, text: str) -> None:
        """Show it below the button of the action under way, unless another button was pressed since."""
        if (place := _PLACE.get()) is self._place:
            place.content = line(text)
            place.visible = True


def rename(tabs: viser.GuiTabGroupHandle, tab: viser.GuiTabHandle, name: str) -> None:
    """Call a tab of the group so from now on, on all pages: the library has no public way to it."""
    tab._label = name
    tabs._tab_labels = tuple(each._label for each in tabs._tab_handles)
