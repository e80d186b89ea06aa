"""The check on the page: five movements, and red where something does not follow."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Collection
from typing import Any

import numpy as np
import viser

from gateway.calibration.movement_check import (
    MOVEMENTS,
    Movement,
    MovementCheck,
    MovementVerdict,
    SegmentMovement,
)
from gateway.contract.messages import PoseMessage
from gateway.errors import GatewayError
from gateway.viewer.step_pictures import step_picture
from gateway.viewer.step_tab import GOOD, POOR, Ask, StepTab, line, table
from gateway.viewer.texts import segment_name

READY_S, WATCHED_S, LOOK_S = 3, 6.0, 0.25
Worn = Callable[[], Collection[str]]
"""Segments that modules are worn on, now."""


class CheckTab(StepTab):
    """One tab of the panel. It watches the poses that come; it asks the gateway nothing."""

    def __init__(
        self,
        server: viser.ViserServer,
        tabs: viser.GuiTabGroupHandle,
        ask: Ask,
        worn: Worn,
    ) -> None:
        super().__init__(server, tabs, "check", ask)
        self._worn = worn
        self._found: dict[str, list[SegmentMovement]] = {}
        """By movement, those done so far."""
        self._watching: MovementCheck | None = None
        self._is_busy = False
        self._at = 0
        """Place of the movement that was shown last, by which it is chosen again in another language."""
        self.build()

    @property
    def red(self) -> frozenset[str]:
        """Segments that did not follow when their movement was done last."""
        return frozenset(
            seen.segment
            for found in self._found.values()
            for seen in found
            if seen.verdict != MovementVerdict.FOLLOWS
        )

    def add(self, pose: PoseMessage) -> None:
        """Hand a pose to the check that runs, if any."""
        if self._watching is not None and (root := pose.segments.get(pose.root)) is not None:
            self._watching.add(pose.segments, pose.status, np.array(root, np.float64))

    def _add_parts(self) -> list[Any]:
        gui = self._server.gui
        all_of_them = self._button("check_all", self._do_all)
        names = tuple(self._translated(f"move_{movement.name}") for movement in MOVEMENTS)
        self._movement = gui.add_dropdown(self._translated("movement"), names, initial_value=names[self._at])
        self._movement.on_update(lambda _: self._show_picture(self._chosen()))
        self._picture = gui.add_html("")
        self._show_picture(self._chosen())
        again = self._button("check_one", self._do_one)
        parts = [all_of_them, self._movement, self._picture, again]
        self._table = gui.add_html(self._table_html())
        self._clear_button = self._button("check_clear", self._clear, visible=bool(self._found))
        return [*parts, self._table, self._clear_button]

    def _chosen(self) -> Movement:
        return MOVEMENTS[self._movement.options.index(self._movement.value)]

    def _show_picture(self, movement: Movement) -> None:
        instruction = self._translated(f"do_{movement.name}")
        self._picture.content = step_picture(f"move_{movement.name}", instruction) + line(instruction)
        self._at = MOVEMENTS.index(movement)

    def _table_html(self) -> str:
        rows = [
            (
                GOOD if seen.verdict == MovementVerdict.FOLLOWS else POOR,
                (
                    self._translated(f"move_{name}"),
                    segment_name(self._language, seen.segment),
                    self._translated(f"verdict_{seen.verdict.value}"),
                ),
            )
            for name, found in self._found.items()
            for seen in found
        ]
        return (
            table([self._translated(key) for key in ("movement", "segment", "result_of_check")], rows)
            if rows
            else ""
        )

    async def _do_all(self) -> str:
        self._found.clear()
        for movement in MOVEMENTS:
            await self._do(movement)
        return self._summary()

    async def _do_one(self) -> str:
        await self._do(self._chosen())
        return self._summary()

    async def _clear(self) -> str:
        self._found.clear()
        self._table.content, self._clear_button.visible = "", False
        return self._translated("check_cleared")

    async def _do(self, movement: Movement) -> None:
        """Show what to do, count down, watch, and show how it went."""
        if self._is_busy:
            raise GatewayError(self._translated("check_busy"))
        check = MovementCheck(movement, tuple(self._worn()))
        if not check.seen():
            return  # nothing of it is worn
        self._is_busy = True
        self._movement.value = self._translated(f"move_{movement.name}")  # type: ignore[misc]  # as in Playback
        instruction = self._translated(f"do_{movement.name}")
        try:
            for left in range(READY_S, 0, -1):
                self._show_text(self._translated("ready_in", instruction=instruction, left=left))
                await asyncio.sleep(1.0)
            self._watching = check
            for left in range(round(WATCHED_S), 0, -1):
                self._show_text(self._translated("records", instruction=instruction, left=left))
                await asyncio.sleep(1.0)
        finally:
            self._watching, self._is_busy = None, False
        self._found[movement.name] = check.seen()
        self._table.content, self._clear_button.visible = self._table_html(), True

    def _summary(self) -> str:
        every = [seen for found in self._found.values() for seen in found]
        if not every:
            return self._translated("check_nothing")
        good = sum(seen.verdict == MovementVerdict.FOLLOWS for seen in every)
        key = "check_good" if good == len(every) else "check_bad"
        return self._translated(key, good=good, count=len(every))
