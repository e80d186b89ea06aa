"""The documents of the MQTT contract: as declared, as on disk, and true of what is published."""

from __future__ import annotations

import re
from pathlib import Path

import jsonschema
import numpy as np
import orjson
import pytest
import yaml

from gateway.body.rig import load_rig
from gateway.contract.documents import asyncapi, files, json_schemas, write
from gateway.contract.messages import PUBLICATIONS
from gateway.contract.requests import REQUEST_FAMILIES
from gateway.frames import SkeletonFrame
from gateway.outputs.pose_encoding import PoseEncoder
from gateway.outputs.settings import PoseMap
from gateway.service.service import Service
from gateway.settings import GatewaySettings
from tests.contract_watch import topic_pattern

FOLDER = Path(__file__).resolve().parents[3] / "docs" / "mqtt"


def test_the_files_on_disk_are_what_the_models_say():
    remedy = "run: python -m gateway.contract.documents docs/mqtt"
    written = files()
    on_disk = {path.relative_to(FOLDER).as_posix() for path in FOLDER.rglob("*") if path.is_file()}
    assert on_disk == set(written), remedy
    for path, content in written.items():
        assert (FOLDER / path).read_bytes() == content, f"{path} is out of date; {remedy}"


def test_writing_removes_schemas_of_messages_that_are_gone(tmp_path):
    (tmp_path / "schemas").mkdir()
    (tmp_path / "schemas" / "Gone.json").write_text("{}")
    write(tmp_path)
    assert sorted(path.name for path in (tmp_path / "schemas").iterdir()) == sorted(
        f"{name}.json" for name in json_schemas()
    )


@pytest.mark.parametrize("name", json_schemas())
def test_every_schema_is_one_and_refuses_unknown_keys(name):
    schema = json_schemas()[name]
    jsonschema.Draft202012Validator.check_schema(schema)
    with pytest.raises(jsonschema.ValidationError, match="unheard_of"):
        jsonschema.Draft202012Validator(schema | {"required": []}).validate({"unheard_of": 1})


def references(document):
    """Every $ref in a document."""
    if isinstance(document, dict):
        if isinstance(document.get("$ref"), str):
            yield document["$ref"]
        document = list(document.values())
    if isinstance(document, list):
        for item in document:
            yield from references(item)


def test_asyncapi_refers_to_nothing_that_is_not_there_and_has_every_topic():
    document = yaml.safe_load(files()["asyncapi.yaml"])
    assert document == asyncapi()
    for reference in references(document):
        found = document
        for part in reference.removeprefix("#/").split("/"):
            found = found[part]
    addresses = {channel["address"] for channel in document["channels"].values()}
    root = "{base_topic}/{gateway}"
    assert {f"{root}/{publication.topic}" for publication in PUBLICATIONS} <= addresses
    for family, models in REQUEST_FAMILIES.items():
        for verb in models:
            assert f"{root}/bridge/request/{family}/{verb}" in addresses
            assert f"{root}/bridge/response/{family}/{verb}" in addresses
    for channel in document["channels"].values():
        assert set(re.findall(r"\{(\w+)\}", channel["address"])) == set(channel["parameters"])


def test_schemas_of_asyncapi_are_draft_7_and_take_a_real_pose():
    shared = asyncapi()["components"]["schemas"]
    for schema in shared.values():
        jsonschema.Draft7Validator.check_schema(schema)
    n = 3
    frame = SkeletonFrame(
        sequence=1, time_ns=2, q_wb=np.tile([1.0, 0, 0, 0], (n, 1)), angular_rate=np.zeros((n, 3)),
        joint_acceleration=np.zeros((n, 3)), p_w=np.full((n, 3), np.nan), sigma=np.zeros(n),
        status=np.zeros(n, dtype=np.uint8), root=0,
    )  # fmt: skip
    pose = orjson.loads(PoseEncoder(("a", "b", "c"), 6, frozenset(PoseMap)).encode(frame))
    whole = {"$ref": "#/components/schemas/PoseMessage", "components": {"schemas": shared}}
    for validator, schema in (
        (jsonschema.Draft7Validator, whole),
        (jsonschema.Draft202012Validator, json_schemas()["PoseMessage"]),
    ):
        validator(schema).validate(pose)
        with pytest.raises(jsonschema.ValidationError):
            validator(schema).validate(pose | {"segments": {"a": [1, 0, 0]}})


def test_every_request_that_a_gateway_answers_is_in_the_contract():
    settings = GatewaySettings(
        links=[{"name": "suit", "url": "tcp://127.0.0.1:1"}], rig="robot_arm_4", reconstructor="independent"
    )
    service = Service(settings, load_rig("robot_arm_4"))
    assert set(service.requests._families) == set(REQUEST_FAMILIES)
    assert {*service.recording._verbs, *service.shelf._verbs} == set(REQUEST_FAMILIES["recording"])


def test_topic_patterns_tell_publications_apart():
    topics = [
        "bridge/state",
        "module/17/state",
        "module/254/availability",
        "pose",
        "pose/other",
        "pose/msgpack",
        "segment/left_hand",
        "segment/left/hand",
        "module/x/state",
    ]
    assert {p.topic for p in PUBLICATIONS if topic_pattern(p).match("pose/msgpack")} == {"pose/msgpack"}
    found = [[p.model.__name__ for p in PUBLICATIONS if topic_pattern(p).match(topic)] for topic in topics]
    assert found == [
        ["BridgeState"],
        ["ModuleState"],
        ["ModuleAvailability"],
        ["PoseMessage"],
        [],
        ["PoseMessage"],
        ["SegmentMessage"],
        [],
        [],
    ]
