"""Several addresses of one cluster: which is tried next, how soon a silent broker is noticed, what stands by.

A broker that dies closes its connections, which is seen at once. One that is frozen, or beyond a cable that
was cut, only stays silent: it is asked for an answer time and again, and given up when none comes.

To connect anew may take long just then: a cluster that has lost the node which led it lets nobody in, and
acknowledges nothing, until it has chosen another (NATS: four to nine seconds). Messages of QoS 0 pass
meanwhile over connections that are there. So poses have two, to two nodes, and go over one of them.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import logging
import time
from collections.abc import Callable, Coroutine, Sequence
from contextlib import AsyncExitStack
from typing import Any, NamedTuple

import aiomqtt

from gateway.outputs.connection import (
    broker_back_off,
    broker_connection,
    explain,
    first_to_end,
    nap,
    unique_identifier,
)
from gateway.outputs.settings import MqttSettings

_log = logging.getLogger(__name__)


class BrokerTurns:
    """The addresses of a configuration, one of which is in use."""

    def __init__(self, settings: MqttSettings, port: int) -> None:
        """port: of the first address, where the settings leave it open."""
        first = settings.model_copy(update={"port": port})
        self._doors = [first, *(settings.at(address) for address in settings.failover)]
        self._turn = 0
        self._failed = 0

    @property
    def settings(self) -> MqttSettings:
        """Those of the address in use; its ``failover`` is that of the configuration."""
        return self._doors[self._turn]

    def succeeded(self) -> None:
        """Note that the address in use has let us in: it stays in use."""
        self._failed = 0

    def failed(self) -> bool:
        """Go on to the next address. Returns whether all of them have failed one after another."""
        self._turn = (self._turn + 1) % len(self._doors)
        self._failed = (self._failed + 1) % len(self._doors)
        return self._failed == 0

    def use(self, settings: MqttSettings) -> None:
        """Note that the connection of one address, which is there already, is in use from now on."""
        self._turn = self._doors.index(settings)

    def others(self) -> list[MqttSettings]:
        """Return the other addresses, the next one first."""
        return [*self._doors[self._turn + 1 :], *self._doors[: self._turn]]


async def keep_asking(
    client: aiomqtt.Client, within_s: float, on_answer: Callable[[float], None] | None = None
) -> None:
    """Ask the broker for an answer twice in ``within_s``, for ever.

    on_answer: told when the question that was answered had been asked (``time.monotonic()``, s): a broker
    reads in order, so that it has all that was published before. Raises ``aiomqtt.MqttError`` for an answer
    that is not there in time.
    """
    answered = asyncio.Event()
    paho: Any = client._client  # aiomqtt has no way to ask for an answer
    heard = paho._handle_pingresp

    def note() -> Any:
        result = heard()
        answered.set()
        return result

    paho._handle_pingresp = note
    while True:
        answered.clear()
        asked_s = time.monotonic()
        if not paho._ping_t:  # or one of the keep-alive is under way already
            paho._send_pingreq()
            paho.loop_write()
        await asyncio.wait({waiting := asyncio.ensure_future(answered.wait())}, timeout=within_s)
        waiting.cancel()
        if not answered.is_set():
            raise aiomqtt.MqttError(f"the broker has not answered for {within_s:g} s")
        if on_answer is not None:
            on_answer(asked_s)
        await asyncio.sleep(max(within_s / 2 - (time.monotonic() - asked_s), 0.0))


class _Ready(NamedTuple):
    """A connection, what ends it, and to which address it is."""

    client: aiomqtt.Client
    stack: AsyncExitStack
    settings: MqttSettings


class ClusterConnection:
    """A connection to one node of a cluster, and one to another that stands by. Belongs to one event loop.

    Nothing is subscribed to on the one that stands by.
    """

    def __init__(self, settings: MqttSettings, port: int, role: str, **options: Any) -> None:
        """port: of the first address. role: part of client identifiers. options: of ``broker_connection``."""
        self._turns = BrokerTurns(settings, port)
        self._within_s = settings.answer_within
        self._role = role
        self._options = options
        self._ready: _Ready | None = None

    @property
    def settings(self) -> MqttSettings:
        """Those of the address in use, or tried last."""
        return self._turns.settings

    async def run(
        self,
        use: Callable[[aiomqtt.Client], Coroutine[Any, Any, None]],
        on_answer: Callable[[float], None] | None,
        lost: Callable[[Exception], None],
        stopping: asyncio.Event,
    ) -> None:
        """Call ``use`` with a connection, again with another one when that is lost, until it is stopping.

        on_answer: as in ``keep_asking``. lost: told why a connection was lost, or could not be made.
        """
        back_off = broker_back_off()
        try:
            while not stopping.is_set():
                is_all_away = False
                try:
                    client, stack, _ = self._take() or await self._connected(self._turns.settings)
                    back_off.reset()
                    self._turns.succeeded()
                    async with stack:
                        asking = keep_asking(client, self._within_s, on_answer)
                        await first_to_end(use(client), asking, self._keep_one_ready())
                except Exception as error:
                    lost(error)
                    is_all_away = self._turns.failed()
                if is_all_away:
                    await nap(back_off.next_delay(), stopping)
        finally:
            if self._ready is not None:
                await self._ready.stack.aclose()

    def _take(self) -> _Ready | None:
        """Return the connection that stands by, if there is one and it lives."""
        ready, self._ready = self._ready, None
        if ready is None or ready.client._disconnected.done():
            return None
        self._turns.use(ready.settings)
        return ready

    async def _connected(self, settings: MqttSettings) -> _Ready:
        stack = AsyncExitStack()
        opening = broker_connection(settings, settings.port, unique_identifier(self._role), **self._options)
        return _Ready(await stack.enter_async_context(opening), stack, settings)

    async def _keep_one_ready(self) -> None:
        """Keep a connection to the next address, for ever; cancelled, it leaves it as it is."""
        back_off = broker_back_off()
        if not self._turns.others():
            await asyncio.Event().wait()
        for settings in itertools.cycle(self._turns.others()):
            try:
                self._ready = await self._connected(settings)
                back_off.reset()
                await keep_asking(self._ready.client, self._within_s)
            except Exception as error:
                if self._ready is not None:
                    await _hung_up(self._ready.stack, error)
                    self._ready = None
            await asyncio.sleep(back_off.next_delay())


async def _hung_up(stack: AsyncExitStack, reason: Exception) -> None:
    """Close a connection that is of no use any more, at once."""
    with contextlib.suppress(Exception):
        await stack.__aexit__(type(reason), reason, reason.__traceback__)


async def follow_kept(
    settings: MqttSettings, role: str, filters: Sequence[str], take: Callable[[aiomqtt.Message], None]
) -> None:
    """Give what is retained, and what replaces it, to ``take``, for ever, over whichever node lets us in.

    On a connection of its own: a cluster that has lost a node may not tell what it retains for some seconds,
    and answers nothing else on that connection meanwhile.
    """
    back_off, turns = broker_back_off(), BrokerTurns(settings, settings.port)
    while True:
        door = turns.settings
        try:
            async with broker_connection(door, door.port, unique_identifier(role)) as client:
                await client.subscribe([(topic, 0) for topic in filters])
                back_off.reset()
                turns.succeeded()
                async for message in client.messages:
                    take(message)
        except Exception as error:
            _log.debug("what is retained: %s", explain(error, door, door.port))
            turns.failed()
        await asyncio.sleep(back_off.next_delay())
