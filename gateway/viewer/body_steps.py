"""How modules sit on the body: guided poses and movements on the page, a score for each module, and its use.

It asks the gateway the requests of the family ``calibration``, as any program may.
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import html
from collections.abc import Awaitable, Callable, Mapping, Sequence
from typing import Any

import viser

from gateway.errors import GatewayError
from gateway.viewer.texts import say, texts

Ask = Callable[[str, str, Mapping[str, Any]], Awaitable[Mapping[str, Any]]]
"""Family, verb and data to the gateway's answer. Raises ``GatewayError``."""
NOTHING = "–"
COUNTDOWN_S, LOOK_S = 3.0, 0.4
_COLOURS = {"good": "rgb(40,150,80)", "fair": "rgb(200,140,0)", "poor": "rgb(225,60,50)"}


def line(text: str) -> str:
    """What became of a button, as HTML that a screen reader tells."""
    return f'<div role="status" style="padding:2px 12px 4px;font-size:12px">{html.escape(text)}</div>'


class Errands:
    """What buttons ask for, done in the loop while threads of the page's server go on."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        self._work: set[concurrent.futures.Future[None]] = set()

    def start(self, deed: Callable[[], Awaitable[str]], tell: Callable[[str], object]) -> None:
        """Do it, and tell what became of it, or what is wrong."""

        async def work() -> None:
            try:
                said = await deed()
            except GatewayError as error:
                said = str(error)
            tell(said)

        future = asyncio.run_coroutine_threadsafe(work(), self._loop)
        self._work.add(future)
        future.add_done_callback(self._work.discard)


class BodySteps:
    """One tab of the panel."""

    def __init__(
        self,
        server: viser.ViserServer,
        tabs: viser.GuiTabGroupHandle,
        ask: Ask,
        loop: asyncio.AbstractEventLoop,
    ) -> None:
        self._server, self._ask, self._errands = server, ask, Errands(loop)
        self._tab = tabs.add_tab(say("en", "body"))
        self._language = "en"
        self._steps: dict[str, str] = {}
        """Instructions by step."""
        self._result: Mapping[str, Any] | None = None
        self._handles: list[Any] = []
        self._build()

    def speak(self, language: str) -> None:
        """Say everything in that language from now on."""
        self._language = language
        for handle in self._handles:
            handle.remove()
        self._build()

    def _say(self, key: str, **values: object) -> str:
        return say(self._language, key, **values)

    def _build(self) -> None:
        gui = self._server.gui
        with self._tab:
            begin = gui.add_button(self._say("begin"))
            self._step = gui.add_dropdown(self._say("step"), (*self._steps,) or (NOTHING,))
            do = gui.add_button(self._say("do"))
            self._answer = gui.add_html("")
            result = gui.add_button(self._say("result"))
            found = None if self._result is None else result_table(self._result, self._language)
            self._table = gui.add_html(found or "")
            accept = gui.add_button(self._say("accept"))
        deeds = ((begin, self._begin), (do, self._do), (result, self._find), (accept, self._accept))
        for button, deed in deeds:
            button.on_click(self._pressed(deed))
        self._handles = [*(button for button, _ in deeds), self._step, self._answer, self._table]

    def _pressed(self, deed: Callable[[], Awaitable[str]]) -> Callable[[object], None]:
        return lambda _event: self._errands.start(deed, self._tell)

    def _tell(self, said: str) -> None:
        self._answer.content = line(said)

    async def _begin(self) -> str:
        steps = (await self._ask("calibration", "begin", {}))["steps"]
        self._steps = {one["step"]: one["instruction"] for one in steps}
        self._step.options = tuple(self._steps)
        self._result, self._table.content = None, ""
        return self._say("begun", count=len(steps))

    async def _do(self) -> str:
        name = self._step.value
        if name not in self._steps:
            return self._say("no_step", begin=self._say("begin"))
        await self._ask("calibration", "step", {"step": name, "countdown_s": COUNTDOWN_S})
        instruction = instruction_of(name, self._steps[name], self._language)
        while (status := await self._ask("calibration", "status", {}))["phase"] not in ("ready", "idle"):
            self._tell(progress(status, instruction, self._language))
            await asyncio.sleep(LOOK_S)
        left = [step for step in self._steps if step not in status.get("done", ())]
        if left:
            self._step.value = left[0]  # type: ignore[misc]  # as in Playback
        return self._say("done", steps=", ".join(status.get("done", ())))

    async def _find(self) -> str:
        self._tell(self._say("works"))
        self._result = await self._ask("calibration", "result", {})
        self._table.content = result_table(self._result, self._language)
        modules = self._result["modules"]
        good = sum(one["quality"] == "good" for one in modules)
        return self._say("scored", good=good, count=len(modules))

    async def _accept(self) -> str:
        answer = await self._ask("calibration", "accept", {"save": True})
        return self._say("accepted", count=len(answer["accepted"]), file=answer["file"])


def instruction_of(step: str, told: str, language: str) -> str:
    """What the wearer is to do, in a language; as the gateway told it where there is no text of it."""
    return texts(language).get(f"step_{step}", told)


def progress(status: Mapping[str, Any], instruction: str, language: str) -> str:
    """What is to be done now, for how long, and who spoils it. status: answer of calibration/status."""
    is_recording = status["phase"].startswith("recording")
    parts = [say(language, "records" if is_recording else "ready_in", instruction=instruction,
                 left=f"{status['left_s']:.0f}")]  # fmt: skip
    unheard = _named(status, lambda one: not one["heard"])
    moving = _named(status, lambda one: one["heard"] and not one["still"])
    if unheard:
        parts.append(say(language, "unheard", segments=unheard))
    if moving and status["phase"].endswith("_pose"):
        parts.append(say(language, "moves", segments=moving))
    return " · ".join(parts)


def _named(status: Mapping[str, Any], is_meant: Callable[[Mapping[str, Any]], bool]) -> str:
    return ", ".join(one["segment"].replace("_", " ") for one in status["modules"] if is_meant(one))


def result_table(result: Mapping[str, Any], language: str) -> str:
    """A score for each module with its reasons, as HTML."""
    keys: Sequence[str] = ("module", "segment", "score", "why")
    head = "".join(f'<th style="text-align:left;padding:1px 4px">{say(language, key)}</th>' for key in keys)
    rows = "".join(
        f'<tr style="color:{_COLOURS.get(one["quality"], "inherit")}">'
        + "".join(f'<td style="padding:1px 4px">{html.escape(cell)}</td>' for cell in _cells(one))
        + "</tr>"
        for one in result["modules"]
    )
    return (
        '<div style="padding:0 8px;overflow-x:auto;font-size:11px"><table style="border-collapse:collapse">'
        f"<tr>{head}</tr>{rows}</table></div>"
    )


def _cells(one: Mapping[str, Any]) -> tuple[str, ...]:
    reasons = "; ".join(one["reasons"])
    return str(one["module"]), one["segment"].replace("_", " "), f"{one['score']:.2f}", reasons
