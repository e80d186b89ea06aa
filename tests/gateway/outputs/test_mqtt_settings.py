"""Settings of the MQTT output: what is refused, and that no password shows."""

from __future__ import annotations

from pathlib import Path

import pytest
from pydantic import ValidationError

from gateway.outputs.settings import PASSWORD_VARIABLE, MqttSettings
from gateway.support.credentials import CredentialError

SECRET = "correct horse battery"


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"hosst": "a"}, "hosst"),
        ({"broker": "embedded", "host": "10.0.0.7"}, "broker: external"),
        ({"broker": "embedded", "tls": {}}, "no TLS"),
        ({"port": 0}, "embedded"),
        ({"tls": {"certificate": "c.pem"}}, "belong together"),
        ({"base_topic": "mocap/#"}, "base_topic"),
        ({"base_topic": "/mocap"}, "base_topic"),
        ({"queue_length": 0}, "queue_length"),
        ({"pose_rate": 0.0}, "pose_rate"),
        ({"include": ["positions"]}, "include"),
        ({"protocol": "3.1"}, "protocol"),
    ],
)
def test_what_cannot_work_is_refused_by_name(given: dict[str, object], words: str) -> None:
    with pytest.raises(ValidationError, match=words):
        MqttSettings.model_validate(given)


def test_every_setting_is_described() -> None:
    schema = MqttSettings.model_json_schema()
    models = [schema, *schema["$defs"].values()]
    fields = [(name, field) for model in models for name, field in model.get("properties", {}).items()]
    assert {name for name, _ in fields} >= {"host", "ca_file"}
    assert [name for name, field in fields if not field.get("description")] == []


def test_password_in_the_settings_is_refused_without_being_quoted() -> None:
    with pytest.raises(ValidationError, match=PASSWORD_VARIABLE) as caught:
        MqttSettings.model_validate({"username": "suit", "password": SECRET})
    assert SECRET not in str(caught.value)


def test_password_comes_from_the_file_or_else_the_environment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "password"
    file.write_text(f"{SECRET}\nsecond line\n")
    monkeypatch.setenv(PASSWORD_VARIABLE, "from the environment")
    assert MqttSettings(username="suit").read_password() == "from the environment"
    settings = MqttSettings(username="suit", password_file=file)
    assert settings.read_password() == SECRET
    assert SECRET not in repr(settings) + settings.model_dump_json()
    monkeypatch.delenv(PASSWORD_VARIABLE)
    assert MqttSettings(username="suit").read_password() is None


def test_unreadable_password_file_is_named(tmp_path: Path) -> None:
    absent = tmp_path / "absent"
    with pytest.raises(CredentialError, match=rf"{absent} \(No such file"):
        MqttSettings(password_file=absent).read_password()
    binary = tmp_path / "binary"
    binary.write_bytes(b"\xff\xfe\x00secret")
    with pytest.raises(CredentialError, match="not UTF-8 text"):
        MqttSettings(password_file=binary).read_password()


def test_embedded_broker_is_always_spoken_to_in_3_1_1() -> None:
    assert MqttSettings(broker="embedded", protocol="5").protocol_in_use == "3.1.1"
    assert MqttSettings(broker="external", protocol="5").protocol_in_use == "5"
