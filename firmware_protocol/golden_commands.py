"""Golden vectors of every verb and every setting, and of a slot of flash."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from firmware_protocol.commands import (
    FACTORY_RESET_MAGIC,
    VERBS,
    Result,
    Verb,
    encode_arguments,
    encode_payload,
)
from firmware_protocol.device_settings import SETTINGS, decode_value, encode_value
from firmware_protocol.fields import WireField
from firmware_protocol.flash_slots import encode_slot
from firmware_protocol.framing import PROTOCOL_VERSION
from firmware_protocol.golden_forms import as_json, frame_vector
from firmware_protocol.packets import Acknowledgement, Command, wire_frame

_UNIQUE_ID = bytes(range(12))
_FILES = ((1, 1_048_576, 250_000, 0xCBF43926), (2, 16, 2**32 - 1, 0))

_EXAMPLES: Mapping[Verb, tuple[tuple[Any, ...], tuple[Any, ...]]] = {
    Verb.HELLO: ((1, 2), (1, 1, 1)),
    Verb.IDENTIFY: ((10,), ()),
    Verb.GET_INFO: ((), ()),
    Verb.START: ((), ()),
    Verb.STOP: ((), ()),
    Verb.READ_SETTING: ((1,), (1, encode_value(1, 9))),
    Verb.WRITE_SETTING: ((2, encode_value(2, 200.0)), (2, encode_value(2, 200.0))),
    Verb.COMMIT: ((), (4_294_967_295,)),
    Verb.DISCARD: ((), ()),
    Verb.FACTORY_RESET: ((FACTORY_RESET_MAGIC,), ()),
    Verb.CARD_LIST: ((0,), (2, _FILES)),
    Verb.CARD_READ: ((1, 65_536, 5), (1, 65_536, b"bytes")),
    Verb.CARD_ERASE: ((0xFFFF,), ()),
}
"""Arguments and payload of each verb."""

OTHER_VALUES: Mapping[int, Any] = {
    1: 63,
    2: 4000.0,
    3: 313.8,
    4: 1.0,
    5: 1300.0,
    6: 99.5,
    7: 0.1,
    8: 3,
    9: tuple(place / 8 for place in range(-15, 15)),
    10: "poignet gauché",
}
"""A value of each setting that is not the factory's."""


def command_vectors() -> dict[str, Any]:
    """Return what ``vectors/commands.json`` holds."""
    vectors = [_verb_vector(verb, *example) for verb, example in _EXAMPLES.items()]
    return {"protocol_version": PROTOCOL_VERSION, "vectors": vectors}


def setting_vectors() -> dict[str, Any]:
    """Return what ``vectors/settings.json`` holds."""
    values = [(key, setting.factory) for key, setting in SETTINGS.items()] + list(OTHER_VALUES.items())
    # The largest there is: a reader that holds it in a signed number fails.
    generation = 2**32 - 1
    return {
        "protocol_version": PROTOCOL_VERSION,
        "vectors": [_setting_vector(key, value) for key, value in values],
        "slot": {
            "generation": generation,
            "settings": [_setting_vector(key, value) for key, value in OTHER_VALUES.items()],
            "image": encode_slot(generation, OTHER_VALUES).hex(),
        },
    }


def _verb_vector(verb: Verb, arguments: tuple[Any, ...], payload: tuple[Any, ...]) -> dict[str, Any]:
    sent, answered = encode_arguments(verb, *arguments), encode_payload(verb, *payload)
    command = Command(transaction=100 + verb, verb=verb, arguments=sent)
    answer = Acknowledgement(command.transaction, verb, Result.DONE, _UNIQUE_ID, answered)
    declared = VERBS[verb]
    return {
        "verb": int(verb),
        "name": declared.name,
        "arguments": {"values": _named(declared.arguments, arguments), "bytes": sent.hex()},
        "payload": {"values": _named(declared.payload, payload), "bytes": answered.hex()},
        "command": frame_vector(wire_frame(command, 9, int(verb), 1_000)),
        "acknowledgement": frame_vector(wire_frame(answer, 9, int(verb), 2_000)),
    }


def _named(declared: tuple[WireField, ...], values: tuple[Any, ...]) -> dict[str, Any]:
    names = [field.name for field in declared] + ["entries"]
    return {name: as_json(value) for name, value in zip(names, values, strict=False)}


def _setting_vector(key: int, value: Any) -> dict[str, Any]:
    data = encode_value(key, value)
    return {
        "key": key,
        "name": SETTINGS[key].name,
        "value": as_json(decode_value(key, data)),
        "bytes": data.hex(),
    }
