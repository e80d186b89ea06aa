"""Heat maps of a camera published over MQTT (``broker_link`` is the other side)."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import threading
from collections import deque

import aiomqtt

from gateway.cameras.broker_link import ORDERS
from gateway.cameras.serving import Served
from gateway.outputs.connection import (
    broker_back_off,
    broker_connection,
    end_tasks,
    explain,
    first_to_end,
    unique_identifier,
)
from gateway.outputs.settings import MqttSettings

_MOST_WAITING = 8
"""Messages that are kept while the broker is slow or away; then the oldest is left out."""

_log = logging.getLogger(__name__)


class BrokerOutlet:
    """Messages onto a topic, by a thread of its own; offering never waits, and the newest count."""

    def __init__(self, settings: MqttSettings, topic: str) -> None:
        self.served = Served()
        self._settings = settings
        self._topic = topic
        self._waiting: deque[bytes] = deque()
        self._newest_line = b""
        self._arrival = asyncio.Event()
        self._idle = asyncio.Event()
        self._idle.set()
        self._is_connected = threading.Event()
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._run, name="mqtt", daemon=True)
        self._publishing: asyncio.Task[None] | None = None
        self._thread.start()

    def wait_for_first(self) -> None:
        """Wait until the broker is reached."""
        self._is_connected.wait()

    def offer(self, message: bytes) -> None:
        """Hand messages to the broker, in the place of the oldest one that it was too slow for."""
        self.served.messages += 1
        self._loop.call_soon_threadsafe(self._add, message)

    def newest_line(self) -> bytes:
        """Return the last line of orders that came since this was asked; empty: none did."""
        line, self._newest_line = self._newest_line, b""
        return line

    def close(self) -> None:
        """Send what is waiting, as far as the broker takes it within five seconds, and disconnect."""
        asyncio.run_coroutine_threadsafe(self._end(), self._loop).result()
        self._thread.join()
        self._loop.close()

    def _run(self) -> None:
        asyncio.set_event_loop(self._loop)
        self._publishing = self._loop.create_task(self._publish_for_ever())
        self._loop.run_forever()

    async def _end(self) -> None:
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(5.0):
                await self._idle.wait()
        assert self._publishing is not None  # the loop has run it
        await end_tasks(self._publishing)
        self._loop.call_soon(self._loop.stop)

    def _add(self, message: bytes) -> None:
        if len(self._waiting) == _MOST_WAITING:
            self._waiting.popleft()
            self.served.skipped += 1
        self._waiting.append(message)
        self._idle.clear()
        self._arrival.set()

    async def _publish_for_ever(self) -> None:
        back_off, last = broker_back_off(), ""
        while True:
            try:
                async with broker_connection(
                    self._settings, self._settings.port, unique_identifier("camera")
                ) as client:
                    self._is_connected.set()
                    last = ""
                    back_off.reset()
                    await client.subscribe(f"{self._topic}/{ORDERS}", 0)
                    await first_to_end(self._publish(client), self._listen(client))
            except Exception as error:
                reason = explain(error, self._settings, self._settings.port)
                if reason != last:
                    _log.warning("%s; trying again", reason)
                last = reason
            await asyncio.sleep(back_off.next_delay())

    async def _listen(self, client: aiomqtt.Client) -> None:
        async for message in client.messages:
            if isinstance(message.payload, bytes) and not message.retain:
                self._newest_line = message.payload.strip()

    async def _publish(self, client: aiomqtt.Client) -> None:
        while True:
            self._arrival.clear()
            while self._waiting:
                await client.publish(self._topic, self._waiting.popleft(), qos=0)
                self.served.sent += 1
            self._idle.set()
            await self._arrival.wait()
