"""Cameras behind the broker: does it answer and let us listen, and which of them send."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Iterator

import aiomqtt

from devices.cameras.heat_map_messages import is_one_message
from devices.endpoints import EndpointError
from gateway.cameras.broker_link import SCHEME, BrokerLink, link_of
from gateway.doctor.findings import Finding, bad, good, warning
from gateway.outputs.connection import broker_connection, explain, unique_identifier
from gateway.outputs.settings import MqttSettings
from gateway.sources.link_settings import LinkSettings

_FIRST_FAILURE = 128
"""Reason codes from here on are refusals (MQTT 5, table 3-8; MQTT 3.1.1 has this one)."""


def is_at_broker(link: LinkSettings) -> bool:
    """Whether the link has no port of its own, but a topic of the gateway's broker."""
    return link.url.startswith(f"{SCHEME}:")


async def camera_topic(link: LinkSettings, mqtt: MqttSettings, seconds: float) -> list[Finding]:
    """Subscribes as the gateway would, and listens for so many seconds (0: not at all)."""
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
            heard = await _heard(client, seconds)
    except Exception as error:
        found, _, remedy = explain(error, mqtt, mqtt.port).partition(": ")
        return [bad(subject, found, remedy or "see the finding about the broker")]
    answers = good(subject, f"{link.url} at {where}: the broker answers and lets us listen")
    return [answers, *(_senders(link.name, made.topic, mqtt, heard, seconds) if seconds else ())]


async def _heard(client: aiomqtt.Client, seconds: float) -> Counter[tuple[str, bool]]:
    """Messages by topic and whether they are what they should be."""
    heard: Counter[tuple[str, bool]] = Counter()

    async def listen() -> None:
        async for message in client.messages:
            payload = message.payload
            is_right = isinstance(payload, bytes) and is_one_message(payload)
            heard[message.topic.value, is_right] += not message.retain

    listening = asyncio.create_task(listen())
    await asyncio.wait({listening}, timeout=seconds)
    if listening.done():
        listening.result()  # the connection was lost
    listening.cancel()
    await asyncio.gather(listening, return_exceptions=True)
    return heard


def _right_to_read(mqtt: MqttSettings, topic: str) -> str:
    who = "clients without a name" if mqtt.username is None else f"user '{mqtt.username}'"
    return f"let {who} read {topic} (acl_file of mosquitto)"


def _senders(
    name: str, topic: str, mqtt: MqttSettings, heard: Counter[tuple[str, bool]], seconds: float
) -> Iterator[Finding]:
    subject = f"{name}: data"
    others = sorted(place for (place, is_right), count in heard.items() if count and not is_right)
    if others:
        found = f"something else than heat maps comes on {', '.join(others)}"
        yield warning(f"{name}: topic", found, "write a topic that is the cameras' alone")
    sending = {place: count for (place, is_right), count in heard.items() if count and is_right}
    if not sending:
        remedy = (
            f"start the cameras: mocap-gateway video serve-camera … --mqtt {mqtt.host}:{mqtt.port}; "
            f"with access lists, {_right_to_read(mqtt, topic)}"
        )
        yield warning(subject, f"no camera sends on {topic} (listened {seconds:g} s)", remedy)
        return
    rates = ", ".join(f"{place} {count / seconds:.0f} a second" for place, count in sorted(sending.items()))
    yield good(subject, f"cameras send: {rates}")
