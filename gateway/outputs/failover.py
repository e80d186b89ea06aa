"""Several addresses of one cluster: which is tried next, how soon a silent broker is noticed, what stands by.

A broker that dies closes its connections, which is seen at once. One that is frozen, or beyond a cable that
was cut, only stays silent: it is asked for an answer time and again, and given up when none comes.

To connect anew may take long just then: a cluster that has lost the node which led it lets nobody in, and
acknowledges nothing, until it has chosen another (NATS: four to nine seconds). Messages of QoS 0 pass
meanwhile over connections that are there. So poses have two, to two nodes, and go over one of them; over both
while the nodes do not hear each other.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import logging
import math
import random
import secrets
import time
from collections.abc import AsyncIterator, Callable, Coroutine, Sequence
from contextlib import AbstractAsyncContextManager, AsyncExitStack
from dataclasses import dataclass
from typing import Any, NamedTuple

import aiomqtt
from pydantic import ValidationError

from gateway.contract.messages import EchoMessage
from gateway.errors import GatewayError
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


class BrokerUnreachableError(GatewayError, ConnectionError):
    """No broker there, or it refuses us. ``str(error)`` says which and what would do."""


_SPREAD_S = 1.0
"""Longest pause before another connection stands by in the place of one that was lost: all gateways of a node
lose it at once, and the nodes that are left have poses to take first."""
_SETTLED_S = 1.0
"""An address whose connection lasts for so long has let us in; one that hangs up sooner has failed."""


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

    @property
    def has_failed(self) -> bool:
        """Whether the address before has failed, and no other one has let us in since."""
        return self._failed > 0

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


class Admitted(NamedTuple):
    """A connection, and the address that has let us in."""

    client: aiomqtt.Client
    settings: MqttSettings


@contextlib.asynccontextmanager
async def any_connection(
    settings: MqttSettings, role: str, filters: Sequence[str] = ()
) -> AsyncIterator[Admitted]:
    """Connect and subscribe once, at the first address that lets us. role: part of the client identifier.

    Raises ``BrokerUnreachableError`` where none does.
    """
    turns = BrokerTurns(settings, settings.port)
    async with AsyncExitStack() as stack:
        while True:
            door = turns.settings
            try:
                client = await stack.enter_async_context(_subscribed(door, role, filters))
                break
            except Exception as error:
                if turns.failed():
                    raise BrokerUnreachableError(explain(error, door, door.port)) from error
        yield Admitted(client, door)


@contextlib.asynccontextmanager
async def _subscribed(door: MqttSettings, role: str, filters: Sequence[str]) -> AsyncIterator[aiomqtt.Client]:
    async with broker_connection(door, door.port, unique_identifier(role)) as client:
        for topic in filters:
            await client.subscribe(topic, qos=1)
        yield client


Use = Callable[[aiomqtt.Client], Coroutine[Any, Any, None]]


async def keep_connected(
    turns: BrokerTurns,
    connect: Callable[[], AbstractAsyncContextManager[aiomqtt.Client]],
    use: Use,
    lost: Callable[[Exception], None],
    stopping: asyncio.Event,
) -> None:
    """Call ``use`` with a connection, again with one to the next address when that is lost, until it is
    stopping.

    connect: to the address whose turn it is. use: returns where another connection is wanted. lost: told why
    a connection was lost, or could not be made; what it raises ends all.
    """
    back_off = broker_back_off()
    while not stopping.is_set():
        begun_s, is_all_away = math.inf, False
        try:
            async with connect() as client:
                begun_s = time.monotonic()
                await use(client)
            turns.succeeded()
        except Exception as error:
            lost(error)
            if time.monotonic() - begun_s > _SETTLED_S:
                back_off.reset()
                turns.succeeded()
            is_all_away = turns.failed()
        if is_all_away:
            await nap(back_off.next_delay(), stopping)


_QUESTIONS = 2
"""In the time that an answer may take. More would notice a silent broker sooner, and give up more of those
that have only paused on a machine with much to do; poses do not wait for it, see ``_Echo``."""


async def keep_asking(
    client: aiomqtt.Client, within_s: float, on_answer: Callable[[float], None] | None = None
) -> None:
    """Ask the broker for an answer ``_QUESTIONS`` times in ``within_s``, for ever.

    on_answer: told when the question that was answered had been asked (``time.monotonic()``, s): a broker
    reads in order, so that it has all that was published before. Raises ``aiomqtt.MqttError`` for an answer
    that is not there in time.
    """
    answered = asyncio.Event()
    paho: Any = client._client  # aiomqtt has no way to ask for an answer
    handle = paho._handle_pingresp

    def note() -> Any:
        result = handle()
        answered.set()
        return result

    paho._handle_pingresp = note
    while True:
        answered.clear()
        if not paho._ping_t:  # or one of the keep-alive is under way already
            paho._send_pingreq()
            paho.loop_write()
        asked_s = float(paho._ping_t)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(within_s):
                await answered.wait()
        if not answered.is_set():  # both may have come while our own process paused
            raise aiomqtt.MqttError(f"the broker has not answered for {within_s:g} s")
        if on_answer is not None:
            on_answer(asked_s)
        await asyncio.sleep(max(within_s / _QUESTIONS - (time.monotonic() - asked_s), 0.0))


class _Ready(NamedTuple):
    """A connection, what ends it, and to which address it is."""

    client: aiomqtt.Client
    stack: AsyncExitStack
    settings: MqttSettings


Confirm = Callable[[float], None]
"""Told an instant (``time.monotonic()``, s): what was published before has reached the brokers."""


@dataclass(frozen=True)
class Companions:
    """What a user of a cluster wants to hear of, beside the connection in use."""

    confirm: Confirm | None = None
    """Told what has reached the other node; without echoes, what the node in use has read."""
    prepare: Callable[[aiomqtt.Client], Coroutine[Any, Any, None]] | None = None
    """Subscribes on a connection that is to stand by."""
    beside: Callable[[aiomqtt.Client | None], None] | None = None
    """Given the connection that stands by when the nodes are apart, and None when they are no longer. When a
    connection is lost, nothing is beside it."""
    take: Callable[[aiomqtt.Message], None] | None = None
    """Given what is heard on the connection that stands by."""


class ClusterConnection:
    """A connection to one node of a cluster, and one to another that stands by. Belongs to one event loop.

    Each node may answer while they do not hear each other: then what is published at one is heard there
    alone. So an echo is published at the node in use and listened for at the other. Where it stays away the
    nodes are apart, and both connections are to be used until it is heard again. Nothing is subscribed to or
    given up when a node is lost: a cluster without a leader keeps such a request, and all that comes after
    it, waiting.
    """

    def __init__(self, settings: MqttSettings, port: int, role: str, echo: str, **options: Any) -> None:
        """port: of the first address. role: part of client identifiers. echo: a topic below which the user
        of the settings may publish and hear. options: of ``broker_connection``."""
        self.is_apart = False
        """Whether the nodes of the two connections do not hear each other."""
        self._turns = BrokerTurns(settings, port)
        self._within_s = settings.answer_within
        self._is_watched = settings.is_watched
        self._role = role
        self._echo_topic = echo
        self._is_echo_received = False  # there may be no right to
        self._has_lost = False
        self._options = options
        self._ready: _Ready | None = None

    @property
    def settings(self) -> MqttSettings:
        """Those of the address in use, or tried last."""
        return self._turns.settings

    @property
    def standby(self) -> aiomqtt.Client | None:
        """The connection that stands by."""
        return None if self._ready is None else self._ready.client

    async def run(
        self,
        use: Use,
        lost: Callable[[Exception], None],
        stopping: asyncio.Event,
        companions: Companions = Companions(),
    ) -> None:
        """Do as ``keep_connected`` does; a connection that is lost is replaced by the one that stands by."""

        async def use_beside_companions(client: aiomqtt.Client) -> None:
            await first_to_end(use(client), *self._companions(client, companions))

        def note_lost(error: Exception) -> None:
            self._has_lost = True
            lost(error)

        try:
            await keep_connected(self._turns, self._next, use_beside_companions, note_lost, stopping)
        finally:
            if self._ready is not None:
                await self._ready.stack.aclose()

    @contextlib.asynccontextmanager
    async def _next(self) -> AsyncIterator[aiomqtt.Client]:
        ready = self._take() or await self._connected(self._turns.settings)
        async with ready.stack:
            yield ready.client

    def _companions(self, client: aiomqtt.Client, of: Companions) -> list[Coroutine[Any, Any, None]]:
        """Return what goes on while a connection is in use."""
        if not self._is_watched:
            return []

        def read(asked_s: float) -> None:
            if of.confirm is not None and not self._is_echo_received:
                of.confirm(asked_s)

        parts = [keep_asking(client, self._within_s, read)]
        if self._turns.others():
            parts.append(self._keep_one_ready(client, of))
        return parts

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

    async def _keep_one_ready(self, used: aiomqtt.Client, of: Companions) -> None:
        """Keep a connection to the next address, for ever; cancelled, it leaves it as it is."""
        back_off = broker_back_off()
        try:
            if self._has_lost:
                await asyncio.sleep(random.uniform(0, _SPREAD_S))
            for settings in itertools.cycle(self._turns.others()):
                try:
                    ready = self._ready = await self._connected(settings)
                    back_off.reset()
                    await first_to_end(
                        keep_asking(ready.client, self._within_s),
                        self._compare(used, ready, of),
                    )
                except Exception as error:
                    if self._ready is not None:
                        await _hung_up(self._ready.stack, error)
                        self._ready = None
                self.is_apart = False
                await asyncio.sleep(back_off.next_delay())
        finally:
            self.is_apart = False

    async def _compare(self, used: aiomqtt.Client, ready: _Ready, of: Companions) -> None:
        """Find out time and again whether two nodes hear each other."""

        def report(is_received: bool) -> None:
            self._is_echo_received |= is_received
            if self.is_apart != is_received or not self._is_echo_received:
                return
            self.is_apart = not is_received
            state = "are one cluster again" if is_received else "do not hear each other: both are used"
            here, there = self.settings, ready.settings
            places = here.host, here.port, there.host, there.port
            _log.warning("%s: the brokers at %s:%d and %s:%d %s", self._role, *places, state)
            if of.beside is not None:
                of.beside(None if is_received else ready.client)

        echo = _Echo(f"{self._echo_topic}/{secrets.token_hex(4)}", report, of.confirm)
        await ready.client.subscribe(echo.topic)
        if of.prepare is not None:
            await of.prepare(ready.client)
        await first_to_end(echo.listen(ready.client, of.take), echo.publish(used, self._within_s))


class _Echo:
    """A message that is published at one node, and listened for at another."""

    MISSED = 4
    """In a row, after which it stays away. Our own pauses cost one. So poses take both ways after 1 to 1.25
    of the time that an answer may take; where it was but a pause, they came twice for a moment."""
    REMEMBERED = 100

    def __init__(self, topic: str, report: Callable[[bool], None], confirm: Confirm | None) -> None:
        """topic: of this pair of connections alone. report: given whether it is received."""
        self.topic = topic
        self._report = report
        self._confirm = confirm
        self._sent_s: dict[int, float] = {}
        self._number = self._newest = 0

    async def publish(self, used: aiomqtt.Client, within_s: float) -> None:
        """Publish one after another, and tell when none comes back for about ``within_s``; for ever."""
        while True:
            self._number += 1
            self._sent_s[self._number] = time.monotonic()
            self._sent_s.pop(self._number - self.REMEMBERED, None)
            # By the client itself, whose messages leave in the order of publishing: poses come before.
            used._client.publish(self.topic, EchoMessage(number=self._number).payload())
            await asyncio.sleep(within_s / self.MISSED)
            if self._number - self._newest >= self.MISSED:
                self._report(False)

    async def listen(self, ready: aiomqtt.Client, take: Callable[[aiomqtt.Message], None] | None) -> None:
        """Take what comes; for ever. Raises ``aiomqtt.MqttError`` when the connection is lost."""
        async for message in ready.messages:
            if message.topic.value == self.topic:
                self._take(message.payload)
            elif take is not None:
                take(message)

    def _take(self, payload: Any) -> None:
        try:
            number = EchoMessage.model_validate_json(payload).number
        except ValidationError:
            return
        sent_s = self._sent_s.pop(number, None)
        if sent_s is None:
            return
        self._newest = max(self._newest, number)
        self._report(True)
        if self._confirm is not None:
            self._confirm(sent_s)


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
    turns = BrokerTurns(settings, settings.port)

    async def read(client: aiomqtt.Client) -> None:
        await client.subscribe([(topic, 0) for topic in filters])
        async for message in client.messages:
            take(message)

    def connect() -> AbstractAsyncContextManager[aiomqtt.Client]:
        return broker_connection(turns.settings, turns.settings.port, unique_identifier(role))

    def lost(error: Exception) -> None:
        _log.debug("what is retained: %s", explain(error, turns.settings, turns.settings.port))

    await keep_connected(turns, connect, read, lost, asyncio.Event())
