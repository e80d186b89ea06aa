"""Requests to the gateway over MQTT: ``bridge/request/<verb>`` to ``bridge/response/<verb>``.

It has a connection of its own, so that an answer never stands in the way of a pose. Requests are
carried out beside one another, so that a long one holds up nobody; what may not be done at once waits its
turn in the family (``in_turn``). Too many of a family under way are answered with an error at once. Faster
than ``MOST_A_SECOND`` they are dropped without an answer, and counted.
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
from pydantic import JsonValue

from devices.device_errors import DeviceError
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


class RequestResponder:
    """Answers requests for ever: a broker that is away is tried again and again.

    families: what carries out ``<family>/<verb>``, by family; it is asked anew before it has answered.
    """

    def __init__(self, settings: MqttSettings, gateway: str, families: Mapping[str, Perform]) -> None:
        self.answered = 0
        self.dropped = 0
        """Came faster than they are taken."""
        self.is_connected = False
        self._settings = settings
        self._topics = Topics(settings.base_topic, gateway)
        self._families = families
        self._under_way: dict[asyncio.Task[None], str] = {}
        self._client: aiomqtt.Client | None = None
        self._tasks: list[asyncio.Task[None]] = []
        self._allowance = Allowance(MOST_A_SECOND, MOST_AT_ONCE)
        self._complained_s = -math.inf

    def statistics(self) -> dict[str, object]:
        """For the health message."""
        return {"answered": self.answered, "dropped": self.dropped, "waiting": len(self._under_way)}

    def start(self, port: int) -> None:
        """Begin to answer, at the broker on this port; returns at once."""
        self._tasks = [asyncio.create_task(self._listen_for_ever(port), name="requests")]

    async def stop(self) -> None:
        """End at once; requests under way are not answered any more."""
        await end_tasks(*self._tasks, *self._under_way)
        self._tasks = []

    async def _listen_for_ever(self, port: int) -> None:
        turns = BrokerTurns(self._settings, port)

        def connect() -> AbstractAsyncContextManager[aiomqtt.Client]:
            settings, identifier = turns.settings, unique_identifier("requests")
            return broker_connection(settings, settings.port, identifier, on_full=self._note_dropped)

        def lost(error: Exception) -> None:
            # The output for poses says so too, as a warning.
            _log.debug("requests: %s", explain(error, turns.settings, turns.settings.port))

        await keep_connected(turns, connect, self._listen, lost, asyncio.Event())

    async def _listen(self, client: aiomqtt.Client) -> None:
        await client.subscribe(self._topics.request("#"), qos=1)
        self._client, self.is_connected = client, True
        settings = self._settings
        watching = [keep_asking(client, settings.answer_within)] if settings.is_watched else []
        try:
            await first_to_end(self._take_all(client), *watching)
        finally:
            self._client, self.is_connected = None, False

    async def _take_all(self, client: aiomqtt.Client) -> None:
        """Until the connection ends; raises ``aiomqtt.MqttError`` when it was lost."""
        async for message in client.messages:
            await self._take(message)

    async def _take(self, message: aiomqtt.Message) -> None:
        verb = self._verb_of(message)
        # A retained request would be carried out again at every start.
        if verb is None or message.retain or not self._is_in_time():
            return
        answer_to, correlation = self._way_back(message, verb)
        try:
            data, transaction = parse_request(message.payload)
        except RequestProblem as problem:
            asked = _Asked(verb, {}, None, answer_to, correlation)
            await self._answer(asked, _error(asked, str(problem)))
            return
        asked = _Asked(verb, data, transaction, answer_to, correlation)
        family = verb.partition("/")[0]
        if list(self._under_way.values()).count(family) >= _MOST_UNDER_WAY:
            await self._answer(asked, _error(asked, "too many requests are waiting: ask again later"))
            return
        task = asyncio.create_task(self._carry_out(asked), name=f"request {verb}")
        self._under_way[task] = family
        task.add_done_callback(self._under_way.pop)

    def _is_in_time(self) -> bool:
        """Whether one more request is taken now; if not, that is counted, and said now and then."""
        if self._allowance.takes(time.monotonic()):
            return True
        self._note_dropped()
        return False

    def _note_dropped(self) -> None:
        now_s = time.monotonic()
        self.dropped += 1
        if now_s - self._complained_s > _COMPLAINT_INTERVAL_S:
            self._complained_s = now_s
            _log.warning("requests come faster than %g a second: %d dropped", MOST_A_SECOND, self.dropped)

    async def _carry_out(self, asked: _Asked) -> None:
        try:
            await self._answer(asked, await self._perform(asked))
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
        if self._client is None:
            return
        properties = properties_of(self._settings.protocol_in_use, JSON)
        if properties is not None and asked.correlation is not None:
            properties.CorrelationData = asked.correlation
        try:
            await self._client.publish(asked.answer_to, response.payload(), qos=1, properties=properties)
            self.answered += 1
        except aiomqtt.MqttError as error:
            _log.warning("the answer to '%s' was lost: %s", asked.verb, error)

    def _verb_of(self, message: aiomqtt.Message) -> str | None:
        address = self._topics.split(message.topic.value)
        prefix = f"{topics.BRIDGE_REQUEST}/"
        if address is None or not address[1].startswith(prefix):
            return None
        return address[1].removeprefix(prefix)[:_LONGEST_VERB]

    def _way_back(self, message: aiomqtt.Message, verb: str) -> tuple[str, bytes | None]:
        """Topic and correlation data of the answer: those asked for with MQTT 5, where that is harmless."""
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
        """Whether an answer there can be taken for nothing else: the gateway may publish where those who ask
        may not, and is not to switch lamps for them."""
        if not isinstance(topic, str) or len(topic) > _LONGEST_TOPIC or set(topic) & set("+#\0"):
            return False
        allowed = (self._topics.response(""), *(f"{prefix}/" for prefix in self._settings.response_topics))
        return topic.startswith(allowed)


def _error(asked: _Asked, error: str) -> ResponseMessage:
    return ResponseMessage(status="error", error=error, transaction=asked.transaction)
