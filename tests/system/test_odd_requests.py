"""Odd payloads on every request topic of the contract: each is answered, in words that help."""

from __future__ import annotations

import asyncio
import contextlib
import re
from collections.abc import AsyncIterator, Iterator
from typing import Any

import aiomqtt
import orjson
import pytest

from gateway.contract.request_messages import LARGEST_REQUEST
from gateway.contract.requests import REQUEST_FAMILIES, Request
from tests.patience import PATIENCE_S
from tests.suit_service import GATEWAY, started

pytestmark = pytest.mark.system

NO_REQUESTS = {
    "no JSON": b"start",
    "a list": b"[1]",
    "NaN": b'{"seconds": NaN}',
    "a transaction of half a number": b'{"transaction": 1.5}',
    "half a character": b'{"device": "\\ud800"}',
    "too large": b" " * (LARGEST_REQUEST + 1),
}
ODD_VALUES: tuple[Any, ...] = (None, True, -1, 2**63, 1e308, "", "\0", "x" * 5000, [], {"": 0}, ["x"])
USUAL: dict[str, Any] = {
    "device": "0",
    "step": "n_pose",
    "file": 0,
    "offset": 0,
    "length": 1,
    "seconds": 0.5,
    "listen_s": 0.5,
    "countdown_s": 0,
}
"""What stands in the other fields, so that the odd one is what is looked at."""
OF_PYTHON = re.compile(
    r"Value error|Input should|Extra inputs|Field required|should not have happened|String should"
    r"|Unable to|pattern|\bdict\b|Traceback",
    re.IGNORECASE,
)
"""What no answer is to say."""


def odd_requests(model: type[Request]) -> Iterator[dict[str, Any]]:
    """Yield data with something missing, something unknown, or an odd value in one place."""
    yield {}
    yield {"colour": "red"}
    for name in model.model_fields:
        for value in ODD_VALUES:
            yield {other: USUAL[other] for other in model.model_fields if other in USUAL} | {name: value}


class Asker:
    """Asks, and waits for the answer on the topic of the request's own."""

    def __init__(self, client: aiomqtt.Client) -> None:
        self._client = client
        self._waiting: dict[str, asyncio.Future[dict[str, Any]]] = {}

    async def listen(self) -> None:
        async for message in self._client.messages:
            waiting = self._waiting.get(message.topic.value.removeprefix(f"mocap/{GATEWAY}/bridge/response/"))
            if waiting is not None and not waiting.done():
                waiting.set_result(orjson.loads(message.payload))

    async def ask(self, verb: str, payload: bytes, topic: str | None = None) -> dict[str, Any]:
        """Return the answer. Raises ``TimeoutError`` where none comes. topic: another one than the verb's."""
        self._waiting[verb] = asyncio.get_running_loop().create_future()
        topic = topic or f"mocap/{GATEWAY}/bridge/request/{verb}"
        await self._client.publish(topic, payload, qos=1)
        return await asyncio.wait_for(self._waiting[verb], PATIENCE_S)


@contextlib.asynccontextmanager
async def asking(port: int) -> AsyncIterator[Asker]:
    async with aiomqtt.Client("127.0.0.1", port) as client:
        await client.subscribe(f"mocap/{GATEWAY}/bridge/response/#", qos=1)
        asker = Asker(client)
        listening = asyncio.create_task(asker.listen())
        try:
            yield asker
        finally:
            listening.cancel()


async def complaints(family: str, port: int) -> list[str]:
    """Ask everything odd of a family; return what was answered badly, or not at all."""
    found = []
    async with asking(port) as asker:
        for verb, model in REQUEST_FAMILIES[family].items():
            payloads = [
                *NO_REQUESTS.values(),
                *(orjson.dumps({"transaction": 7} | d) for d in odd_requests(model)),
            ]
            for payload in payloads:
                what = f"{family}/{verb} {payload[:100]!r}"
                try:
                    answer = await asker.ask(f"{family}/{verb}", payload)
                except TimeoutError:
                    found.append(f"{what}: no answer")
                    continue
                error = answer["error"]
                is_read = payload not in NO_REQUESTS.values()
                if answer["transaction"] != (7 if is_read else None):
                    found.append(f"{what}: transaction {answer['transaction']}")
                if answer["status"] == "error" and (not error or OF_PYTHON.search(error) or len(error) > 600):
                    found.append(f"{what}: {error}")
    return found


@pytest.fixture
def gateway_under_test(command, mosquitto, tmp_path, monkeypatch):
    """``await gateway_under_test()``: a gateway that reads a suit, and lets requests do everything."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    mosquitto.is_for_gateways_only = False

    async def start():
        gateway = await started(
            command, tmp_path, mosquitto.port, "robot_arm_4",
            allow_device_writes=True, allow_configuration=["assembly", "recording"],
            recording={"folder": str(tmp_path / "recordings")},
        )  # fmt: skip
        await gateway.until_it_says("connected to the MQTT broker")
        async with asking(mosquitto.port) as asker:
            while (await asker.ask("modules/list", b""))["status"] != "ok":
                await asyncio.sleep(0.1)
        return gateway

    return start


async def test_every_odd_request_is_answered_in_plain_words(gateway_under_test, mosquitto):
    await gateway_under_test()
    found = await asyncio.gather(*(complaints(family, mosquitto.port) for family in REQUEST_FAMILIES))
    assert [complaint for each in found for complaint in each] == []


async def test_a_topic_that_is_no_request_is_answered_too(gateway_under_test, mosquitto):
    await gateway_under_test()
    async with asking(mosquitto.port) as asker:
        for verb in ("", "x", "/", "modules", "modules/", "modules//list", "modules/list/x", "v" * 70):
            assert "there is no request" in (await asker.ask(verb, b""))["error"]
        topic = f"mocap/{GATEWAY}/bridge/request"
        assert "there is no request" in (await asker.ask("", b"", topic))["error"]


async def test_a_configuration_taken_into_use_leaves_no_request_without_an_answer(
    gateway_under_test, mosquitto
):
    """Neither those under way, nor those that come while one service takes over from the other."""
    gateway = await gateway_under_test()
    async with asking(mosquitto.port) as asker, asking(mosquitto.port) as waiting:
        long = asyncio.create_task(waiting.ask("modules/list", b'{"listen_s": 30}'))
        assert (await asker.ask("gateway/reload", b""))["status"] == "ok"
        taking_over = asyncio.create_task(gateway.until_it_says("configuration read anew"))
        while not taking_over.done():
            assert (await asker.ask("recording/status", b""))["status"] in ("ok", "error")
        assert (await asker.ask("gateway/info", b""))["status"] == "ok"
        assert "broken off" in (await long)["error"]
