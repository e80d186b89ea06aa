"""The shipped configuration of a cluster, as the NATS server itself reads it."""

from __future__ import annotations

import os
import stat
import subprocess
from pathlib import Path
from typing import Any

import pytest
import yaml

from gateway.errors import GatewayError
from gateway.fleet import cluster

FOLDER = Path(__file__).parents[2] / "docker" / "fleet"


@pytest.fixture
def server() -> str:
    try:
        return cluster.program()
    except GatewayError as error:
        pytest.skip(str(error))


@pytest.mark.parametrize("name", ["nats.conf", "leaf.conf"])
def test_the_server_takes_the_shipped_configuration(server: str, tmp_path: Path, name: str):
    cluster.write_users(tmp_path, ["gw001", "gw.2"])
    (tmp_path / name).write_text((FOLDER / name).read_text().replace("/data", str(tmp_path)))
    environment = os.environ | {"NODE": "node1", "LEAF_USER": "overview", "LEAF_PASSWORD": "x"}
    told = subprocess.run(
        [server, "-t", "-c", str(tmp_path / name)],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert told.returncode == 0, told.stderr


def test_the_compose_file_has_the_nodes_that_the_configuration_names():
    compose: dict[str, Any] = yaml.safe_load((FOLDER / "compose.yaml").read_text())
    routes = (FOLDER / "nats.conf").read_text()
    for name, service in compose["services"].items():
        assert f"nats://{name}:6222" in routes
        assert service["environment"]["NODE"] == service["hostname"] == name
        assert all(port.startswith("127.0.0.1:") for port in service["ports"])


def test_users_keep_their_passwords_which_only_their_owner_may_read(tmp_path: Path):
    cluster.write_users(tmp_path, ["gw001"])
    before = (tmp_path / "passwords" / "gw001").read_text()
    assert cluster.write_users(tmp_path, ["gw002"]) == ["gw001", "gw002", "operator", "overview"]
    assert (tmp_path / "passwords" / "gw001").read_text() == before
    for path in (tmp_path / "users.conf", *(tmp_path / "passwords").iterdir()):
        assert stat.S_IMODE(path.stat().st_mode) == 0o600


def test_a_name_that_cannot_stand_in_a_topic_is_refused(tmp_path: Path):
    with pytest.raises(GatewayError, match="must not be empty, nor hold"):
        cluster.write_users(tmp_path, ["gw/1"])


@pytest.mark.parametrize("name", ["overview", "operator", "leaf-ward"])
def test_a_gateway_cannot_have_the_name_of_another_kind_of_user(tmp_path: Path, name: str):
    with pytest.raises(GatewayError, match="are users of their own"):
        cluster.write_users(tmp_path, [name], sites=["ward"])
