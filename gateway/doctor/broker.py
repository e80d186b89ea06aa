"""The MQTT broker: there, lets us in, and quick; and the cameras behind it."""

from __future__ import annotations

import asyncio
import contextlib
import secrets
import time
from collections import Counter
from collections.abc import Iterator

import aiomqtt
import numpy as np

from devices.cameras.heat_map_messages import camera_of
from devices.endpoints import EndpointError
from gateway.cameras.broker_link import SCHEME, BrokerLink, link_of
from gateway.contract.request_messages import ResponseMessage
from gateway.contract.topics import Topics
from gateway.doctor.findings import Finding, Surroundings, bad, good, warning
from gateway.outputs.connection import broker_connection, explain, unique_identifier
from gateway.outputs.settings import MqttSettings
from gateway.sources.link_settings import LinkSettings

ROUNDS = 5
PINGS_A_ROUND = 20
PINGS = ROUNDS * PINGS_A_ROUND
_INTERVAL_S = 0.005
_PATIENCE_S = 2.0
_SLOW_MS = 8.0
_STALL_MS = (25.0, 80.0)
"""A system acknowledges after 40 ms what it has nothing to answer to; who waits for that stalls so long."""


async def broker(settings: MqttSettings, gateway: str, surroundings: Surroundings) -> list[Finding]:
    """Return whether the broker takes us, and how long a message is on its way through it."""
    if settings.broker == "embedded":
        return [good("broker", f"embedded, on port {settings.port}: started with the gateway")]
    try:
        delays_ms = await _travel_times_ms(settings, Topics(settings.base_topic, gateway))
    except Exception as error:
        found, _, remedy = explain(error, settings, settings.port).partition(": ")
        elsewhere = await _brokers_elsewhere(settings, surroundings)
        if elsewhere:
            remedy = f"an MQTT broker answers on port {elsewhere[0]}: write port: {elsewhere[0]} below mqtt"
        return [bad("broker", found, remedy or "start mosquitto, or correct mqtt.host and mqtt.port")]
    return list(_judge(settings, delays_ms))


def _judge(settings: MqttSettings, delays_ms: list[float]) -> Iterator[Finding]:
    where = f"{settings.host}:{settings.port}"
    if len(delays_ms) < PINGS:
        yield bad(
            "broker",
            f"{where} relayed {len(delays_ms)} of {PINGS} messages",
            f"let user '{settings.username}' read and write {settings.base_topic}/# (acl_file of mosquitto)",
        )
        return
    p50, p99 = (float(np.percentile(delays_ms, q)) for q in (50, 99))
    found = f"{where} passes messages on in {p50:.1f} ms (99 %: {p99:.1f} ms)"
    stall_ms = float(np.median(np.reshape(delays_ms, (ROUNDS, PINGS_A_ROUND)).max(axis=1)))
    if _STALL_MS[0] < stall_ms < _STALL_MS[1] and stall_ms > 3 * p50:
        found += f", but stalls for {stall_ms:.0f} ms when a client has sent something"
        yield warning("broker", found, "set_tcp_nodelay true in mosquitto.conf")
    elif p50 > _SLOW_MS:
        yield warning("broker", found, "a broker nearer by, or a less busy network")
    else:
        yield good("broker", found)


async def _travel_times_ms(settings: MqttSettings, topics: Topics) -> list[float]:
    """Return times from publishing to receiving, ms.

    Each end has a connection of its own, so that nothing carries acknowledgements along.

    Each round begins with something that the reader sends: then its system puts acknowledgements off, and a
    broker that waits for them (Nagle's algorithm) shows.
    """
    verb = f"doctor/{secrets.token_hex(4)}"
    topic = topics.response(verb)
    sent_at: dict[int, float] = {}
    delays_ms: list[float] = []

    async def receive(reader: aiomqtt.Client) -> None:
        async for message in reader.messages:
            if message.topic.value != topic:
                continue
            number = ResponseMessage.model_validate_json(message.payload).transaction
            if isinstance(number, int):
                delays_ms.append((time.perf_counter() - sent_at[number]) * 1e3)
            if len(delays_ms) == PINGS:
                return

    port = settings.port
    async with (
        broker_connection(settings, port, unique_identifier("doctor")) as reader,
        broker_connection(settings, port, unique_identifier("doctor")) as writer,
    ):
        receiving = asyncio.create_task(receive(reader))
        for number in range(PINGS):
            if number % PINGS_A_ROUND == 0:
                await reader.subscribe(topic)
            sent_at[number] = time.perf_counter()
            payload = ResponseMessage(status="ok", data={"padding": "x" * 1000}, transaction=number).payload()
            await writer.publish(topic, payload)
            await asyncio.sleep(_INTERVAL_S)
        await asyncio.wait({receiving}, timeout=_PATIENCE_S)
        receiving.cancel()
        await asyncio.gather(receiving, return_exceptions=True)
    return delays_ms


async def _brokers_elsewhere(settings: MqttSettings, surroundings: Surroundings) -> list[int]:
    """Return ports of the same host on which a broker does answer, with or without letting us in."""
    found = []
    for port in surroundings.usual_broker_ports:
        if port == settings.port:
            continue
        # Any error says the same: no broker that is of use answers there.
        with contextlib.suppress(Exception):
            async with broker_connection(settings, port, unique_identifier("doctor")):
                found.append(port)
    return found


_FIRST_FAILURE = 128
"""Reason codes from here on are refusals (MQTT 5, table 3-8; MQTT 3.1.1 has this one)."""


def is_at_broker(link: LinkSettings) -> bool:
    """Return whether the link has no port of its own, but a topic of the gateway's broker."""
    return link.url.startswith(f"{SCHEME}:")


async def camera_topic(link: LinkSettings, mqtt: MqttSettings, seconds: float) -> list[Finding]:
    """Subscribe as the gateway would, and listens for so many seconds (0: not at all)."""
    subject = f"{link.name}: port"
    try:
        made = link_of(link, mqtt, lambda: mqtt.port)
    except EndpointError as error:
        found, _, remedy = str(error).partition(": write ")
        return [bad(subject, found, f"write {remedy}")]
    assert isinstance(made, BrokerLink)
    where = f"{mqtt.host}:{mqtt.port}"
    if mqtt.broker == "embedded":
        return [
            good(subject, f"{link.url} is at the embedded broker, port {mqtt.port}: there with the gateway")
        ]
    try:
        async with broker_connection(mqtt, mqtt.port, unique_identifier("doctor")) as client:
            (answer,) = await client.subscribe(made.topic, 0)
            if (answer if isinstance(answer, int) else answer.value) >= _FIRST_FAILURE:
                found = f"the broker at {where} answers and refuses to let us listen"
                return [bad(subject, found, _right_to_read(mqtt, made.topic))]
            counts = await _count_messages(client, seconds)
    except Exception as error:
        found, _, remedy = explain(error, mqtt, mqtt.port).partition(": ")
        return [bad(subject, found, remedy or "see the finding about the broker")]
    answers = good(subject, f"{link.url} at {where}: the broker answers and lets us listen")
    return [answers, *(_senders(link.name, made.topic, mqtt, counts, seconds) if seconds else ())]


async def _count_messages(client: aiomqtt.Client, seconds: float) -> Counter[tuple[str, bool]]:
    """Return messages by topic and whether they are what they should be."""
    counts: Counter[tuple[str, bool]] = Counter()

    async def listen() -> None:
        async for message in client.messages:
            payload = message.payload
            is_right = isinstance(payload, bytes) and camera_of(payload) is not None
            counts[message.topic.value, is_right] += not message.retain

    listening = asyncio.create_task(listen())
    await asyncio.wait({listening}, timeout=seconds)
    if listening.done():
        listening.result()  # the connection was lost
    listening.cancel()
    await asyncio.gather(listening, return_exceptions=True)
    return counts


def _right_to_read(mqtt: MqttSettings, topic: str) -> str:
    who = "clients without a name" if mqtt.username is None else f"user '{mqtt.username}'"
    return f"let {who} read {topic} (acl_file of mosquitto)"


def _senders(
    name: str, topic: str, mqtt: MqttSettings, counts: Counter[tuple[str, bool]], seconds: float
) -> Iterator[Finding]:
    subject = f"{name}: data"
    others = sorted(place for (place, is_right), count in counts.items() if count and not is_right)
    if others:
        found = f"something else than heat maps comes on {', '.join(others)}"
        yield warning(f"{name}: topic", found, "write a topic that is the cameras' alone")
    sending = {place: count for (place, is_right), count in counts.items() if count and is_right}
    if not sending:
        remedy = (
            f"start the cameras: mocap-gateway video serve-camera … --mqtt {mqtt.host}:{mqtt.port}; "
            f"with access lists, {_right_to_read(mqtt, topic)}"
        )
        yield warning(subject, f"no camera sends on {topic} (listened {seconds:g} s)", remedy)
        return
    rates = ", ".join(f"{place} {count / seconds:.0f} a second" for place, count in sorted(sending.items()))
    yield good(subject, f"cameras send: {rates}")
