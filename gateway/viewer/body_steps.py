"""How tall the wearer is and how modules sit: measures, guided poses and movements, a score for each module.

It asks the gateway the requests of the family ``calibration``, as any program may.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import viser

from gateway.errors import GatewayError
from gateway.viewer.step_pictures import step_picture
from gateway.viewer.step_tab import COLOURS, NOTHING, Ask, StepTab, line, set_options, table
from gateway.viewer.texts import segment_name, step_name, texts, translated

COUNTDOWN_S, LOOK_S = 3.0, 0.4
USUAL_HEIGHT_M = 1.75
SWITCH_S, _MOST_LOOKS = 1.5, 5
"""For a gateway to begin with another body; what is begun before that is lost with the former one."""


class BodySteps(StepTab):
    """One tab of the panel."""

    def __init__(self, server: viser.ViserServer, tabs: viser.GuiTabGroupHandle, ask: Ask) -> None:
        super().__init__(server, tabs, "body", ask)
        self._steps: dict[str, str] = {}
        """Instructions by step."""
        self._at = ""
        """The step that was shown last, by which it is chosen again in another language."""
        self._result: Mapping[str, Any] | None = None
        self._measures: Mapping[str, Any] = {"subject": {}, "lengths": {}}
        """Answer of calibration/measure."""
        self.build()

    def look(self) -> None:
        """Find out how tall the wearer is said to be: another body is shown."""
        self._errands.start(self._take_measures, lambda _text: None)

    def _add_parts(self) -> list[Any]:
        gui = self._server.gui
        chosen = step_name(self._language, self._at) if self._at in self._steps else None
        height_m = self._measures["subject"].get("height_m", USUAL_HEIGHT_M)
        why = gui.add_html(line(self._translated("measures_why")))
        self._height = gui.add_number(self._translated("height"), height_m, min=0.0, step=0.01)
        self._length = gui.add_dropdown(self._translated("length"), (NOTHING, *self._limbs()))
        self._metres = gui.add_number(self._translated("metres"), 0.0, min=0.0, step=0.005)
        self._length.on_update(lambda _: self._show_length())
        measure = self._button("measure", self._measure)
        begin, resume = self._button("begin", self._begin), self._button("resume", self._resume)

        self._before = [why, self._height, self._length, self._metres, measure, begin]
        self._step = gui.add_dropdown(self._translated("step"), self._step_names(), initial_value=chosen)
        self._step.on_update(lambda _: self._show_picture())
        do = self._button("do", self._do)
        self._picture = gui.add_html("")
        self._show_picture()
        result = self._button("result", self._find)
        found = None if self._result is None else result_table(self._result, self._language)
        self._table = gui.add_html(found or "")
        self._accept_button = self._button("accept", self._accept)
        give_up = self._button("give_up", self._end)

        self._meanwhile = [self._step, self._picture, do, result, give_up]
        self._offer()
        return [*self._before, resume, *self._meanwhile, self._table, self._accept_button]

    def _offer(self) -> None:
        """Show what can be done now, so that nobody has to find out which of all buttons comes next."""
        for part in self._before:
            part.visible = not self._steps
        for part in self._meanwhile:
            part.visible = bool(self._steps)
        self._accept_button.visible = self._result is not None

    def _step_names(self) -> tuple[str, ...]:
        return tuple(step_name(self._language, step) for step in self._steps) or (NOTHING,)

    def _chosen(self) -> str:
        """Return the step that is chosen, or an empty text."""
        return next((step for step in self._steps if step_name(self._language, step) == self._step.value), "")

    def _show_picture(self) -> None:
        step = self._at = self._chosen()
        instruction = instruction_of(step, self._steps.get(step, ""), self._language)
        self._picture.content = step_picture(step, instruction) + (line(instruction) if instruction else "")

    def _limbs(self) -> dict[str, str]:
        """Return limbs whose lengths can be entered, by their names in the page's language."""
        return {segment_name(self._language, limb): limb for limb in self._measures["lengths"]}

    def _show_length(self) -> None:
        metres = self._measures["lengths"].get(self._limbs().get(self._length.value), 0.0)
        self._metres.value = metres  # type: ignore[misc]  # as in Playback

    async def _take_measures(self) -> str:
        try:
            self._measures = await self._ask("calibration", "measure", {})
        except GatewayError:  # of a gateway that knows no rig: measures are not offered
            return ""
        self._show_measures()
        return ""

    def _show_measures(self) -> None:
        height_m = self._measures["subject"].get("height_m", USUAL_HEIGHT_M)
        self._height.value = height_m  # type: ignore[misc]  # as in Playback
        set_options(self._length, (NOTHING, *self._limbs()), self._length.value)
        self._show_length()

    async def _measure(self) -> str:
        """Keep the height, and the length that is chosen if it was changed."""
        limb, metres = self._limbs().get(self._length.value), float(self._metres.value)
        is_changed = metres > 0.0 and metres != self._measures["lengths"].get(limb, metres)
        data = {"height_m": float(self._height.value), "lengths": {limb: metres} if is_changed else {}}
        self._show_text(self._translated("measuring"))
        kept = await self._ask("calibration", "measure", data)
        self._measures = kept
        for _ in range(_MOST_LOOKS):  # whoever has answered makes room for one with the new body
            await asyncio.sleep(SWITCH_S)
            with contextlib.suppress(GatewayError):
                self._measures = await self._ask("calibration", "measure", {})
                break
        self._show_measures()
        return self._translated("measured", height=f"{self._height.value:.2f}", file=kept["file"])

    async def _begin(self) -> str:
        self._take_steps((await self._ask("calibration", "begin", {}))["steps"])
        return self._translated("begun", count=len(self._steps))

    async def _resume(self) -> str:
        """Go on with what was begun on another page, in the terminal, or before this page was closed."""
        status = await self._ask("calibration", "status", {})
        if status["phase"] == "idle":
            return self._translated("nothing_begun", begin=self._translated("begin"))
        self._take_steps(status["steps"])
        return self._next_of(status)

    def _take_steps(self, steps: Sequence[Mapping[str, Any]]) -> None:
        self._steps = {one["step"]: one["instruction"] for one in steps}
        self._step.options = self._step_names()
        self._show_picture()
        self._result, self._table.content = None, ""
        self._offer()

    def _next_of(self, status: Mapping[str, Any]) -> str:
        """Choose the first step that is not done yet; return those that are."""
        done = status.get("done", ())
        left = [step for step in self._steps if step not in done]
        if left:
            self._step.value = step_name(self._language, left[0])  # type: ignore[misc]  # as in Playback
        names = [step_name(self._language, step) for step in done]
        return self._translated("done", steps=", ".join(names) or NOTHING)

    async def _do(self) -> str:
        if not (step := self._chosen()):
            return self._translated("nothing_begun", begin=self._translated("begin"))
        await self._ask("calibration", "step", {"step": step, "countdown_s": COUNTDOWN_S})
        instruction = instruction_of(step, self._steps[step], self._language)
        while (status := await self._ask("calibration", "status", {}))["phase"] not in ("ready", "idle"):
            self._show_text(progress(status, instruction, self._language))
            await asyncio.sleep(LOOK_S)
        if status["phase"] == "idle":  # given up elsewhere, or the gateway began anew
            self._take_steps(())
            return self._translated("nothing_begun", begin=self._translated("begin"))
        return self._next_of(status)

    async def _find(self) -> str:
        self._show_text(self._translated("works"))
        self._result = await self._ask("calibration", "result", {})
        self._table.content = result_table(self._result, self._language)
        self._offer()
        modules = self._result["modules"]
        good = sum(one["quality"] == "good" for one in modules)
        return self._translated("scored", good=good, count=len(modules))

    async def _end(self) -> str:
        await self._ask("calibration", "cancel", {})
        self._take_steps(())
        return self._translated("given_up")

    async def _accept(self) -> str:
        answer = await self._ask("calibration", "accept", {"save": True})
        self._take_steps(())
        return self._translated("accepted", count=len(answer["accepted"]), file=answer["file"])


def instruction_of(step: str, fallback: str, language: str) -> str:
    """Return what the wearer is to do, in a language; the gateway's own words if there is no translation."""
    return texts(language).get(f"step_{step}", fallback)


def progress(status: Mapping[str, Any], instruction: str, language: str) -> str:
    """Return what is to be done now, for how long, and which modules do not fit.

    status: answer of ``calibration/status``.
    """
    is_recording = status["phase"].startswith("recording")
    parts = [translated(language, "records" if is_recording else "ready_in", instruction=instruction,
                 left=f"{status['left_s']:.0f}")]  # fmt: skip
    silent = _named(status, lambda one: not one["heard"], language)
    moving = _named(status, lambda one: one["heard"] and not one["still"], language)
    if silent:
        parts.append(translated(language, "unheard", segments=silent))
    if moving and status["phase"].endswith("_pose"):
        parts.append(translated(language, "moves", segments=moving))
    return " · ".join(parts)


def _named(status: Mapping[str, Any], is_meant: Callable[[Mapping[str, Any]], bool], language: str) -> str:
    return ", ".join(segment_name(language, one["segment"]) for one in status["modules"] if is_meant(one))


def result_table(result: Mapping[str, Any], language: str) -> str:
    """Return a score for each module with its reasons, as HTML."""
    head = [translated(language, key) for key in ("module", "segment", "score", "why")]
    return table(
        head, ((COLOURS.get(one["quality"], "inherit"), _cells(one, language)) for one in result["modules"])
    )


def _cells(one: Mapping[str, Any], language: str) -> tuple[str, ...]:
    reasons = "; ".join(one["reasons"])
    return str(one["module"]), segment_name(language, one["segment"]), f"{one['score']:.2f}", reasons
