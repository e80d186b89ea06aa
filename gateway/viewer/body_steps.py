"""How modules sit on the body: guided poses and movements on the page, a score for each module, and its use.

It asks the gateway the requests of the family ``calibration``, as any program may.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import viser

from gateway.viewer.step_tab import COLOURS, NOTHING, Ask, StepTab, table
from gateway.viewer.texts import say, texts

COUNTDOWN_S, LOOK_S = 3.0, 0.4


class BodySteps(StepTab):
    """One tab of the panel."""

    def __init__(
        self,
        server: viser.ViserServer,
        tabs: viser.GuiTabGroupHandle,
        ask: Ask,
        loop: asyncio.AbstractEventLoop,
    ) -> None:
        super().__init__(server, tabs, "body", ask, loop)
        self._steps: dict[str, str] = {}
        """Instructions by step."""
        self._result: Mapping[str, Any] | None = None
        self.build()

    def _add_parts(self) -> list[Any]:
        gui = self._server.gui
        parts = [self._button("begin", self._begin), self._button("resume", self._resume)]
        self._step = gui.add_dropdown(self._say("step"), (*self._steps,) or (NOTHING,))
        parts += [self._step, self._button("do", self._do)]
        parts.append(self._button("result", self._find))
        found = None if self._result is None else result_table(self._result, self._language)
        self._table = gui.add_html(found or "")
        return [*parts, self._table, self._button("accept", self._accept)]

    async def _begin(self) -> str:
        self._take_steps((await self._ask("calibration", "begin", {}))["steps"])
        return self._say("begun", count=len(self._steps))

    async def _resume(self) -> str:
        """Go on with what was begun on another page, in the terminal, or before this page was closed."""
        status = await self._ask("calibration", "status", {})
        if status["phase"] == "idle":
            return self._say("nothing_begun", begin=self._say("begin"))
        self._take_steps(status["steps"])
        return self._next_of(status)

    def _take_steps(self, steps: Sequence[Mapping[str, Any]]) -> None:
        self._steps = {one["step"]: one["instruction"] for one in steps}
        self._step.options = tuple(self._steps)
        self._result, self._table.content = None, ""

    def _next_of(self, status: Mapping[str, Any]) -> str:
        """Choose the first step that is not done yet; tell those that are."""
        done = status.get("done", ())
        left = [step for step in self._steps if step not in done]
        if left:
            self._step.value = left[0]  # type: ignore[misc]  # as in Playback
        return self._say("done", steps=", ".join(done) or NOTHING)

    async def _do(self) -> str:
        name = self._step.value
        if name not in self._steps:
            return self._say("no_step", begin=self._say("begin"))
        await self._ask("calibration", "step", {"step": name, "countdown_s": COUNTDOWN_S})
        instruction = instruction_of(name, self._steps[name], self._language)
        while (status := await self._ask("calibration", "status", {}))["phase"] not in ("ready", "idle"):
            self._tell(progress(status, instruction, self._language))
            await asyncio.sleep(LOOK_S)
        return self._next_of(status)

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
    head = [say(language, key) for key in ("module", "segment", "score", "why")]
    return table(head, ((COLOURS.get(one["quality"], "inherit"), _cells(one)) for one in result["modules"]))


def _cells(one: Mapping[str, Any]) -> tuple[str, ...]:
    reasons = "; ".join(one["reasons"])
    return str(one["module"]), one["segment"].replace("_", " "), f"{one['score']:.2f}", reasons
