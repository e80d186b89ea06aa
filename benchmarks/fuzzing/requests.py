"""Checks of what comes from the broker: whoever can publish there may send anything."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Mapping
from typing import Any

import aiomqtt
import orjson
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties
from pydantic import BaseModel, ValidationError

from gateway.body.rig import load_rig
from gateway.contract.messages import BridgeInfo
from gateway.contract.request_messages import ResponseMessage
from gateway.contract.requests import CALIBRATION_REQUESTS, MODULE_REQUESTS, RESET_REQUESTS
from gateway.errors import GatewayError
from gateway.outputs.mqtt import MqttOutput
from gateway.outputs.requests import RequestResponder
from gateway.outputs.settings import MqttSettings
from gateway.outputs.subscriber import PoseSubscriber
from gateway.recording.control import RecordingControl
from gateway.service.own_requests import OwnRequests
from gateway.settings import GatewaySettings, RecordingSettings
from gateway.sources.link_settings import LinkSettings

_GATEWAY = "fuzzed"
_KEPT = {"bridge/state", "bridge/info", "body"}
_TOPICS = ("pose", "bridge/state", "bridge/info", "bridge/health", "body", "anything")
_NOWHERE = "/proc/no-folder-can-be-here"


class _Client:
    """Takes answers, as the broker would."""

    def __init__(self) -> None:
        self.answers: list[tuple[str, bytes]] = []

    async def publish(self, topic: str, payload: bytes, **_: Any) -> None:
        self.answers.append((topic, payload))


class _Gateway:
    """Everything that answers requests, without a suit and without a broker."""

    def __init__(self) -> None:
        settings = GatewaySettings(
            gateway=_GATEWAY,
            links=[LinkSettings(name="suit", url="tcp://127.0.0.1:1")],
            rig="arm_4",
            recording=RecordingSettings(folder=_NOWHERE),
        )
        suit = load_rig(settings.rig)
        info = BridgeInfo(
            version="0", gateway=_GATEWAY, reconstructor="independent", frame_rate=100.0, modules=()
        )
        families = {
            "gateway": OwnRequests(MqttOutput(MqttSettings(), suit.skeleton, info)).perform,
            "recording": RecordingControl(settings, suit, {}, dict, dict).perform,
            "modules": _validating(MODULE_REQUESTS),
            "calibration": _validating(CALIBRATION_REQUESTS),
            "reset": _validating(RESET_REQUESTS),
        }
        self.client = _Client()
        self.responder = RequestResponder(MqttSettings(), _GATEWAY, families)
        self.responder._line.client = self.client  # type: ignore[assignment]
        self.responder._line._connected.set()


def _validating(requests: Mapping[str, type[BaseModel]]) -> Any:
    """A family that goes as far as reading what it is asked: what it then does needs a suit."""

    async def perform(verb: str, data: Mapping[str, Any]) -> dict[str, Any]:
        if verb not in requests:
            raise GatewayError(f"there is no request '{verb}'")
        try:
            return {"read": requests[verb].model_validate(data).model_dump(mode="json")}
        except ValidationError as error:
            raise GatewayError(error.errors()[0]["msg"]) from error

    return perform


_runner = asyncio.Runner()
_gateway: list[_Gateway] = []


def requests(data: bytes) -> None:
    """First line: the verb; second: where the answer is wanted, if anywhere; the rest: the payload.

    Whatever is asked, it is answered once, in JSON, and never below the topics of poses.
    """
    verb, _, rest = data.partition(b"\n")
    wanted, _, payload = rest.partition(b"\n")
    if not _gateway:
        _gateway.append(_runner.run(_made()))
    gateway = _gateway[0]
    gateway.client.answers.clear()
    _runner.run(_ask(gateway, verb.decode(errors="replace"), wanted.decode(errors="replace"), payload))
    assert len(gateway.client.answers) == 1, gateway.client.answers
    topic, answer = gateway.client.answers[0]
    assert topic.startswith(f"mocap/{_GATEWAY}/bridge/response/") or not topic.startswith("mocap/"), topic
    response = ResponseMessage.model_validate(orjson.loads(answer))
    assert "should not have happened" not in (response.error or ""), response.error


async def _made() -> _Gateway:
    return _Gateway()


async def _ask(gateway: _Gateway, verb: str, wanted: str, payload: bytes) -> None:
    properties = None
    if wanted:
        properties = Properties(PacketTypes.PUBLISH)
        with contextlib.suppress(Exception):  # the broker would not let it pass either
            properties.ResponseTopic = wanted
    topic = f"mocap/{_GATEWAY}/bridge/request/{verb.translate(dict.fromkeys(map(ord, '+#'), 'x')) or 'none'}"
    message = aiomqtt.Message(topic, payload, 1, False, 0, properties)
    await gateway.responder._take(message)
    for _ in range(1000):
        if gateway.client.answers:
            break
        await asyncio.sleep(0)
    await gateway.responder.stop()


def published(data: bytes) -> None:
    """First byte: which topic. The rest is a message, taken or counted as undecodable, and nothing else."""
    subscriber = PoseSubscriber(MqttSettings())
    topic = _TOPICS[data[0] % len(_TOPICS)] if data else "pose"
    message = aiomqtt.Message(f"mocap/g/{topic}", data[1:], 0, False, 0, None)
    subscriber._read(message)
    kept = [subscriber.states, subscriber.infos, subscriber.healths, subscriber.bodies]
    taken = sum(map(len, kept)) + len(subscriber._backlog)
    # An empty message takes what is kept off the broker.
    is_counted = topic != "anything" and not (data[1:] == b"" and topic in _KEPT)
    assert taken + subscriber.undecodable == is_counted, (topic, data[1:])
