"""The calibration of sensors on the page, by requests of ``sensors``."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from typing import Any

import viser

from gateway.viewer.step_tab import COLOURS, GOOD, NOTHING, Ask, StepTab, line, table
from gateway.viewer.texts import segment_name, translated

LOOK_S = 1.0


class SensorTab(StepTab):
    """One tab of the panel. What was begun goes on in the gateway when the page is closed."""

    def __init__(self, server: viser.ViserServer, tabs: viser.GuiTabGroupHandle, ask: Ask) -> None:
        super().__init__(server, tabs, "sensors", ask)
        self._status: Mapping[str, Any] | None = None
        self._found: Mapping[str, Mapping[str, Mapping[str, Any]]] | None = None
        """What is shown: how far modules are, or what was found of them."""
        self._is_watched = False
        self._is_begun = self._is_found = False
        self.build()

    def _add_parts(self) -> list[Any]:
        why = self._server.gui.add_html(line(self._translated("sensors_why")))
        begin, resume = self._button("sensors_begin", self._begin), self._button("resume", self._watch)
        self._table = self._server.gui.add_html(self._table_html())
        enough = self._button("sensors_result", self._find)
        in_file = self._button("sensors_accept", self._keep_in_file)
        in_modules = self._button("sensors_flash", self._keep_in_modules)
        cancel = self._button("sensors_cancel", self._cancel)
        self._meanwhile, self._afterwards = [enough, cancel], [in_file, in_modules]
        self._offer(self._is_begun, self._is_found)
        return [why, begin, resume, self._table, *self._meanwhile, *self._afterwards]

    def _offer(self, is_begun: bool, is_found: bool) -> None:
        """Show what can be done now, so that nobody has to find out which of all buttons comes next."""
        self._is_begun, self._is_found = is_begun, is_found
        for part in self._meanwhile:
            part.visible = is_begun
        for part in self._afterwards:
            part.visible = is_found

    def _show(
        self,
        status: Mapping[str, Any] | None = None,
        found: Mapping[str, Mapping[str, Mapping[str, Any]]] | None = None,
    ) -> None:
        self._status, self._found = status, found
        self._table.content = self._table_html()

    def _table_html(self) -> str:
        if self._found is not None:
            return result_table(self._found, self._language)
        return "" if self._status is None else progress_table(self._status, self._language)

    async def _begin(self) -> str:
        await self._ask("sensors", "begin", {})
        self._offer(True, False)
        return await self._watch()

    # Two watches would write over each other's advice.
    async def _watch(self) -> str:
        """Show what to do until it is enough, or the user ends it."""
        if self._is_watched:
            return self._translated("check_busy")
        self._is_watched = True
        try:
            while (status := await self._ask("sensors", "status", {}))["phase"] == "watching":
                self._offer(True, self._is_found)
                self._show(status=status)
                self._show_text(self._advice(status))
                if status["enough"]:
                    return self._advice(status)
                await asyncio.sleep(LOOK_S)
        finally:
            self._is_watched = False
        is_found = status["phase"] == "found"
        self._offer(is_found, is_found)
        return self._translated(
            "sensors_ended" if is_found else "sensors_idle", begin=self._translated("sensors_begin")
        )

    def _advice(self, status: Mapping[str, Any]) -> str:
        modules = ", ".join(map(str, status["waited_for"]))
        return self._translated(
            f"advice_{status['advice']}", modules=modules, result=self._translated("sensors_result")
        )

    async def _find(self) -> str:
        self._show_text(self._translated("works"))
        found = (await self._ask("sensors", "result", {}))["modules"]
        self._show(found=found)
        self._offer(self._is_begun, True)
        good = sum(all(one["quality"] == "good" for one in each.values()) for each in found.values())
        return self._translated("sensors_scored", good=good, count=len(found))

    async def _keep_in_file(self) -> str:
        kept = await self._ask("sensors", "accept", {})
        if not kept["is_configured"]:
            return self._translated("sensors_later", count=len(kept["accepted"]), where=kept["file"])
        await self._ask("gateway", "reload", {})
        return self._translated("sensors_kept", count=len(kept["accepted"]), where=kept["file"])

    async def _keep_in_modules(self) -> str:
        kept = await self._ask("sensors", "accept", {"flash": True})
        return self._translated(
            "sensors_kept", count=len(kept["accepted"]), where=self._translated("in_modules")
        )

    async def _cancel(self) -> str:
        await self._ask("sensors", "cancel", {})
        self._offer(False, False)
        self._show()
        return self._translated("sensors_given_up")


def progress_table(status: Mapping[str, Any], language: str) -> str:
    """Return how far every module is, as HTML; green: enough."""
    rows = [
        (
            GOOD if one["enough"] else "inherit",
            (
                str(one["module"]),
                segment_name(language, one["segment"] or NOTHING),
                f"{one['rest_s']:.0f}" if one["heard"] else translated(language, "silent"),
                f"{one['positions']}/{one['wanted_positions']}",
                f"{100 * one['coverage']:.0f} %",
            ),
        )
        for one in status["modules"]
    ]
    return table(
        [translated(language, key) for key in ("id", "segment", "at_rest_s", "positions", "turned")], rows
    )


def result_table(found: Mapping[str, Mapping[str, Mapping[str, Any]]], language: str) -> str:
    """Return what was found of every module's sensors, how good it is, and why not better, as HTML."""
    rows = [
        (
            COLOURS.get(one["quality"], COLOURS["bad"]),
            (
                module,
                translated(language, sensor),
                translated(language, one["quality"]),
                "; ".join(one["reasons"]),
            ),
        )
        for module, each in found.items()
        for sensor, one in each.items()
    ]
    return table([translated(language, key) for key in ("id", "sensor", "quality", "why")], rows)
