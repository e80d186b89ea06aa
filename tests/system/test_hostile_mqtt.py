"""Whoever may publish requests may publish anything: the responder on a real broker, under fire."""

from __future__ import annotations

import asyncio
import contextlib

import aiomqtt
import orjson
import psutil
import pytest
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties

from gateway.contract.request_messages import LARGEST_REQUEST
from gateway.outputs.connection import LARGEST_MESSAGE
from gateway.outputs.requests import MOST_AT_ONCE, RequestResponder
from gateway.outputs.settings import MqttSettings

pytestmark = pytest.mark.system

REQUEST = "mocap/lab/bridge/request/echo/"
RESPONSES = "mocap/lab/bridge/response/#"
PATIENCE_S = 30


@pytest.fixture(params=["3.1.1", "5"])
def protocol(request):
    return request.param


@contextlib.asynccontextmanager
async def under_fire(mosquitto, protocol, before=()):
    """(responder, what it was asked to do, a client, its responses); ``before``: published earlier."""
    mosquitto.is_for_gateways_only = False
    version = aiomqtt.ProtocolVersion.V5 if protocol == "5" else aiomqtt.ProtocolVersion.V311
    done = []

    async def perform(verb, data):
        done.append((verb, data))
        await asyncio.sleep(data.get("seconds", 0))
        return {"echo": data}

    async with aiomqtt.Client("127.0.0.1", mosquitto.port, protocol=version) as client:
        for topic, payload in before:
            await client.publish(topic, payload, qos=1, retain=True)
        settings = MqttSettings(port=mosquitto.port, protocol=protocol)
        responder = RequestResponder(settings, "lab", {"echo": perform})
        responder.start(mosquitto.port)
        await client.subscribe(RESPONSES, qos=1)
        answers = []

        async def listen():
            async for message in client.messages:
                answers.append((message.topic.value, orjson.loads(message.payload)))  # noqa: PERF401 - for ever

        listening = asyncio.create_task(listen())
        async with asyncio.timeout(PATIENCE_S):
            while not responder.is_connected:
                await asyncio.sleep(0.01)
        try:
            yield responder, done, client, answers
        finally:
            listening.cancel()
            await responder.stop()


async def answered(client, answers, transaction):
    """The answer to an honest request: asked again, as clients do, until it comes."""
    async with asyncio.timeout(PATIENCE_S):
        while True:
            await client.publish(REQUEST + "honest", orjson.dumps({"transaction": transaction}), qos=1)
            for _ in range(20):
                await asyncio.sleep(0.02)
                for _, answer in answers:
                    if answer["transaction"] == transaction and not is_crowded_out(answer):
                        return answer


def is_crowded_out(answer):
    """Whether a request was refused for those that wait already: to be asked again."""
    return answer["status"] == "error" and "too many requests are waiting" in answer["error"]


GARBAGE = {
    "bytes": bytes(range(256)),
    "a list": b"[1, 2]",
    "a text": b'"start"',
    "half an object": b'{"a": ',
    "not UTF-8": b'{"a": "\xff"}',
    "not a number": b'{"a": NaN}',
    "nested deeply": b'{"a": ' + b"[" * 20_000 + b"]" * 20_000 + b"}",
    "a transaction that is a list": b'{"transaction": [1]}',
    "a transaction without end": b'{"transaction": "' + b"x" * 65 + b'"}',
    "more than is read": b"x" * (LARGEST_REQUEST + 1),
}


async def test_garbage_is_answered_and_never_carried_out(mosquitto, protocol):
    async with under_fire(mosquitto, protocol) as (_, done, client, answers):
        for payload in GARBAGE.values():
            await client.publish(REQUEST + "x", payload, qos=1)
        assert (await answered(client, answers, 1))["status"] == "ok"
        assert {verb for verb, _ in done} == {"honest"}
        refused = [answer for topic, answer in answers if topic.endswith("/x")]
    assert len(refused) == len(GARBAGE)
    assert {answer["status"] for answer in refused} == {"error"}
    assert max(len(answer["error"]) for answer in refused) < 200


async def test_retained_requests_are_not_carried_out_at_a_start(mosquitto, protocol):
    before = [(REQUEST + "start", b'{"transaction": 7}'), (REQUEST + "garbage", b"\xff" * 1000)]
    async with under_fire(mosquitto, protocol, before) as (_, done, client, answers):
        await answered(client, answers, 1)
        assert {verb for verb, _ in done} == {"honest"}
        assert {answer["transaction"] for _, answer in answers} == {1}


async def test_a_huge_message_costs_neither_memory_nor_the_answers_after_it(mosquitto, protocol):
    async with under_fire(mosquitto, protocol) as (_, done, client, answers):
        await answered(client, answers, 1)
        before = psutil.Process().memory_info().rss
        payload = b"x" * (64 << 20)
        for _ in range(2):
            await client.publish(REQUEST + "huge", payload, qos=1, timeout=PATIENCE_S)
        await client.publish(REQUEST + "large", b"x" * (LARGEST_MESSAGE - 200), qos=1)
        del payload
        assert (await answered(client, answers, 2))["status"] == "ok"
        assert psutil.Process().memory_info().rss - before < 200 << 20  # the sender's own copies are in it
        assert {verb for verb, _ in done} == {"honest"}


async def test_a_flood_is_bounded_counted_and_over_when_it_is_over(mosquitto, protocol, caplog):
    async with under_fire(mosquitto, protocol) as (responder, done, client, answers):
        n = 3000
        for k in range(n):
            await client.publish(REQUEST + "flood", b'{"transaction": %d}' % (1000 + k), qos=0)
        assert (await answered(client, answers, 1))["status"] == "ok"
        told = [answer for topic, answer in answers if topic.endswith("/flood")]
        assert responder.dropped > 0
        assert responder.statistics()["dropped"] == responder.dropped
        assert len(told) + responder.dropped <= n + 200  # honest ones that were asked again are among them
        assert len(told) <= MOST_AT_ONCE + 100 * PATIENCE_S
        for answer in told:
            assert answer["status"] == "ok" or is_crowded_out(answer)
        assert len(done) <= len(told) + 50
    assert sum("requests come faster than" in record.message for record in caplog.records) <= 4


async def test_more_than_are_taken_at_once_are_answered_all_the_same(mosquitto, protocol):
    n = MOST_AT_ONCE + 150
    async with under_fire(mosquitto, protocol) as (_, _done, client, answers):
        for k in range(n):
            await client.publish(REQUEST + "many", b'{"transaction": %d}' % k, qos=1)
        async with asyncio.timeout(PATIENCE_S):
            while len(answers) < n:
                await asyncio.sleep(0.05)
    assert {answer["transaction"] for _, answer in answers} == set(range(n))


async def test_an_answer_that_meets_a_lost_connection_goes_out_over_the_next(mosquitto):
    async with under_fire(mosquitto, "3.1.1") as (responder, _done, client, answers):
        await client.publish(REQUEST + "slow", b'{"transaction": 1, "seconds": 0.2}', qos=1)
        await asyncio.sleep(0.1)
        first = responder._line.client
        first._disconnected.set_exception(aiomqtt.MqttError("lost"))
        async with asyncio.timeout(PATIENCE_S):
            while not answers:
                await asyncio.sleep(0.01)
    assert answers[0][1]["transaction"] == 1
    assert responder._line.client is not first


async def test_two_requests_of_one_number_are_two_requests(mosquitto, protocol):
    async with under_fire(mosquitto, protocol) as (_, _done, client, answers):
        for value in (1, 2):
            await client.publish(REQUEST + "same", orjson.dumps({"transaction": 5, "value": value}), qos=1)
        await answered(client, answers, 1)
        same = [answer for topic, answer in answers if topic.endswith("/same")]
        assert [answer["data"]["echo"]["value"] for answer in same] == [1, 2]
        assert {answer["transaction"] for answer in same} == {5}


WANTED = {
    "mocap/lab/pose": False,
    "mocap/other/bridge/request/recording/start": False,
    "homeassistant/sensor/x/config": False,
    "$SYS/broker": False,
    "x" * 300: False,
    "mocap/lab/bridge/response/elsewhere": True,
    "my/answers": True,
    "mysterious/answers": False,
    "zigbee2mqtt/lamp/set": False,
}


@pytest.mark.parametrize("wanted", WANTED, ids=lambda topic: topic[:20])
async def test_an_answer_goes_only_where_it_harms_nobody(mosquitto, wanted):
    async with under_fire(mosquitto, "5") as (responder, _, client, answers):
        allowed = {"response_topics": ("my", "my/answers/deeper")}
        responder._settings = responder._settings.model_copy(update=allowed)
        properties = Properties(PacketTypes.PUBLISH)
        properties.ResponseTopic = wanted
        properties.ContentType = "image/png"
        properties.CorrelationData = b"c" * 5000
        if not wanted.startswith(("$", "mocap/lab/bridge/response")):
            await client.subscribe(wanted, qos=1)
        await client.publish(REQUEST + "x", b'{"transaction": 9}', qos=1, properties=properties)
        await answered(client, answers, 1)
        (topic,) = [topic for topic, answer in answers if answer["transaction"] == 9]
    assert topic == (wanted if WANTED[wanted] else "mocap/lab/bridge/response/echo/x")


async def test_what_was_taken_just_before_the_end_is_answered(mosquitto):
    """A task that is cancelled before its first step runs nothing of what it was to do."""
    async with under_fire(mosquitto, "3.1.1") as (responder, _, _, answers):
        for payload in (b"{}", b"[1]"):
            message = aiomqtt.Message(REQUEST + "x", payload, 1, retain=False, mid=1, properties=None)
            await responder._take(message)
        await responder.stop()
        async with asyncio.timeout(PATIENCE_S):
            while len(answers) < 2:
                await asyncio.sleep(0.01)
    assert sorted(answer["error"][:12] for _, answer in answers) == ["a request is", "broken off, "]
