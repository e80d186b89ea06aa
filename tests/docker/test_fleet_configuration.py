"""The shipped configuration of a cluster, as the NATS server itself reads it."""

from __future__ import annotations

import asyncio
import contextlib
import os
import re
import stat
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import aiomqtt
import pytest
import yaml

from devices.free_ports import free_ports
from gateway.errors import GatewayError
from gateway.fleet import cluster
from gateway.outputs.connection import broker_connection, unique_identifier
from gateway.outputs.settings import MqttSettings
from tests.patience import PATIENCE_S

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
    environment = os.environ | {"NODE": "node1", "LEAF_URL": "nats://leaf-ward2:x@node1:7422"}
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


@pytest.mark.parametrize("name", ["", "gw/1", "gw 1", "*", ">", "gw>", "+", "#", "..", "gw\n1"])
def test_a_name_with_which_rights_cannot_be_written_is_refused(tmp_path: Path, name: str):
    """A gateway named * could publish the poses of all others."""
    for gateways, sites, base_topic in (([name], [], "mocap"), (["a"], [name], "mocap"), (["a"], [], name)):
        if (name, base_topic) == ("gw/1", name):
            continue  # a base topic may have levels
        with pytest.raises(GatewayError, match="must not be empty, nor hold"):
            cluster.write_users(tmp_path, gateways, base_topic, sites)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["overview", "operator", "leaf-ward"])
def test_a_gateway_cannot_have_the_name_of_another_kind_of_user(tmp_path: Path, name: str):
    with pytest.raises(GatewayError, match="are users of their own"):
        cluster.write_users(tmp_path, [name], sites=["ward"])


NODES = ("node1", "node2", "node3")
INSIDE = {"mqtt": 1883, "clients": 4222, "routes": 6222, "leaves": 7422, "monitoring": 8222}
"""Ports of the shipped files."""


class Shipped:
    """The shipped configuration as processes: names of hosts are loopback, ports are free ones."""

    def __init__(self, folder: Path, server: str) -> None:
        self._folder, self._server = folder, server
        everybody = (*NODES, "site")
        ports = iter(free_ports(len(everybody) * len(INSIDE)))
        self.ports = {name: {what: next(ports) for what in INSIDE} for name in everybody}
        cluster.write_users(folder, ["gw001", "gw002"], sites=["ward2"])

    @contextlib.contextmanager
    def running(self) -> Iterator[None]:
        processes = [self._start(name, "nats.conf") for name in NODES]
        processes.append(self._start("site", "leaf.conf"))
        try:
            yield
        finally:
            for process in processes:
                process.kill()
                process.wait()

    def _start(self, name: str, shipped: str) -> subprocess.Popen[bytes]:
        own = self._folder / name
        own.mkdir()
        (own / "users.conf").write_text((self._folder / "users.conf").read_text())
        text = (FOLDER / shipped).read_text().replace("/data", str(own))
        for what, port in INSIDE.items():
            text = re.sub(
                rf"(node\d):{port}\b",
                lambda found, what=what: f"127.0.0.1:{self.ports[found[1]][what]}",
                text,
            )
            text = re.sub(rf"\b{port}\b", str(self.ports[name][what]), text)
        (own / "nats.conf").write_text(text)
        password = (self._folder / "passwords" / "leaf-ward2").read_text().strip()
        leaf = f"nats://leaf-ward2:{password}@127.0.0.1:{self.ports['node1']['leaves']}"
        environment = {"NODE": name, "LEAF_URL": leaf}
        with (own / "log").open("wb") as log:
            return subprocess.Popen(
                [self._server, "-c", str(own / "nats.conf")],
                env=os.environ | environment,
                stdout=log,
                stderr=log,
            )

    def settings(self, user: str, node: str) -> MqttSettings:
        password_file = self._folder / "passwords" / user
        return MqttSettings(port=self.ports[node]["mqtt"], username=user, password_file=password_file)


@pytest.mark.system
async def test_the_shipped_cluster_serves_gateways_at_nodes_and_at_a_site(tmp_path: Path, server: str):
    shipped = Shipped(tmp_path, server)
    with shipped.running():
        reading = asyncio.create_task(_heard(shipped.settings("overview", "node3"), 2))
        await _publish_until(shipped.settings("gw001", "node1"), "mocap/gw001/pose", reading)
        await _publish_until(shipped.settings("gw002", "site"), "mocap/gw002/pose", reading)
        assert await reading == {"mocap/gw001/pose", "mocap/gw002/pose"}


async def _heard(settings: MqttSettings, number: int) -> set[str]:
    """Topics of poses, once so many were heard."""
    topics: set[str] = set()
    async with asyncio.timeout(PATIENCE_S):
        while True:
            with contextlib.suppress(aiomqtt.MqttError):
                async with broker_connection(settings, settings.port, unique_identifier("test")) as client:
                    await client.subscribe("mocap/+/pose")
                    async for message in client.messages:
                        topics.add(message.topic.value)
                        if len(topics) == number:
                            return topics
            await asyncio.sleep(0.2)


async def _publish_until(settings: MqttSettings, topic: str, reading: asyncio.Task[set[str]]) -> None:
    """Publish for a while, as soon as the broker lets us in."""
    async with asyncio.timeout(PATIENCE_S):
        while True:
            with contextlib.suppress(aiomqtt.MqttError):
                async with broker_connection(settings, settings.port, unique_identifier("test")) as client:
                    for _ in range(30):
                        await client.publish(topic, b"{}")
                        await asyncio.sleep(0.1)
                        if reading.done():
                            return
                    return
            await asyncio.sleep(0.2)
