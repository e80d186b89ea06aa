"""Reads along on a broker, and holds every message against the contract."""

from __future__ import annotations

import re
import threading
from collections import Counter

import jsonschema
import orjson
import ormsgpack
import paho.mqtt.client as paho

from gateway.contract import topics
from gateway.contract.documents import json_schemas
from gateway.contract.messages import PUBLICATIONS, Message, Publication
from gateway.contract.properties import JSON, MSGPACK
from gateway.contract.request_messages import ResponseMessage
from tests.patience import PATIENCE_S

_BARRIER = "contract-watch/barrier"
_BY_SCHEMA = 3
"""So many messages of each topic are validated by JSON Schema too, which is slower than the models."""


def topic_pattern(publication: Publication) -> re.Pattern[str]:
    """Return what the topics of a publication look like below ``<base_topic>/<gateway>/``."""
    literal = re.escape(publication.topic).replace(r"\{id\}", r"\d+").replace(r"\{name\}", "[^/]+")
    return re.compile(f"^{literal}$")


_PATTERNS = [(topic_pattern(each), each.model, each.content_type) for each in PUBLICATIONS]
_VALIDATORS = {name: jsonschema.Draft202012Validator(schema) for name, schema in json_schemas().items()}


class ContractWatch:
    """A client of its own, in a thread of its own, from the start of a test to its end."""

    def __init__(self, host: str, port: int) -> None:
        self.messages: Counter[str] = Counter()
        """How many were held against the contract, by model."""
        self.problems: list[str] = []
        self._seen: Counter[str] = Counter()
        self._came_back = threading.Event()
        self._client = paho.Client(paho.CallbackAPIVersion.VERSION2)
        self._client.reconnect_delay_set(0.05, 0.05)  # its end waits for the end of a delay
        self._client.on_connect = lambda client, *_: client.subscribe([("mocap/#", 0), (_BARRIER, 0)])
        self._client.on_message = lambda _client, _data, message: self.take(message.topic, message.payload)
        self._client.message_callback_add(_BARRIER, lambda *_: self._came_back.set())
        self._client.connect_async(host, port)
        self._client.loop_start()

    def settle(self) -> None:
        """Return once all that the broker has relayed so far is held against the contract.

        A message of this client's own comes back behind all those. Without a connection there is nothing to
        wait for.
        """
        if self._client.is_connected():
            self._client.publish(_BARRIER, b"")
            assert self._came_back.wait(PATIENCE_S), f"the broker did not relay {_BARRIER}"

    def stop(self) -> None:
        """End."""
        self._client.disconnect()
        self._client.loop_stop()

    def take(self, topic: str, payload: bytes) -> None:
        """Hold one message against the contract."""
        _, _, below = topic.partition("/")[2].partition("/")
        if not payload or below.startswith(f"{topics.BRIDGE_REQUEST}/"):
            return  # a retained message taken away; what tests ask for, right or wrong
        found = _publication_of(below)
        if found is None:
            self.problems.append(f"{topic}: not in the contract")
            return
        model, content_type = found
        self.messages[model.__name__] += 1
        self._seen[topic] += 1
        try:
            if content_type == MSGPACK:
                payload = orjson.dumps(ormsgpack.unpackb(payload))
            model.model_validate_json(payload)
            if self._seen[topic] <= _BY_SCHEMA:
                _VALIDATORS[model.__name__].validate(orjson.loads(payload))
        except (ValueError, TypeError, jsonschema.ValidationError) as error:  # of decoders and models
            self.problems.append(f"{topic}: {error}")


def _publication_of(below: str) -> tuple[type[Message], str] | None:
    """What is published on a topic, and how it is encoded."""
    if below.startswith(f"{topics.BRIDGE_RESPONSE}/"):
        return ResponseMessage, JSON
    return next((found for pattern, *found in _PATTERNS if pattern.match(below)), None)  # type: ignore[return-value]


def assert_kept(watch: ContractWatch) -> None:
    """Fails the test on whose broker there was what the contract does not have."""
    assert not watch.problems, "\n".join(watch.problems[:5])
