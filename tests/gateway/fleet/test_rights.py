"""What each user of a cluster may publish and hear, on real brokers, with the users of `fleet users`."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Iterator
from pathlib import Path

import aiomqtt
import pytest

from gateway.errors import GatewayError
from gateway.fleet import cluster as clusters
from gateway.fleet.cluster import LEAF
from gateway.outputs.connection import broker_connection, unique_identifier
from gateway.outputs.settings import MqttSettings
from tests.fixtures.clusters import GATEWAYS, GuardedCluster, settle
from tests.patience import PATIENCE_S

pytestmark = pytest.mark.system

EVERYBODY = f"{LEAF}test"
"""A user of the kind of whole nodes, to which nothing is forbidden: who listens, and says what is heard."""

OWN = ("pose", "pose/late", "body", "bridge/state", "bridge/info", "bridge/health", "module/1/state")
ASKED = ("gateway/health", "recording/start", "modules/list", "reset/heading")
SETTINGS = ("gateway/configure", "gateway/confirm")
ANSWER = "bridge/response/gateway/health"
ELSEWHERE = (
    "lab/pose",
    "other/lab/pose",
    "homeassistant/device/x/config",
    "$JS/API/STREAM/DELETE/$MQTT_rmsgs",
)


def of(gateway: str, *below: str) -> set[str]:
    return {f"mocap/{gateway}/{each}" for each in below}


def requests(gateway: str, verbs: tuple[str, ...]) -> set[str]:
    return of(gateway, *(f"bridge/request/{verb}" for verb in verbs))


ECHO = of("reader-1", "bridge/echo/2")
ALL = (
    {topic for gateway in GATEWAYS for topic in of(gateway, *OWN, ANSWER, "bridge/echo/1")}
    | {topic for gateway in GATEWAYS for topic in requests(gateway, ASKED + SETTINGS)}
    | ECHO
    | set(ELSEWHERE)
)
MAY_PUBLISH = {
    "lab": {topic for topic in ALL if topic.startswith("mocap/lab/")},
    "ward": {topic for topic in ALL if topic.startswith("mocap/ward/")},
    "overview": {topic for gateway in GATEWAYS for topic in requests(gateway, ASKED)}
    | {topic for topic in ALL if "/bridge/echo/" in topic},
    "operator": {topic for gateway in GATEWAYS for topic in requests(gateway, ASKED + SETTINGS)}
    | {topic for topic in ALL if "/bridge/echo/" in topic},
}
ASKING = b"does this arrive?"
LAST = {"lab": "mocap/lab/bridge/last", "ward": "mocap/ward/bridge/last"}
"""Comes after all else of a user; of the readers an echo does."""

RECEIVED = {
    ("lab", "mocap/lab/bridge/request/#"): "mocap/lab/bridge/request/gateway/health",
    ("lab", "mocap/lab/bridge/state"): "mocap/lab/bridge/state",
    ("overview", "mocap/#"): "mocap/ward/pose",
    ("overview", "mocap/+/pose/late"): "mocap/ward/pose/late",
    ("overview", "mocap/+/bridge/response/#"): "mocap/lab/bridge/response/gateway/health",
    ("operator", "mocap/#"): "mocap/ward/pose",
    ("operator", "mocap/+/bridge/response/#"): "mocap/lab/bridge/response/gateway/configure",
}
REFUSED = {
    ("lab", "mocap/#"): "mocap/ward/pose",
    ("lab", "mocap/ward/pose"): "mocap/ward/pose",
    ("lab", "mocap/+/bridge/request/#"): "mocap/ward/bridge/request/gateway/health",
    ("ward", "mocap/lab/bridge/request/#"): "mocap/lab/bridge/request/gateway/health",
    ("overview", "#"): "other/lab/pose",
    ("overview", "other/#"): "other/lab/pose",
    ("operator", "#"): "other/lab/pose",
    ("operator", "homeassistant/#"): "homeassistant/device/x/config",
}


class Users(GuardedCluster):
    """With a user who may do everything."""

    gateways = (*GATEWAYS, EVERYBODY)


@pytest.fixture(scope="module")
def users(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Users]:
    try:
        clusters.program()
    except GatewayError as error:
        pytest.skip(str(error))
    with Users(tmp_path_factory.mktemp("users") / "cluster") as running:
        asyncio.run(settle(running))
        yield running


def connected(
    settings: MqttSettings,
) -> contextlib.AbstractAsyncContextManager[aiomqtt.Client]:
    return broker_connection(settings, settings.port, unique_identifier("test"), timeout_s=PATIENCE_S)


async def known_at_all_nodes(listener: aiomqtt.Client, speaker: aiomqtt.Client, newest: str) -> None:
    """Wait until what is published at the speaker's node reaches a listener at another one.

    Nodes tell each other of subscriptions after they have answered them, in their order: what is published
    at another node before that is lost.
    """
    arrived = asyncio.create_task(anext(listener.messages))
    while not arrived.done():
        await speaker.publish(newest, ASKING)
        await asyncio.wait([arrived], timeout=0.1)
    assert arrived.result().payload == ASKING


@pytest.mark.parametrize("user", MAY_PUBLISH)
async def test_each_user_publishes_what_is_theirs_and_nothing_else(users: Users, user: str):
    last = LAST.get(user, "mocap/reader-1/bridge/echo/last")
    heard: set[str] = set()
    async with (
        connected(users.settings(EVERYBODY, first=1)) as everybody,
        connected(users.settings(user)) as client,
    ):
        for topic in (*ALL, last):
            await everybody.subscribe(topic)
        async with asyncio.timeout(PATIENCE_S):
            await known_at_all_nodes(everybody, client, last)
            for topic in sorted(ALL):
                await client.publish(topic, user.encode())
            await client.publish(last, user.encode())
            async for message in everybody.messages:
                if message.payload == ASKING:
                    continue
                assert message.payload == user.encode()
                if message.topic.value == last:
                    break
                heard.add(message.topic.value)
    assert heard == MAY_PUBLISH[user]


@pytest.mark.parametrize(("who", "topic"), [*RECEIVED.items(), *REFUSED.items()])
async def test_each_user_receives_what_is_theirs_and_nothing_else(
    users: Users, who: tuple[str, str], topic: str
):
    user, wanted = who
    last = "mocap/lab/bridge/last" if user != "ward" else "mocap/ward/bridge/last"
    heard = []
    async with (
        connected(users.settings(user)) as client,
        connected(users.settings(EVERYBODY)) as everybody,
    ):
        await client.subscribe(wanted)
        await client.subscribe(last)
        await everybody.publish(topic, b"{}")
        await everybody.publish(last, b"{}")
        async with asyncio.timeout(PATIENCE_S):
            async for message in client.messages:
                if message.topic.value == last:
                    break
                heard.append(message.topic.value)
    assert heard == ([topic] if who in RECEIVED else [])


async def test_a_wrong_password_and_a_stranger_are_refused(users: Users, tmp_path: Path):
    wrong = tmp_path / "wrong"
    wrong.write_text("guessed")
    known = users.settings("overview")
    for changes in (
        {"password_file": wrong},
        {"username": "nobody", "password_file": wrong},
        {"username": None, "password_file": None},
    ):
        with pytest.raises(aiomqtt.MqttError):
            async with connected(known.model_copy(update=changes)):
                pass
