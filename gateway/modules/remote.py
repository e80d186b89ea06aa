"""The same verbs asked of a running gateway, over its broker."""

from __future__ import annotations

import asyncio
import contextlib
import secrets
from collections.abc import AsyncIterator, Mapping
from typing import Any

import aiomqtt
import orjson
from pydantic import ValidationError

from gateway.contract import topics
from gateway.contract.messages import BridgeState
from gateway.contract.request_messages import ResponseMessage
from gateway.contract.topics import ANY_GATEWAY, Topics
from gateway.modules.operations import Plain, RequestError
from gateway.outputs.connection import explain
from gateway.outputs.failover import BrokerUnreachableError, any_connection
from gateway.outputs.settings import MqttSettings

_RETAINED_S = 1.0
"""Time for the first retained state of a gateway to come."""
_REST_S = 0.3
"""And for those of others after it: a broker sends all that it has retained in one go."""

_ANSWER_S = 90.0
"""Longest wait for an answer: changing many ids, with a module that restarts, takes a while."""
_EXPORT_S = 1800.0
"""And for an export: of a long recording, beside poses that go on."""


class RemoteOperations:
    """Asks a gateway; made by ``remote_suit``."""

    def __init__(
        self, client: aiomqtt.Client, settings: MqttSettings, topics_of_gateway: Topics, family: str
    ) -> None:
        self._client = client
        self._family = family
        self._topics = topics_of_gateway
        self._settings = settings

    async def perform(self, verb: str, data: Mapping[str, Any]) -> Plain:
        """Perform a verb as ``ModuleOperations.perform`` does; whatever failed there raises ``RequestError``
        here.
        """
        transaction = secrets.token_hex(8)
        request = orjson.dumps({**data, "transaction": transaction})
        # An export writes whole files, and takes longer than anything else.
        longest_s = _EXPORT_S if verb == "export" else _ANSWER_S
        try:
            await self._client.publish(self._topics.request(f"{self._family}/{verb}"), request, qos=1)
            async with asyncio.timeout(longest_s):
                return await self._answer(transaction)
        except TimeoutError:
            raise BrokerUnreachableError(
                f"gateway '{self._topics.gateway}' did not answer within {longest_s:.0f} s: is it running?"
            ) from None
        except aiomqtt.MqttError as error:
            raise BrokerUnreachableError(explain(error, self._settings, self._settings.port)) from error

    async def _answer(self, transaction: str) -> Plain:
        async for message in self._client.messages:
            response = _response(message)
            if response is None or response.transaction != transaction:
                continue
            if response.status == "error":
                raise RequestError(f"gateway '{self._topics.gateway}': {response.error}")
            return dict(response.data)
        raise RequestError("the broker ended the connection: ask again")


@contextlib.asynccontextmanager
async def remote_suit(
    settings: MqttSettings, gateway: str = ANY_GATEWAY, family: str = "modules"
) -> AsyncIterator[RemoteOperations]:
    """Connect to a broker of a gateway; without a name to that of the only one that is online.

    family: first part of the verbs that will be asked for.
    Raises ``BrokerUnreachableError``, ``RequestError`` when there is none or more than one, and
    ``TopicError`` where the name cannot stand in a topic.
    """
    answers = Topics(settings.base_topic, gateway).response(f"{family}/+")
    # Subscribed before anything is asked: an answer without a subscriber is lost.
    async with any_connection(settings, family, [answers]) as (client, door):
        try:
            gateway = await _present_gateway(client, door, gateway)
        except aiomqtt.MqttError as error:
            raise BrokerUnreachableError(explain(error, door, door.port)) from error
        yield RemoteOperations(client, door, Topics(settings.base_topic, gateway), family)


async def _present_gateway(client: aiomqtt.Client, settings: MqttSettings, wanted: str) -> str:
    """Return the gateway that is meant. Raises ``RequestError`` where it is not online.

    A command from somebody who names none must not reach one of several by chance. One that is named is taken
    at its word where the broker tells of no gateway at all: that may be for want of a right.
    """
    is_online = await _states(client, settings, wanted)
    online = sorted(name for name, state in is_online.items() if state)
    there = f"online are {', '.join(online)}: name one with --gateway" if online else "none is online"
    if wanted != ANY_GATEWAY:
        if is_online and not is_online.get(wanted, False):
            raise RequestError(
                f"gateway '{wanted}' is not online at {settings.host}:{settings.port}: {there}"
            )
        return wanted
    if len(online) != 1:
        raise RequestError(f"which gateway at {settings.host}:{settings.port}? {there}")
    return online[0]


async def _states(client: aiomqtt.Client, settings: MqttSettings, wanted: str) -> dict[str, bool]:
    """Return of every gateway whether it is online, or at least of the one that is wanted."""
    every = Topics(settings.base_topic, ANY_GATEWAY)
    await client.subscribe(every.bridge_state, qos=1)
    states: dict[str, bool] = {}
    # Retained messages come at once, one after another: after the first, a short pause means that all have
    # come.
    first = True
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(_RETAINED_S) as waiting:
            async for message in client.messages:
                address = every.split(message.topic.value)
                if address is None or address[1] != topics.BRIDGE_STATE:
                    continue
                if first and wanted == ANY_GATEWAY:
                    waiting.reschedule(asyncio.get_running_loop().time() + _REST_S)
                    first = False
                states[address[0]] = _is_online(message)
                # One that takes another configuration into use is offline for a moment.
                if address[0] == wanted and states[wanted]:
                    break
    await client.unsubscribe(every.bridge_state)
    return states


def _is_online(message: aiomqtt.Message) -> bool:
    try:
        return BridgeState.model_validate_json(message.payload).state == "online"
    except ValidationError:
        return False


def _response(message: aiomqtt.Message) -> ResponseMessage | None:
    try:
        return ResponseMessage.model_validate_json(message.payload)
    except ValidationError:
        return None  # not one of a request
