"""The MQTT contract as documents, from the one place it is declared: JSON Schemas and AsyncAPI 3.

``PUBLICATIONS`` (``messages``) and the request models are the source; ``python -m gateway.contract.documents
docs/mqtt`` writes all of it, and a test holds the files equal to what would be written.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

import orjson
import yaml
from pydantic import BaseModel
from pydantic.json_schema import GenerateJsonSchema, JsonSchemaMode, models_json_schema

from gateway.contract import topics
from gateway.contract.messages import PUBLICATIONS, Message
from gateway.contract.properties import JSON
from gateway.contract.reference_page import reference_page
from gateway.contract.request_messages import LONGEST_TRANSACTION, ResponseMessage
from gateway.contract.requests import REQUEST_FAMILIES

Schema = dict[str, Any]

VERSION = "1.1.0"
"""Of the contract: the first number changes when an app must be changed."""

_ROOT = "{base_topic}/{gateway}"
_PARAMETERS: dict[str, Schema] = {
    "base_topic": {"default": "mocap", "description": "Setting mqtt.base_topic."},
    "gateway": {"default": "gateway1", "description": "Setting gateway: the name of one gateway."},
    "name": {"description": "Segment name, as in body."},
    "id": {"description": "Module number on the wire; 254 is the relay."},
}
_TRANSACTION: Schema = {
    "description": "Comes back in the response.",
    "anyOf": [
        {"type": "string", "maxLength": LONGEST_TRANSACTION},
        {"type": "integer"},
        {"type": "null"},
    ],
}
_DRAFT_7 = "application/schema+json;version=draft-07"


def request_models() -> dict[str, type[BaseModel]]:
    """Return the data of every request, by ``<family>/<verb>``."""
    return {
        f"{family}/{verb}": model
        for family, models in REQUEST_FAMILIES.items()
        for verb, model in models.items()
    }


def published_models() -> list[type[Message]]:
    """Return every model that a gateway publishes, each once."""
    models = [publication.model for publication in PUBLICATIONS]
    return list(dict.fromkeys([*models, ResponseMessage]))


def json_schemas() -> dict[str, Schema]:
    """Return JSON Schemas (draft 2020-12) that stand alone, by name: one a message, one a request."""
    schemas = {model.__name__: model.model_json_schema(mode="serialization") for model in published_models()}
    for verb, model in request_models().items():
        schemas[_request_name(verb)] = _with_transaction(model.model_json_schema())
    dialect = {"$schema": GenerateJsonSchema.schema_dialect}
    return {name: dialect | schema for name, schema in schemas.items()}


def asyncapi() -> Schema:
    """Return the AsyncAPI 3.0 document: what a gateway sends, and what it answers."""
    channels: Schema = {}
    operations: Schema = {}
    messages: Schema = {model.__name__: _message(model.__name__) for model in published_models()}
    for publication in PUBLICATIONS:
        key, name = _key(publication.topic), publication.model.__name__
        # One topic may carry the same model in two encodings, which are two messages.
        if publication.content_type != JSON:
            name = f"{name}_{publication.content_type.rpartition('/')[2]}"
            messages[name] = _message(publication.model.__name__) | {
                "name": name,
                "contentType": publication.content_type,
            }
        channels[key] = _channel(publication.topic, name)
        operations[f"publish_{key}"] = _operation("send", key, name, publication.qos, publication.retain)

    for verb in request_models():
        key, name = _key(verb), _request_name(verb)
        messages[name] = _message(name)
        channels[f"request_{key}"] = _channel(f"{topics.BRIDGE_REQUEST}/{verb}", name)
        channels[f"response_{key}"] = _channel(f"{topics.BRIDGE_RESPONSE}/{verb}", ResponseMessage.__name__)
        operations[f"answer_{key}"] = _operation("receive", f"request_{key}", name, 1, False) | {
            "reply": {"channel": {"$ref": f"#/channels/response_{key}"}}
        }
    return {
        "asyncapi": "3.0.0",
        "info": {
            "title": "mocap-gateway",
            "version": VERSION,
            "description": "Poses of a person in an inertial suit, and how their gateway fares.",
            "license": {"name": "Apache-2.0"},
        },
        "defaultContentType": "application/json",
        "servers": {"broker": {"host": "127.0.0.1:1883", "protocol": "mqtt"}},
        "channels": channels,
        "operations": operations,
        "components": {"messages": messages, "schemas": _shared_schemas()},
    }


def files() -> dict[str, bytes]:
    """Return the documents by path below their folder."""
    options = orjson.OPT_INDENT_2 | orjson.OPT_APPEND_NEWLINE
    written = {
        f"schemas/{name}.json": orjson.dumps(schema, option=options)
        for name, schema in json_schemas().items()
    }
    head = "# Written by `python -m gateway.contract.documents docs/mqtt`, never by hand.\n"
    document = yaml.safe_dump(asyncapi(), sort_keys=False, allow_unicode=True, width=110)
    written["asyncapi.yaml"] = (head + document).encode()
    written["README.md"] = reference_page(PUBLICATIONS, request_models(), _request_name).encode()
    return written


def _shared_schemas() -> Schema:
    """Return all models in one dictionary, each by its name, as draft 7 (which AsyncAPI tools must know)."""
    modes: list[tuple[type[BaseModel], JsonSchemaMode]] = [(m, "serialization") for m in published_models()]
    modes += [(model, "validation") for model in request_models().values()]
    _, schema = models_json_schema(modes, ref_template="#/components/schemas/{model}")
    shared: Schema = dict(schema["$defs"])
    for verb, model in request_models().items():
        shared[_request_name(verb)] = _with_transaction(shared.pop(model.__name__))
    return {name: _as_draft_7(shared[name]) for name in sorted(shared)}


def _with_transaction(schema: Schema) -> Schema:
    return schema | {"properties": {**schema.get("properties", {}), "transaction": _TRANSACTION}}


def _as_draft_7(schema: Any) -> Any:
    """Return a schema with tuples as draft 7 has them; all else that we use is the same in both."""
    if isinstance(schema, list):
        return [_as_draft_7(item) for item in schema]
    if not isinstance(schema, dict):
        return schema
    renamed = {"items" if key == "prefixItems" else key: value for key, value in schema.items()}
    return {key: _as_draft_7(value) for key, value in renamed.items()}


def _request_name(verb: str) -> str:
    """Return ``ModulesCardListRequest`` for ``modules/card_list``."""
    return "".join(word.capitalize() for word in re.split("[/_]", verb)) + "Request"


def _key(topic: str) -> str:
    return re.sub(r"/\{\w+\}", "", topic).replace("/", "_")


def _message(name: str) -> Schema:
    schema = {"$ref": f"#/components/schemas/{name}"}
    return {"name": name, "payload": {"schemaFormat": _DRAFT_7, "schema": schema}}


def _channel(topic: str, message: str) -> Schema:
    address = f"{_ROOT}/{topic}"
    return {
        "address": address,
        "parameters": {name: dict(_PARAMETERS[name]) for name in re.findall(r"\{(\w+)\}", address)},
        "messages": {message: {"$ref": f"#/components/messages/{message}"}},
    }


def _operation(action: str, channel: str, message: str, qos: int, retain: bool) -> Schema:
    return {
        "action": action,
        "channel": {"$ref": f"#/channels/{channel}"},
        "messages": [{"$ref": f"#/channels/{channel}/messages/{message}"}],
        "bindings": {"mqtt": {"qos": qos, "retain": retain, "bindingVersion": "0.2.0"}},
    }


def write(folder: Path) -> None:
    """Write the documents; schemas of messages that are gone are removed."""
    written = files()
    (folder / "schemas").mkdir(parents=True, exist_ok=True)
    for old in (folder / "schemas").glob("*.json"):
        if f"schemas/{old.name}" not in written:
            old.unlink()
    for path, content in written.items():
        (folder / path).write_bytes(content)


if __name__ == "__main__":
    write(Path(sys.argv[1] if len(sys.argv) > 1 else "docs/mqtt"))
