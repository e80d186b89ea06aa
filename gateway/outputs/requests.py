"""Requests to the gateway over MQTT: ``bridge/request/<verb>`` to ``bridge/response/<verb>``.

It has a connection of its own, so that an answer never stands in the way of a pose. Requests are
carried out beside one another, so that a long one holds up nobody; what may not be done at once waits its
turn in the family (``in_turn``). Too many of a family under way are answered with an error at once. Faster
than ``MOST_A_SECOND`` they wait to be read, and where too many wait they are dropped, and counted.
"""

from __future__ import annotations

import asyncio
import logging
import math
import time
from collections.abc import Awaitable, Callable, Mapping
from contextlib import AbstractAsyncContextManager
from dataclasses import dataclass
from typing import Any

import aiomqtt
from paho.mqtt.properties import Properties
from pydantic import JsonValue

from devices.commands.device_errors import DeviceError
from devices.link import LinkError
from gateway.contract import topics
from gateway.contract.properties import JSON, properties_of
from gateway.contract.request_messages import (
    RequestProblem,
    ResponseMessage,
    Transaction,
    parse_request,
)
from gateway.contract.topics import Topics
from gateway.errors import GatewayError, nearest
from gateway.outputs.connection import (
    Allowance,
    broker_connection,
    end_tasks,
    explain,
    first_to_end,
    unique_identifier,
)
from gateway.outputs.failover import BrokerTurns, keep_asking, keep_connected
from gateway.outputs.settings import MqttSettings

_log = logging.getLogger(__name__)

_MOST_UNDER_WAY = 8
"""Of one family, those that wait their turn included."""

_LONGEST_VERB = 80
_LONGEST_TOPIC = 256
_LONGEST_CORRELATION = 1024
MOST_A_SECOND = 100.0
MOST_AT_ONCE = 200
_COMPLAINT_INTERVAL_S = 10.0
_LONGEST_AWAY_S = 60.0
"""So long an answer waits for a broker that is away."""
_TRY_AGAIN_S = 0.05
_REFUSED = ""
"""Family of what is not carried out."""
_BROKEN_OFF = (
    "broken off, perhaps half done: the gateway ends, or takes another configuration into use; ask again"
)

Perform = Callable[[str, Mapping[str, Any]], Awaitable[dict[str, Any]]]
"""Verb (below the family's name) and data to the data of the answer."""


@dataclass(frozen=True, slots=True)
class _Asked:
    """A request, and where its answer goes."""

    verb: str
    data: dict[str, JsonValue]
    transaction: Transaction
    answer_to: str
    correlation: bytes | None


def in_turn(perform: Perform) -> Perform:
    """Return the same for a family whose requests are carried out one after another, in order."""
    turn = asyncio.Lock()

    async def perform_in_turn(verb: str, data: Mapping[str, Any]) -> dict[str, Any]:
        async with turn:
            return await perform(verb, data)

    return perform_in_turn


class RequestLine:
    """The connection by which requests come; it stays while one service takes over from another, so that
    what is asked meanwhile is answered by the next."""

    def __init__(self, settings: MqttSettings, gateway: str) -> None:
        self.settings = settings
        self.topics = Topics(settings.base_topic, gateway)
        self.dropped = 0
        """Came faster than they are taken for so long that too many waited."""
        self.client: aiomqtt.Client | None = None
        self._connected = asyncio.Event()
        self._take: Callable[[aiomqtt.Message], Awaitable[None]] | None = None
        self._taken = asyncio.Event()
        self._port: int | None = None
        self._listening: asyncio.Task[None] | None = None
        self._allowance = Allowance(MOST_A_SECOND, MOST_AT_ONCE)
        self._complained_s = -math.inf

    def is_as(self, other: RequestLine) -> bool:
        """Return whether it leads to the same requests."""
        return (self.settings.door, self.topics) == (other.settings.door, other.topics)

    def open(self, port: int, take: Callable[[aiomqtt.Message], Awaitable[None]]) -> None:
        """Give requests to ``take`` from now on; returns at once. One that is open already stays so."""
        self._take = take
        self._taken.set()
        if self._port != port:
            if self._listening is not None:
                self._listening.cancel()
            self._port = port
            self._listening = asyncio.create_task(self._listen_for_ever(port), name="requests")

    def hold(self) -> None:
        """Let requests wait until it is opened anew."""
        self._taken.clear()

    async def close(self) -> None:
        """End at once."""
        if self._listening is not None:
            await end_tasks(self._listening)
        self._listening = self._port = None

    async def publish(self, topic: str, payload: bytes, properties: Properties | None) -> None:
        """Publish an answer; one that meets a lost connection goes out over the next.

        Raises ``TimeoutError`` where none comes for long.
        """
        async with asyncio.timeout(_LONGEST_AWAY_S):
            while True:
                await self._connected.wait()
                assert self.client is not None
                try:
                    await self.client.publish(topic, payload, qos=1, properties=properties)
                except aiomqtt.MqttError as error:
                    _log.debug("an answer meets a lost connection: %s", error)
                    # The loss may be known here before the connection is given up.
                    await asyncio.sleep(_TRY_AGAIN_S)
                else:
                    return

    async def _listen_for_ever(self, port: int) -> None:
        turns = BrokerTurns(self.settings, port)

        def connect() -> AbstractAsyncContextManager[aiomqtt.Client]:
            settings, identifier = turns.settings, unique_identifier("requests")
            return broker_connection(settings, settings.port, identifier, on_full=self._note_dropped)

        def lost(error: Exception) -> None:
            # The output for poses says so too, as a warning.
            _log.debug("requests: %s", explain(error, turns.settings, turns.settings.port))

        await keep_connected(turns, connect, self._listen, lost, asyncio.Event())

    async def _listen(self, client: aiomqtt.Client) -> None:
        # Its parent matches too: a request without a family is answered as any other.
        await client.subscribe(self.topics.request("#"), qos=1)
        self.client = client
        self._connected.set()
        watching = [keep_asking(client, self.settings.answer_within)] if self.settings.is_watched else []
        try:
            await first_to_end(self._take_all(client), *watching)
        finally:
            self.client = None
            self._connected.clear()

    async def _take_all(self, client: aiomqtt.Client) -> None:
        """Take requests until the connection ends. Raises ``aiomqtt.MqttError`` when it was lost."""
        async for message in client.messages:
            await self._in_time()
            await self._taken.wait()
            assert self._take is not None
            await self._take(message)

    async def _in_time(self) -> None:
        """Wait until one more request may be taken."""
        while not self._allowance.takes(time.monotonic()):  # noqa: ASYNC110 - time is what is waited for
            await asyncio.sleep(1.0 / MOST_A_SECOND)

    def _note_dropped(self) -> None:
        """Count what does not fit among those that wait, and say so now and then."""
        now_s = time.monotonic()
        self.dropped += 1
        if now_s - self._complained_s > _COMPLAINT_INTERVAL_S:
            self._complained_s = now_s
            _log.warning("requests come faster than %g a second: %d dropped", MOST_A_SECOND, self.dropped)


class RequestResponder:
    """Answers requests for ever: a broker that is away is tried again and again.

    families: what carries out ``<family>/<verb>``, by family; it is asked anew before it has answered.
    """

    def __init__(self, settings: MqttSettings, gateway: str, families: Mapping[str, Perform]) -> None:
        self.answered = 0
        self._settings = settings
        self._line = RequestLine(settings, gateway)
        self._successor: RequestResponder | None = None
        self._families = families
        self._under_way: dict[asyncio.Task[None], str] = {}

    @property
    def is_connected(self) -> bool:
        """Whether requests come in."""
        return self._line.client is not None

    @property
    def dropped(self) -> int:
        """Requests that came too fast to be answered."""
        return self._line.dropped

    def statistics(self) -> dict[str, object]:
        """Return counters for the health message."""
        return {"answered": self.answered, "dropped": self.dropped, "waiting": len(self._under_way)}

    def follow(self, former: RequestResponder) -> None:
        """Take over the connection of one that is to be stopped, where the next would be the same."""
        if self._line.is_as(former._line):
            former._successor, self._line = self, former._line
            self._line.settings = self._settings

    def release(self, former: RequestResponder) -> None:
        """Undo ``follow``."""
        if former._successor is self:
            former._successor, self._line = None, RequestLine(self._settings, former._topics.gateway)
            former._line.settings = former._settings

    def start(self, port: int) -> None:
        """Begin to answer, at the broker on this port; returns at once."""
        self._line.open(port, self._take)

    async def stop(self) -> None:
        """End at once. Requests under way are broken off, which is answered; those that come later are the
        successor's, where there is one."""
        self._line.hold()
        await asyncio.sleep(0)  # a task that is cancelled before it has begun would answer nothing
        await end_tasks(*self._under_way)
        if self._successor is None:
            await self._line.close()

    @property
    def _topics(self) -> Topics:
        return self._line.topics

    async def _take(self, message: aiomqtt.Message) -> None:
        verb = self._verb_of(message)
        # A retained request would be carried out again at every start.
        if verb is None or message.retain:
            return
        answer_to, correlation = self._way_back(message, verb)
        family = verb.partition("/")[0]
        data: dict[str, JsonValue] = {}
        transaction: Transaction = None
        refusal = None
        try:
            data, transaction = parse_request(message.payload)
            if list(self._under_way.values()).count(family) >= _MOST_UNDER_WAY:
                refusal = "too many requests are waiting: ask again later"
        except RequestProblem as problem:
            refusal = str(problem)
        asked = _Asked(verb, data, transaction, answer_to, correlation)
        # An answer may wait for the connection, which this must not hold up.
        task = asyncio.create_task(self._carry_out(asked, refusal), name=f"request {verb}")
        self._under_way[task] = family if refusal is None else _REFUSED
        task.add_done_callback(self._under_way.pop)

    async def _carry_out(self, asked: _Asked, refusal: str | None) -> None:
        answering: asyncio.Future[None] | None = None
        try:
            response = await self._perform(asked) if refusal is None else _error(asked, refusal)
            answering = asyncio.ensure_future(self._answer(asked, response))
            await asyncio.shield(answering)
        except asyncio.CancelledError:
            # An answer that is under way may have left: it is waited for, not sent twice.
            await (answering or self._answer(asked, _error(asked, _BROKEN_OFF)))
            raise
        except Exception:
            # Whatever it was, it is not to pass for a task that nobody looks at.
            _log.exception("request '%s' was not answered", asked.verb)

    async def _perform(self, asked: _Asked) -> ResponseMessage:
        family, _, verb = asked.verb.partition("/")
        perform = self._families.get(family)
        if perform is None:
            return _error(asked, f"there is no request '{asked.verb}'{nearest(family, self._families)}")
        try:
            data = await perform(verb, asked.data)
            return ResponseMessage(status="ok", data=data, transaction=asked.transaction)
        except (GatewayError, DeviceError, LinkError) as error:
            return _error(asked, str(error))
        except Exception as error:
            _log.exception("request '%s' failed", asked.verb)
            return _error(asked, f"this should not have happened ({error!r}): the gateway's log has more")

    async def _answer(self, asked: _Asked, response: ResponseMessage) -> None:
        properties = properties_of(self._settings.protocol_in_use, JSON)
        if properties is not None and asked.correlation is not None:
            properties.CorrelationData = asked.correlation
        try:
            await self._line.publish(asked.answer_to, response.payload(), properties)
            self.answered += 1
        except TimeoutError:
            _log.warning("the answer to '%s' was lost: no broker for %g s", asked.verb, _LONGEST_AWAY_S)

    def _verb_of(self, message: aiomqtt.Message) -> str | None:
        address = self._topics.split(message.topic.value)
        if address is None:
            return None
        return address[1].removeprefix(topics.BRIDGE_REQUEST).removeprefix("/")[:_LONGEST_VERB]

    def _way_back(self, message: aiomqtt.Message, verb: str) -> tuple[str, bytes | None]:
        """Return the topic and correlation data of the answer: those asked for with MQTT 5, where that is
        harmless."""
        properties = message.properties
        wanted = getattr(properties, "ResponseTopic", None)
        correlation = getattr(properties, "CorrelationData", None)
        if wanted is not None and not self._may_be_answered_at(wanted):
            _log.info("no answer to '%s' at %r: mqtt.response_topics does not allow it", verb, wanted)
            wanted = None
        if wanted is None:
            wanted = self._topics.response(verb)
        is_short = isinstance(correlation, bytes) and len(correlation) <= _LONGEST_CORRELATION
        return wanted, correlation if is_short else None

    def _may_be_answered_at(self, topic: object) -> bool:
        """Return whether an answer there can be taken for nothing else: the gateway may publish where those
        who ask may not, and is not to switch lamps for them."""
        if not isinstance(topic, str) or len(topic) > _LONGEST_TOPIC or set(topic) & set("+#\0"):
            return False
        allowed = (self._topics.response(""), *(f"{prefix}/" for prefix in self._settings.response_topics))
        return topic.startswith(allowed)


def _error(asked: _Asked, error: str) -> ResponseMessage:
    return ResponseMessage(status="error", error=error, transaction=asked.transaction)
