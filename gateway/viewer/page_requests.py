"""What buttons of the page ask of the gateway, and what came of it."""

from __future__ import annotations

import asyncio
import concurrent.futures
from collections.abc import Callable, Mapping
from typing import Any

from devices.link import gateway_time_ns
from gateway.errors import GatewayError
from gateway.modules.remote import remote_suit
from gateway.outputs.settings import MqttSettings
from gateway.viewer.module_table import RecordingStatus, clock_of
from gateway.viewer.panel import Panel

REMOUNTING = ("full", "mounting")
"""Resets that put right how modules sit."""
COUNTED_DOWN = {"heading": "countdown_heading", "full": "countdown", "mounting": "countdown"}
"""Resets that want the wearer to stand somehow, who has to get there first; the text shown meanwhile."""
COUNTDOWN_S = 3


class PageRequests:
    """Sends requests over MQTT, and shows on the panel what became of them. Belongs to one event loop."""

    def __init__(
        self,
        settings: MqttSettings,
        panel: Panel,
        recording: RecordingStatus,
        gateway: Callable[[], str],
    ) -> None:
        """Ask nothing yet. Wants a running event loop.

        recording: told the state of a recording that an answer brings. gateway: returns whom to ask, by name.
        """
        self._settings, self._panel, self._recording, self._gateway = settings, panel, recording, gateway
        self._loop = asyncio.get_running_loop()
        self._running: set[concurrent.futures.Future[None]] = set()

    def ask(self, family: str, verb: str, data: Mapping[str, Any]) -> None:
        """Start a request in the event loop; called in a thread of the page's server."""
        request = asyncio.run_coroutine_threadsafe(self._request(family, verb, data), self._loop)
        # The loop keeps only weak references to tasks: without this one it might be collected while it runs.
        self._running.add(request)
        request.add_done_callback(self._running.discard)

    async def answer_of(self, family: str, verb: str, data: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return the gateway's answer. Raises ``GatewayError``."""
        async with remote_suit(self._settings, self._gateway(), family) as remote:
            answer = await remote.perform(verb, data)
        if family == "recording" and "state" in answer:
            self._recording.take(answer, gateway_time_ns())
        return answer

    async def _request(self, family: str, verb: str, data: Mapping[str, Any]) -> None:
        translated, show = self._panel.translated, self._panel.show_answer
        action = f"{translated(f'{family}_row')}, {translated(f'{family}_{verb}')}"
        if family == "reset" and verb in COUNTED_DOWN:
            for left_s in range(COUNTDOWN_S, 0, -1):
                show(translated(COUNTED_DOWN[verb], action=action, left=left_s))
                await asyncio.sleep(1.0)
        show(translated("is_asked", action=action))
        try:
            answer = await self.answer_of(family, verb, data)
        except GatewayError as error:
            show(translated("went_wrong", action=action, error=error))
            return
        show(translated("is_done", action=action, details=self._answer_text(family, verb, answer)))

    def _answer_text(self, family: str, verb: str, answer: Mapping[str, Any]) -> str:
        """Return what a request has brought about, in short."""
        if family == "recording":
            file = str(answer.get("file", "")).rpartition("/")[2]
            clock = clock_of(answer.get("seconds"))
            return self._panel.translated(
                "answer_recording", file=file, clock=clock, marks=answer.get("marks", 0)
            )
        text = ""
        if turned := answer.get("turned_deg"):
            text += self._panel.translated("answer_turned", turned=f"{turned:g}")
        if moved := answer.get("moved_m"):
            text += self._panel.translated("answer_moved", moved=f"{moved:g}")
        if verb in REMOUNTING:
            text += self._panel.translated("answer_remounted", count=len(answer.get("remounted_deg", ())))
        return text
