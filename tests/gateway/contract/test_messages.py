"""Published models and what they are made from."""

from __future__ import annotations

import typing

import numpy as np
import orjson
import pytest
from pydantic import ValidationError

from gateway.body.skeleton import Skeleton
from gateway.contract.messages import (
    PUBLICATIONS,
    STATUS_NAMES,
    BodyMessage,
    BridgeInfo,
    Message,
    PoseMessage,
    StatusName,
    describe_body,
    plain_json,
)
from gateway.frames import Status


def test_status_names_of_the_schema_are_those_of_the_frames() -> None:
    assert typing.get_args(StatusName) == tuple(status.name.lower() for status in Status) == STATUS_NAMES


def test_body_names_parents_and_keeps_lengths() -> None:
    skeleton = Skeleton(
        name="leg",
        segment_names=("pelvis", "left_thigh"),
        parents=np.array([-1, 0]),
        offsets=np.array([[0, 0, 0], [0.0, -0.1, -0.09]]),
        tips=np.array([[0, 0.1, 0], [0, -0.43, 0]]),
    )
    body = BodyMessage.model_validate_json(describe_body(skeleton).payload())
    assert (body.name, body.frame, body.order, body.length_unit) == ("leg", "ENU", "wxyz", "m")
    assert [(s.name, s.parent) for s in body.segments] == [("pelvis", None), ("left_thigh", "pelvis")]
    np.testing.assert_array_equal([s.offset for s in body.segments], skeleton.offsets)
    np.testing.assert_array_equal([s.tip for s in body.segments], skeleton.tips)


@pytest.mark.parametrize("wrong", ["NaN", "Infinity", '"1"'])
def test_numbers_are_finite(wrong: str) -> None:
    text = (
        '{"t_ns":1,"seq":1,"frame":"ENU","order":"wxyz","root":"a","status":{"a":"held"},'
        f'"segments":{{"a":[{wrong},0,0,0]}}}}'
    )
    assert PoseMessage.model_validate_json(text.replace(wrong, "1")).segments["a"] == (1, 0, 0, 0)
    with pytest.raises(ValidationError):
        PoseMessage.model_validate_json(text, strict=True)


def test_statistics_of_any_kind_become_json() -> None:
    plain = plain_json(
        {
            "residual_us": float("nan"),
            "dropped": {Status.HELD: np.int64(3), "rates": np.array([1.5, np.inf])},
            7: (1, 2),
            "method": object,
        }
    )
    assert plain["residual_us"] is None
    assert plain["dropped"] == {"2": 3, "rates": [1.5, None]}
    assert plain["7"] == [1, 2]
    assert plain["method"] == "<class 'object'>"


def test_every_field_of_every_message_is_described() -> None:
    models: list[type[Message]] = [publication.model for publication in PUBLICATIONS]
    bare = [
        f"{model.__name__}.{name}"
        for model in models
        for name, field in model.model_fields.items()
        if not field.description
    ]
    assert bare == []


def test_unknown_keys_are_refused() -> None:
    info = BridgeInfo(version="1", gateway="lab", reconstructor="inertial", frame_rate=100)
    given = orjson.loads(info.payload())
    assert BridgeInfo.model_validate(given) == info
    with pytest.raises(ValidationError, match="colour"):
        BridgeInfo.model_validate(given | {"colour": "red"})
