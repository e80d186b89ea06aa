"""The MQTT contract as a page to read."""

from __future__ import annotations

import typing
from collections.abc import Callable, Iterable, Mapping

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from gateway.contract.messages import Publication
from gateway.contract.properties import JSON, MSGPACK

_HEAD = """# MQTT reference

Written by `python -m gateway.contract.documents docs/mqtt`, never by hand. For programs:
[asyncapi.yaml](asyncapi.yaml) (AsyncAPI 3) and one JSON Schema a message in [schemas/](schemas).

All topics lie below `<base_topic>/<gateway>/`, `mocap/gateway1/` unless configured otherwise. Payloads are
JSON, but for topics that end in `/msgpack`. With `protocol: "5"` every message names its content type, and
poses expire (`pose_expiry_s`) instead of waiting for a client that is away. `pose/msgpack`, `segment/<name>`,
`pose/predicted` and `robot/joint_states` are there where the configuration asks for them (`pose_formats`,
`segment_rate`, `predict_ms`, `outputs.retarget`). Instants (`…_ns`) are nanoseconds of
gateway time, which never steps; `utc` in `bridge/info` and `bridge/health` says what to add to get UTC.

`bridge/state` is the gateway's birth and will. What `module/<id>/availability` says holds while
`bridge/state` is `online`: a gateway that died cannot say that its modules are out of reach.
"""
_REQUESTS = """## Requests

Publish to `bridge/request/<verb>`; the answer comes on `bridge/response/<verb>`, or where MQTT 5's response
topic says. A request is a JSON object with the fields below, or nothing at all; `transaction` (number or
text) comes back in the answer. Errors come as
`{"status": "error", "error": "what was found and what would do"}`,
also for verbs that there are not. Retained requests are not carried out. Answers come as they are ready:
what only waits, such as `modules/list`, holds up nothing else; what changes something is done in order.
"""
_ENCODINGS = {JSON: "JSON", MSGPACK: "MessagePack"}
_JSON = {"JsonValue": "any JSON"}
_WORDS = {int: "integer", float: "number", str: "text", bool: "true or false", type(None): "null"}


def reference_page(
    publications: Iterable[Publication],
    requests: Mapping[str, type[BaseModel]],
    schema_name: Callable[[str], str],
) -> str:
    """Return the page, as markdown. schema_name: of a request's schema, by its verb."""
    parts = [_HEAD, _topics(publications)]
    shown: list[type[BaseModel]] = []
    parts.extend(
        f"## `{_shown(publication.topic)}`\n\n{_section(publication, shown)}" for publication in publications
    )
    parts.append(_REQUESTS)
    for verb, model in requests.items():
        link = f"[schema](schemas/{schema_name(verb)}.json)"
        text = f"### `{verb}`\n\n{_sentence(model)} {link}\n"
        parts.append(text + (f"\n{_fields(model)}" if model.model_fields else ""))
    return "\n".join(parts)


def _topics(publications: Iterable[Publication]) -> str:
    rows = ["| topic | QoS | retained | encoding | message |", "| --- | ---: | --- | --- | --- |"]
    for each in publications:
        topic, model = _shown(each.topic), each.model
        retained = "yes" if each.retain else "no"
        link = f"[{model.__name__}](schemas/{model.__name__}.json)"
        encoding = _ENCODINGS[each.content_type]
        rows.append(f"| `{topic}` | {each.qos} | {retained} | {encoding} | {link}: {_sentence(model)} |")
    return "\n".join(rows) + "\n"


def _shown(topic: str) -> str:
    return topic.replace("{", "<").replace("}", ">")


def _section(publication: Publication, shown: list[type[BaseModel]]) -> str:
    if publication.content_type == JSON:
        return _model(publication.model, shown)
    return f"The fields of `{publication.model.__name__}`, as {_ENCODINGS[publication.content_type]}.\n"


def _model(model: type[BaseModel], shown: list[type[BaseModel]]) -> str:
    """Return fields of a model, and of those inside it that were not shown yet."""
    text = f"{_sentence(model)}\n\n{_fields(model)}"
    for inner in _models_within(model):
        if inner not in shown:
            shown.append(inner)
            text += f"\n`{inner.__name__}`: {_model(inner, shown)}"
    return text


def _fields(model: type[BaseModel]) -> str:
    rows = ["| field | type | meaning |", "| --- | --- | --- |"]
    for name, field in model.model_fields.items():
        meaning = field.description or ""
        if not field.is_required() and field.default not in (None, ()) and field.default_factory is None:
            meaning += f" Default: `{field.default}`."
        rows.append(f"| `{name}` | {_type(field)} | {_cell(meaning)} |")
    return "\n".join(rows) + "\n"


def _type(field: FieldInfo) -> str:
    return _cell(_named(field.annotation))


def _named(annotation: object) -> str:
    """Return an annotation in the words of JSON."""
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if isinstance(annotation, type) and annotation in _WORDS:
        return _WORDS[annotation]
    if origin is typing.Annotated:
        return _named(arguments[0])
    if origin is typing.Literal:
        return " or ".join(f'"{value}"' for value in arguments)
    names = list(dict.fromkeys(_named(each) for each in arguments if each is not Ellipsis))
    # The keys of JSON's objects are always text: only what the values are is of interest.
    if origin is dict:
        return f"object of ({names[-1]})" if " or " in names[-1] else f"object of {names[-1]}"
    if origin in (tuple, list):
        return f"array of {' or '.join(names)}"
    return " or ".join(names) if names else _JSON.get(str(annotation), getattr(annotation, "__name__", "any"))


def _models_within(model: type[BaseModel]) -> list[type[BaseModel]]:
    found: list[type[BaseModel]] = []

    def search(annotation: object) -> None:
        if isinstance(annotation, type) and issubclass(annotation, BaseModel):
            found.append(annotation)
        for argument in typing.get_args(annotation):
            search(argument)

    for field in model.model_fields.values():
        search(field.annotation)
    return list(dict.fromkeys(found))


def _sentence(model: type[BaseModel]) -> str:
    return " ".join((model.__doc__ or "").replace("``", "`").split())


def _cell(text: str) -> str:
    return text.replace("|", "\\|")
