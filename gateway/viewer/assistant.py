"""The assistant on the page: which modules are heard, which one is which, and whose segment each is.

Every step asks the gateway the verbs that the terminal asks (``mocap-gateway modules``), over MQTT. Nothing
is written to a module before a switch says so.
"""

from __future__ import annotations

import asyncio
import html
from collections.abc import Awaitable, Callable, Mapping, Sequence
from typing import Any

import viser

from gateway.errors import GatewayError
from gateway.modules.assignment import Proposal, Wardrobe
from gateway.viewer.body_steps import Ask, BodySteps, Errands, line
from gateway.viewer.texts import LANGUAGES, say

NOTHING = "–"
LISTEN_S, BLINK_S, SHAKEN_S = 2.0, 5, 20.0


class Assistant:
    """One tab of the panel. Buttons are pressed in threads of the page's server; work is done in the loop."""

    def __init__(
        self,
        server: viser.ViserServer,
        tabs: viser.GuiTabGroupHandle,
        ask: Ask,
        chosen: Callable[[str], None],
    ) -> None:
        """chosen: told which segment is meant, to be shown on the body."""
        self._server, self._ask, self._chosen = server, ask, chosen
        self._loop = asyncio.get_running_loop()
        self._errands = Errands(self._loop)
        self._listed: Mapping[str, Any] | None = None
        self._handles: list[Any] = []
        self._tab = tabs.add_tab(say("en", "tab"))
        self._language = "en"
        with self._tab:
            choice = server.gui.add_dropdown("Language / Sprache", tuple(LANGUAGES))
        self._body = BodySteps(server, tabs, ask, self._loop)
        choice.on_update(lambda _: self._speak(LANGUAGES[choice.value]))
        self._build()

    def choose_segment(self, segment: str) -> None:
        """A limb was clicked."""
        if segment in self._segment.options:
            # the library's property has a setter, which the type checker does not see
            self._segment.value = segment  # type: ignore[misc]

    def _speak(self, language: str) -> None:
        if language == self._language:
            return
        self._language = language
        for handle in self._handles:
            handle.remove()
        self._build()
        self._show_listed()
        self._body.speak(language)

    def _say(self, key: str, **values: object) -> str:
        return say(self._language, key, **values)

    def _build(self) -> None:
        gui = self._server.gui
        with self._tab:
            look = gui.add_button(self._say("look"))
            self._found = gui.add_html("")
            self._separate = gui.add_button(self._say("separate"), visible=False)
            self._device = gui.add_dropdown(self._say("device"), (NOTHING,))
            identify = gui.add_button(self._say("identify"))
            hint = gui.add_html(line(self._say("hint")))
            self._segment = gui.add_dropdown(self._say("segment"), (NOTHING,))
            shake = gui.add_button(self._say("shake"))
            self._write = gui.add_checkbox(self._say("write"), False)
            assign = gui.add_button(self._say("assign"))
            undo = gui.add_button(self._say("undo"))
            self._answer = gui.add_html("")
        self._segment.on_update(lambda _: self._chosen(self._segment.value))
        deeds = (
            (look, self._look),
            (self._separate, self._give_own_ids),
            (identify, self._blink),
            (shake, self._await_shake),
            (assign, self._assign),
            (undo, self._undo),
        )
        for button, deed in deeds:
            button.on_click(_pressed(self, deed))
        self._handles = [
            *(button for button, _ in deeds),
            *(self._found, self._device, hint, self._segment, self._write, self._answer),
        ]

    def start(self, deed: Callable[[], Awaitable[str]]) -> None:
        """Do what a button asks for, in the loop; what became of it, or what is wrong, is shown."""

        self._errands.start(deed, lambda said: setattr(self._answer, "content", line(said)))

    async def _look(self) -> str:
        self._answer.content = line(self._say("looking"))
        self._listed = await self._ask("modules", "list", {"listen_s": LISTEN_S})
        self._show_listed()
        count = len(self._listed["modules"])
        return self._say("heard", count=count) if count else self._say("nobody")

    def _show_listed(self) -> None:
        listed = self._listed
        if listed is None:
            return
        self._found.content = found_table(listed, self._language)
        self._separate.visible = bool(listed["conflicts"])
        self._device.options = (NOTHING, *devices_of(listed))
        self._segment.options = (NOTHING, *listed["segments"])

    async def _blink(self) -> str:
        device = devices_of(self._needed()).get(self._device.value)
        if device is None:
            return self._say("first_look")
        answer = await self._ask("modules", "identify", {"device": device, "seconds": BLINK_S})
        return self._say("blinks", id=answer["module"])

    async def _await_shake(self) -> str:
        self._answer.content = line(self._say("waiting"))
        answer = await self._ask("modules", "motion", {"seconds": SHAKEN_S})
        if answer["module"] is None:
            return self._say("none_moved")
        if answer["unique_id"] not in devices_of(self._listed or {"modules": ()}).values():
            await self._look()
        for label, unique_id in devices_of(self._needed()).items():
            if unique_id == answer["unique_id"]:
                self._device.value = label  # type: ignore[misc]
        return self._say("moved", id=answer["module"])

    async def _assign(self) -> str:
        listed = self._needed()
        unique_id = devices_of(listed).get(self._device.value)
        if unique_id is None or self._segment.value not in listed["segments"]:
            return self._say("hint")
        if listed["conflicts"]:
            return self._conflicts()[0]
        proposal = Wardrobe(listed).propose(self._segment.value, unique_id)
        what = told(proposal, self._language)
        if proposal.is_right_already:
            return what
        if refused := self._unwritable(what):
            return refused
        await self._ask("modules", "assign", {"ids": proposal.ids})
        await self._look()
        return self._say("written", what=what)

    async def _give_own_ids(self) -> str:
        what = "; ".join(self._conflicts())
        if refused := self._unwritable(what):
            return refused
        answer = await self._ask("modules", "separate", {})
        await self._look()
        return self._say("separated", count=len(answer["changes"]))

    async def _undo(self) -> str:
        if refused := self._unwritable(self._say("undo")):
            return refused
        answer = await self._ask("modules", "undo", {})
        await self._look()
        return self._say("undone", count=len(answer["changes"]))

    def _unwritable(self, what: str) -> str | None:
        """Why nothing may be written; None: it may."""
        if not self._needed()["allows_writes"]:
            return self._say("refused")
        if self._write.value:
            return None
        return self._say("first_write", what=what, write=self._say("write"), assign=self._say("assign"))

    def _conflicts(self) -> list[str]:
        return conflict_lines(self._needed(), self._language)

    def _needed(self) -> Mapping[str, Any]:
        if self._listed is None:
            raise GatewayError(self._say("first_look"))
        return self._listed


def _pressed(assistant: Assistant, deed: Callable[[], Awaitable[str]]) -> Callable[[object], None]:
    return lambda _event: assistant.start(deed)


def devices_of(listed: Mapping[str, Any]) -> dict[str, str]:
    """Devices that can be asked, by what they are called here: id, segment, end of the unique id."""
    return {
        f"{one['module']} · {one['segment'] or NOTHING} · …{one['unique_id'][-6:]}": one["unique_id"]
        for one in listed["modules"]
        if one["answers"] and one["unique_id"]
    }


def told(proposal: Proposal, language: str) -> str:
    """What an assignment would write."""
    segment = proposal.segment.replace("_", " ")
    if proposal.is_right_already:
        return say(language, "right", segment=segment, id=proposal.after)
    key = "exchange" if proposal.displaced else "becomes"
    return say(language, key, segment=segment, before=proposal.before, after=proposal.after)


def conflict_lines(listed: Mapping[str, Any], language: str) -> list[str]:
    """A line for each id that several modules have."""
    return [
        say(
            language,
            "conflict",
            count=len(one["unique_ids"]),
            id=one["module"],
            which=", ".join(f"…{unique_id[-6:]}" for unique_id in one["unique_ids"]),
            separate=say(language, "separate"),
        )
        for one in listed["conflicts"]
    ]


def found_table(listed: Mapping[str, Any], language: str) -> str:
    """The answer of ``modules list`` as HTML: devices, conflicts, and segments of which nothing is heard."""
    keys = ("id", "segment", "battery", "rate", "lost", "clock")
    head = "".join(f'<th style="text-align:left;padding:1px 4px">{say(language, key)}</th>' for key in keys)
    rows = "".join(_row(one, language) for one in listed["modules"])
    lines = conflict_lines(listed, language)
    heard = {one["segment"] for one in listed["modules"]}
    if silent := [name.replace("_", " ") for name in listed["segments"] if name not in heard]:
        lines.append(say(language, "missing", segments=", ".join(silent)))
    alarms = "".join(
        f'<div style="color:rgb(225,60,50);font-weight:600;padding:3px 4px">{html.escape(line)}</div>'
        for line in lines
    )
    return (
        '<div style="padding:0 8px;overflow-x:auto;font-size:11px">'
        f'{alarms}<table style="border-collapse:collapse;width:100%"><tr>{head}</tr>{rows}</table></div>'
    )


def _row(one: Mapping[str, Any], language: str) -> str:
    clock, loss = one.get("clock"), one.get("loss_percent")
    cells: Sequence[str] = (
        str(one["module"]),
        (one["segment"] or NOTHING).replace("_", " "),
        "" if one.get("battery_percent") is None else f"{one['battery_percent']} %",
        f"{one['rate_hz']:.0f}" if one["answers"] else say(language, "silent"),
        "" if loss is None else f"{loss:.1f} %",
        "" if clock is None else f"{clock['residual_us']:.0f}",
    )
    return "<tr>" + "".join(f'<td style="padding:1px 4px">{html.escape(c)}</td>' for c in cells) + "</tr>"
