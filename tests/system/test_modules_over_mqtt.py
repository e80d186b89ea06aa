"""Requests about modules to a running gateway, over a real broker."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import logging

import aiomqtt
import numpy as np
import orjson
import pytest
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties

from devices.commands.device_errors import DeviceError
from firmware_protocol import RELAY
from gateway.body.rig import load_rig
from gateway.contract.request_messages import LARGEST_REQUEST, ResponseMessage
from gateway.modules.motion import MotionDetector
from gateway.modules.operations import RequestError
from gateway.modules.remote import remote_suit
from gateway.outputs.mqtt import MqttOutput
from gateway.outputs.settings import MqttSettings
from gateway.service.service import Service
from gateway.settings import GatewaySettings
from gateway.sources.link_settings import LinkSettings
from tests.patience import PATIENCE_S
from tests.running_suit import running

pytestmark = pytest.mark.system


@pytest.fixture(autouse=True)
def _state_of_its_own(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))


@pytest.fixture
def served(mosquitto, commanded_suit, monkeypatch):
    """``async with served(allow_device_writes=True) as (suit, service, settings)``: all running."""

    @contextlib.asynccontextmanager
    async def start(allow_device_writes=False, protocol="3.1.1", **suit_settings):
        mqtt = MqttSettings(port=mosquitto.port, protocol=protocol)
        settings = GatewaySettings(
            gateway="lab",
            links=[LinkSettings(name="suit", url="/dev/null")],
            rig="robot_arm_4",
            reconstructor="independent",
            mqtt=mqtt,
            allow_device_writes=allow_device_writes,
        )
        if not suit_settings.get("has_relay"):  # four modules without one answer within 10 ms, or soon after
            monkeypatch.setattr("devices.commands.transactions.BROADCAST_WAITS_S", (0.15, 0.25, 0.4))
        async with commanded_suit(**suit_settings) as suit:
            service = Service(settings, load_rig("robot_arm_4"), links=[suit.link])
            async with running(service):
                async with asyncio.timeout(PATIENCE_S):
                    while not service.requests.is_connected:
                        await asyncio.sleep(0.01)
                yield suit, service, mqtt

    return start


class App:
    """A client that asks, as any app would."""

    def __init__(self, client):
        self._client = client

    async def ask(self, verb, payload, topic_of_answer=None, properties=None):
        if not isinstance(payload, bytes):
            payload = orjson.dumps(payload)
        await self._client.publish(f"mocap/lab/bridge/request/{verb}", payload, qos=1, properties=properties)
        async with asyncio.timeout(PATIENCE_S):
            async for message in self._client.messages:
                wanted = topic_of_answer or f"mocap/lab/bridge/response/{verb}"
                if message.topic.value == wanted:
                    return ResponseMessage.model_validate_json(message.payload), message.properties
        raise AssertionError


@contextlib.asynccontextmanager
async def app(mqtt, version=aiomqtt.ProtocolVersion.V311):
    async with aiomqtt.Client(mqtt.host, mqtt.port, protocol=version) as client:
        await client.subscribe("mocap/lab/bridge/response/#", qos=1)
        await client.subscribe("answers/#", qos=1)
        yield App(client)


async def test_a_list_is_answered_with_its_transaction_while_poses_go_on(served, until, monkeypatch):
    instants_ns, offer = [], MqttOutput.offer
    monkeypatch.setattr(
        MqttOutput, "offer", lambda self, frame: (instants_ns.append(frame.time_ns), offer(self, frame))
    )
    async with served(has_relay=True) as (suit, service, mqtt), app(mqtt) as asking:
        service.load.observe = lambda *_: False  # nothing is given up on a machine that is too busy
        await until(lambda: len(instants_ns) > 50)
        first = len(instants_ns)
        response, _ = await asking.ask("modules/list", {"listen_s": 0.5, "transaction": "t-1"})
        await until(lambda: len(instants_ns) > first + 50)
    assert set(np.diff(instants_ns[first - 10 :])) == {10_000_000}  # a pose each 10 ms, with none left out
    assert (response.status, response.error, response.transaction) == ("ok", None, "t-1")
    modules = {module["module"]: module for module in response.data["modules"]}
    assert set(modules) == {0, 1, 2, 3, RELAY}
    assert modules[2]["segment"] == "link_3"
    assert modules[2]["unique_id"] == suit.unique_id(2).hex()
    assert modules[2]["rate_hz"] > 0
    assert modules[2]["firmware"] == "1.0.0"
    assert 0 < modules[2]["battery_percent"] <= 100
    assert response.data["conflicts"] == []
    assert response.data["allows_writes"] is False


REFUSED = [
    ("modules/lst", {}, "there is no request 'modules/lst' (did you mean 'list'?)"),
    ("module/list", {}, "there is no request 'module/list' (did you mean 'modules'?)"),
    ("modules", {}, "there is no request 'modules/' (known: assign, backup"),
    ("modules/identify", {}, "modules/identify: 'device' is missing"),
    ("modules/identify", {"device": "0", "secs": 3}, "unknown setting 'secs'"),
    ("modules/list", b"{not json", "a request is a JSON object"),
    ("modules/list", b"[1, 2]", "a request is a JSON object"),
    ("modules/list", b"\xff" * (LARGEST_REQUEST + 1), "at most 65536 are taken"),
    ("modules/list", {"transaction": "x" * 65}, "'transaction' is a number or a text"),
    ("modules/identify", {"device": "17"}, "no device '17' answers; there are: 0 ("),
    ("modules/set", {"device": "0", "settings": {"label": "x"}}, "'allow_device_writes: true'"),
    ("modules/assign", {"ids": {"00" * 12: 1}}, "'allow_device_writes: true'"),
    (
        "modules/assign",
        {"ids": {"3": 1}},
        "'ids.3' is '3': this is no unique id: 24 hexadecimal digits (0-9, a-f)",
    ),
    ("modules/undo", {}, "there is no change to undo"),
]


async def test_what_cannot_be_done_is_answered_with_the_reason(served):
    async with served() as (_, _, mqtt), app(mqtt) as asking:
        for verb, payload, error in REFUSED:
            response, _ = await asking.ask(verb, payload)
            assert response.status == "error", (verb, payload)
            assert error in response.error
            assert response.data == {}


async def test_settings_are_changed_and_taken_back(served):
    async with served(allow_device_writes=True) as (suit, _, mqtt), app(mqtt) as asking:
        wanted = {"device": "1", "settings": {"label": "left", "sampling_rate": 50}, "transaction": 5}
        response, _ = await asking.ask("modules/set", wanted)
        assert response.status == "ok", response.error
        assert response.transaction == 5
        assert response.data["before"] == {"label": "", "sampling_rate": 100.0}
        assert response.data["after"] == {"label": "left", "sampling_rate": 50.0}
        assert suit.traffic.device(1).settings["label"] == "left"
        taken = {"device": "1", "settings": {"module_id": 2}}
        refused, _ = await asking.ask("modules/set", taken)
        assert f"module id 2 is held by device {suit.unique_id(2).hex()}" in refused.error
        response, _ = await asking.ask("modules/undo", {})
        assert response.status == "ok", response.error
        assert suit.traffic.device(1).settings["label"] == ""
        assert suit.traffic.device(1).settings["sampling_rate"] == 100.0


async def test_mqtt5_response_topic_and_correlation_are_honoured_where_harmless(served):
    async with served(protocol="5") as (_, _, mqtt), app(mqtt, aiomqtt.ProtocolVersion.V5) as asking:
        properties = Properties(PacketTypes.PUBLISH)
        mine = "mocap/lab/bridge/response/mine"
        properties.ResponseTopic, properties.CorrelationData = mine, b"\x01\x02"
        request = {"device": "0", "seconds": 1}
        response, answered = await asking.ask("modules/identify", request, mine, properties)
        assert response.status == "ok"
        assert answered.CorrelationData == b"\x01\x02"
        # Nobody has a pose of another make published by the gateway.
        properties.ResponseTopic = "mocap/lab/pose"
        response, _ = await asking.ask("modules/identify", request, properties=properties)
        assert response.status == "ok"


async def test_a_flood_of_requests_is_answered_and_stalls_nothing(served):
    async with served() as (_, service, mqtt):
        async with aiomqtt.Client(mqtt.host, mqtt.port) as client:
            await client.subscribe("mocap/lab/bridge/response/#", qos=1)
            for number in range(30):
                request = orjson.dumps({"device": "0", "seconds": 0, "transaction": number})
                await client.publish("mocap/lab/bridge/request/modules/identify", request, qos=1)
            before = service.pipeline.skeleton_frames
            answers = {}
            async with asyncio.timeout(PATIENCE_S):
                async for message in client.messages:
                    answer = ResponseMessage.model_validate_json(message.payload)
                    answers[answer.transaction] = answer
                    if len(answers) == 30:
                        break
            assert service.pipeline.skeleton_frames > before
        refused = [answer for answer in answers.values() if answer.status == "error"]
        told = [answer.error for answer in refused if "too many requests" not in answer.error]
        assert all("answer" in error for error in told)  # of the module itself, on a busy machine
        assert len(refused) < 30


@pytest.mark.parametrize(
    ("verb", "data"), [("modules/list", {"listen_s": 30}), ("modules/motion", {"seconds": 120})]
)
async def test_a_long_request_holds_up_no_short_ones(served, monkeypatch, verb, data):
    monkeypatch.setattr(MotionDetector, "decide", lambda *_: None)  # the arm itself moves
    async with (
        served(allow_device_writes=True) as (_, service, mqtt),
        app(mqtt) as asking,
        app(mqtt) as waiting,
    ):
        long = asyncio.create_task(waiting.ask(verb, data))
        async with asyncio.timeout(PATIENCE_S):
            while not service.requests.statistics()["waiting"]:
                await asyncio.sleep(0.01)
        for short, payload in (
            ("gateway/info", {}),
            ("recording/status", {}),
            ("modules/identify", {"device": "0"}),
            ("modules/set", {"device": "1", "settings": {"label": "left"}}),
            ("modules/undo", {}),
        ):
            response, _ = await asking.ask(short, payload)
            assert response.status == "ok", response.error
        assert not long.done()
        long.cancel()


async def test_requests_that_change_modules_are_carried_out_in_order(served):
    async with served(allow_device_writes=True) as (_, _, mqtt), app(mqtt) as asking:
        wanted = [{"device": "1", "settings": {"label": str(k)}, "transaction": k} for k in range(6)]
        answers = []
        for each in wanted[:-1]:
            topic = "mocap/lab/bridge/request/modules/set"
            await asking._client.publish(topic, orjson.dumps(each), qos=1)
        answers.append((await asking.ask("modules/set", wanted[-1]))[0])
        while len(answers) < len(wanted):
            async with asyncio.timeout(PATIENCE_S):
                message = await anext(aiter(asking._client.messages))
            answers.append(ResponseMessage.model_validate_json(message.payload))
        assert [answer.transaction for answer in answers] == list(range(6))
        assert [answer.data["before"]["label"] for answer in answers] == ["", "0", "1", "2", "3", "4"]


async def test_who_is_heard_and_not_in_the_rig_is_said_once_with_what_to_do(
    served, monkeypatch, caplog, until
):
    monkeypatch.setattr("gateway.service.observability.REPORT_INTERVAL_S", 0.1)
    caplog.set_level(logging.INFO, "gateway.service.observability")
    async with served(stored_ids={2: 9}):
        await until(lambda: "heard, but not in the rig: module 9" in caplog.text)
        await until(lambda: "from 3 of the rig's 4 modules" in caplog.text)
        reports = caplog.text.count("poses/s")
        await until(lambda: caplog.text.count("poses/s") > reports + 3)
    assert caplog.text.count("not in the rig") == 1


async def test_a_retained_request_is_not_carried_out(served):
    async with served() as (_, _, mqtt), aiomqtt.Client(mqtt.host, mqtt.port) as client:
        await client.publish("mocap/lab/bridge/request/modules/identify", b"{}", qos=1, retain=True)
    answered = []
    async with served() as (_, _, mqtt), aiomqtt.Client(mqtt.host, mqtt.port) as client:
        await client.subscribe("mocap/lab/bridge/response/#", qos=1)
        await client.publish("mocap/lab/bridge/request/gateway/info", b"{}", qos=1)
        async with asyncio.timeout(PATIENCE_S):
            async for message in client.messages:
                answered.append(message.topic.value.rpartition("response/")[2])
                if answered[-1] == "gateway/info":  # what is retained has come to the gateway before it
                    break
    assert answered == ["gateway/info"]


async def test_a_gateway_that_is_not_online_is_told_at_once(served, mosquitto):
    """Not after the longest time that an answer may take."""
    async with served() as (_, _, mqtt):
        async with remote_suit(mqtt, "lab") as remote:
            assert (await remote.perform("list", {"listen_s": 0.5}))["modules"]
        with pytest.raises(
            RequestError, match=r"gateway 'labb' is not online at .*: online are lab: name one"
        ):
            async with remote_suit(mqtt, "labb"):
                pass
    with pytest.raises(RequestError, match=r"gateway 'lab' is not online at .*: none is online"):
        async with remote_suit(mqtt, "lab"):
            pass


async def test_the_gateway_of_a_broker_is_found_and_asked(served, mosquitto):
    with pytest.raises(RequestError, match="none is online"):
        async with remote_suit(MqttSettings(port=mosquitto.port)):
            pass
    async with (
        served(allow_device_writes=True, has_relay=True) as (suit, _, mqtt),
        remote_suit(mqtt) as remote,
    ):
        ids = {suit.unique_id(0).hex(): 3, suit.unique_id(3).hex(): 0}
        changes = (await remote.perform("assign", {"ids": ids}))["changes"]
        assert [change["after"]["module_id"] for change in changes] == [3, 0]
        assert suit.ids() == {0: 3, 1: 1, 2: 2, 3: 0, RELAY: RELAY}
        assert len((await remote.perform("undo", {}))["changes"]) == 2
        assert suit.ids()[0] == 0
        card = suit.traffic.device(RELAY).card
        card.begin(0)
        card.write(bytes(range(256)) * 10)
        card.end()
        wanted = {"file": 1, "offset": 100, "length": 1000}
        data = (await remote.perform("card_read", wanted))["data"]
        assert base64.b64decode(data) == (bytes(range(256)) * 10)[100:1100]
        with pytest.raises(RequestError, match=r"gateway 'lab': .*no such file"):
            await remote.perform("card_read", wanted | {"file": 2})


async def test_an_error_of_our_own_is_answered_and_logged(served, monkeypatch, caplog):
    async with served() as (_, service, mqtt), app(mqtt) as asking:

        async def breaks(verb, data):
            raise DeviceError("the module is on fire") if verb == "known" else RuntimeError("oh")

        monkeypatch.setitem(service.requests._families, "modules", breaks)
        response, _ = await asking.ask("modules/known", {})
        assert response.error == "the module is on fire"
        with caplog.at_level(logging.ERROR):
            response, _ = await asking.ask("modules/other", {})
        assert response.error.startswith("this should not have happened (RuntimeError('oh'))")
        assert "request 'modules/other' failed" in caplog.text
