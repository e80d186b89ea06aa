"""A cluster of NATS servers that speak MQTT: users and their rights, three nodes as processes to try."""

from __future__ import annotations

import json
import re
import secrets
import shutil
import signal
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterable, Mapping, Sequence
from http import HTTPStatus
from pathlib import Path
from types import TracebackType
from typing import Self

from devices.extras import how_to_add
from devices.free_ports import free_ports
from gateway.contract.topics import Topics
from gateway.errors import GatewayError
from gateway.fleet.routes import CuttableRoutes
from gateway.support.whole_files import write_whole

NODES = 3
READER = "overview"
"""User that may listen to all gateways, and ask them."""
OPERATOR = "operator"
"""User that may also change the settings of gateways which allow it."""
_NAME = re.compile(r"[^\s\0#+/*>.][^\s\0#+/*>]*")
"""No wildcard of MQTT or NATS, nor a separator of either: rights on such a name were rights on others."""
LEAF = "leaf-"
"""Beginning of the users as which nodes at sites connect; gateways there have rights at that node."""
_NOWHERE = "127.0.0.1:1"
"""What nodes tell others of where they are: each knows its routes, and makes no others."""
_START_S = 20.0
_STOP_S = 3.0
_POLL_S = 0.05


def subject_of(topic: str) -> str:
    """Return an MQTT topic as the NATS server names it: dots between levels, and slashes for a dot in one."""
    return ".".join(level.replace(".", "//") for level in topic.split("/"))


def users_config(passwords: Mapping[str, str], base_topic: str = "mocap") -> str:
    """Return the users of a cluster as its configuration wants them.

    passwords: by name of the gateway, ``READER``, ``OPERATOR``, or ``LEAF`` and the name of a site. A
    gateway may publish below its own name alone, and read what others publish and ask there.
    Raises ``ValueError`` for a name that cannot stand in a topic.
    """
    users = [_user(name, password, base_topic) for name, password in passwords.items()]
    return "authorization {\n  users: [\n" + "".join(f"    {user}\n" for user in users) + "  ]\n}\n"


def _user(name: str, password: str, base_topic: str) -> str:
    if name.startswith(LEAF):
        return f"{{user: {json.dumps(name)}, password: {json.dumps(password)}}}"
    deny: list[str] = []
    if name in (READER, OPERATOR):
        # They ask and are answered; poses they cannot make.
        publish = [subject_of(f"{base_topic}/*/bridge/{below}/>") for below in ("request", "echo")]
        if name == READER:
            deny = [
                subject_of(f"{base_topic}/*/bridge/request/gateway/{verb}")
                for verb in ("configure", "confirm")
            ]
        # With the level above, for the filter <base_topic>/# means that as well.
        subscribe = [subject_of(base_topic), subject_of(f"{base_topic}/>")]
    else:
        root = subject_of(Topics(base_topic, name).root)
        publish, subscribe = [f"{root}.>"], [f"{root}.bridge.>"]
    # What the server does for MQTT on behalf of a user: QoS 1 to its own subscriptions.
    subscribe.append("$MQTT.sub.>")
    rights = {"publish": {"allow": publish, "deny": deny}, "subscribe": {"allow": subscribe}}
    return (
        f"{{user: {json.dumps(name)}, password: {json.dumps(password)}, permissions: {json.dumps(rights)}}}"
    )


def _is_ready(node: Node) -> bool:
    """Return whether a node serves, and the cluster has a leader for what is kept."""
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{node.monitor_port}/healthz", timeout=1) as answer:
            return bool(answer.status == HTTPStatus.OK)
    except OSError:
        return False


def new_passwords(gateways: Iterable[str]) -> dict[str, str]:
    """Return a password for each gateway, for ``READER`` and for ``OPERATOR``."""
    return {name: secrets.token_urlsafe(18) for name in (READER, OPERATOR, *gateways)}


def write_users(
    folder: Path, gateways: Sequence[str], base_topic: str = "mocap", sites: Sequence[str] = ()
) -> list[str]:
    """Write ``users.conf`` and a file with the password of each user, for the eyes of their owner alone.

    sites: names of those with a node of their own. A user that has a password already keeps it, named here or
    not. Returns the names of all users. Raises ``GatewayError`` for a name that cannot be that of a user.
    """
    for what, name in (
        *(("gateway", each) for each in gateways),
        *(("--site", each) for each in sites),
        *(("--base-topic", level) for level in base_topic.split("/")),
    ):
        if not _NAME.fullmatch(name):
            raise GatewayError(
                f"{what} '{name}': must not be empty, nor hold any of # + / * > or white space, nor begin "
                "with a dot: the brokers' rights are written with these"
            )
    taken = [name for name in gateways if name in (READER, OPERATOR) or name.startswith(LEAF)]
    if taken:
        raise GatewayError(
            f"a gateway cannot be named '{taken[0]}': {READER}, {OPERATOR} and {LEAF}… are users of their own"
        )
    gateways = [*gateways, *(f"{LEAF}{site}" for site in sites)]
    secrets_folder = folder / "passwords"
    secrets_folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    kept = {path.name: path.read_text().strip() for path in sorted(secrets_folder.glob("[!.]*"))}
    passwords = new_passwords(gateways) | {name: password for name, password in kept.items() if password}
    try:
        text = users_config(passwords, base_topic)
    except ValueError as error:
        raise GatewayError(str(error)) from None
    for name, password in passwords.items():
        write_whole(secrets_folder / name, f"{password}\n".encode(), 0o600)
    write_whole(folder / "users.conf", text.encode(), 0o600)
    return sorted(passwords)


def program() -> str:
    """Return where the NATS server is: that of the extra, else that of the system.

    Raises ``GatewayError``.
    """
    beside = Path(sys.executable).with_name("nats-server")
    found = str(beside) if beside.exists() else shutil.which("nats-server")
    if found is None:
        raise GatewayError(f"a cluster of brokers needs the extra 'fleet': {how_to_add('fleet')}")
    return found


class Node:
    """One NATS server of a cluster, as a process on loopback."""

    def __init__(
        self, index: int, folder: Path, ports: Sequence[int], routes: Sequence[int], users: str
    ) -> None:
        """Describe a node, not started.

        ports: of MQTT, cluster, NATS' own clients, monitoring. routes: to the other nodes' clusters.
        """
        self.name = f"node{index + 1}"
        self.mqtt_port, self._cluster_port, self._client_port, self.monitor_port = ports
        self._folder = folder / self.name
        self._folder.mkdir(parents=True, exist_ok=True)
        self._config = self._folder / "nats.conf"
        urls = ", ".join(f'"nats://127.0.0.1:{port}"' for port in routes)
        text = f"""server_name: {self.name}
host: 127.0.0.1
port: {self._client_port}
http: 127.0.0.1:{self.monitor_port}
jetstream {{ store_dir: {json.dumps(str(self._folder))}, max_mem: 256MB, max_file: 1GB }}
mqtt {{ host: 127.0.0.1, port: {self.mqtt_port}, stream_replicas: {NODES} }}
cluster {{
  name: mocap, host: 127.0.0.1, port: {self._cluster_port}, no_advertise: true, advertise: "{_NOWHERE}"
  routes: [{urls}]
}}
{users}"""
        self._config.touch(mode=0o600)
        self._config.write_text(text)
        self._process: subprocess.Popen[bytes] | None = None

    @property
    def pid(self) -> int:
        """Of the process. Raises ``AssertionError`` where there is none."""
        assert self._process is not None
        return self._process.pid

    @property
    def log_file(self) -> Path:
        """What the server said."""
        return self._folder / "nats.log"

    def start(self) -> None:
        """Start the process; ``Cluster.await_ready`` waits for it."""
        with self.log_file.open("ab") as log:
            self._process = subprocess.Popen(
                [program(), "-c", str(self._config)], stdout=log, stderr=log, start_new_session=True
            )

    def kill(self) -> None:
        """End it without a farewell, as a power cut does."""
        self._end(signal.SIGKILL)

    def stop(self) -> None:
        """End it in good order."""
        self._end(signal.SIGTERM)

    def _end(self, number: signal.Signals) -> None:
        if self._process is None:
            return
        self._process.send_signal(signal.SIGCONT)
        self._process.send_signal(number)
        try:
            self._process.wait(_STOP_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._process = None

    @property
    def has_ended(self) -> bool:
        """Whether it ended by itself."""
        return self._process is not None and self._process.poll() is not None


class Cluster:
    """Three nodes on loopback that know each other, ended on leaving."""

    def __init__(
        self, folder: Path, passwords: Mapping[str, str] | None = None, *, is_cuttable: bool = False
    ) -> None:
        """Describe a cluster, not started.

        folder: for what the servers keep. passwords: by user; None: everybody may do everything.
        is_cuttable: whether the network between the nodes can be cut, by ``routes``.
        """
        self.routes: CuttableRoutes | None = None
        free = free_ports(4 * NODES)
        ports = [free[index::NODES] for index in range(NODES)]
        routes = [[own[1] for own in ports]] * NODES
        if is_cuttable:
            self.routes = CuttableRoutes([own[1] for own in ports])
            self.routes.start()
            routes = [self.routes.from_node(index) for index in range(NODES)]
        users = users_config(passwords) if passwords else ""
        self.nodes = [
            Node(index, folder, own, to_others, users)
            for index, (own, to_others) in enumerate(zip(ports, routes, strict=True))
        ]

    def addresses(self, first: int = 0) -> list[str]:
        """Return HOST:PORT of MQTT of all nodes, beginning with node ``first``."""
        nodes = [self.nodes[(first + index) % NODES] for index in range(NODES)]
        return [f"127.0.0.1:{node.mqtt_port}" for node in nodes]

    def await_ready(self) -> None:
        """Wait until all nodes are in the cluster. Raises ``GatewayError`` where that does not happen."""
        deadline = time.monotonic() + _START_S
        while not all(_is_ready(node) for node in self.nodes):
            ended = next((node for node in self.nodes if node.has_ended), None)
            if ended is not None or time.monotonic() > deadline:
                node = ended or self.nodes[0]
                last = node.log_file.read_text(errors="replace").strip().rpartition("\n")[2]
                raise GatewayError(f"the broker {node.name} did not start: {last or 'it says nothing'}")
            time.sleep(_POLL_S)

    def __enter__(self) -> Self:
        try:
            for node in self.nodes:
                node.start()
            self.await_ready()
        except BaseException:
            self._stop()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop()

    def _stop(self) -> None:
        if self.routes is not None:
            self.routes.stop()
        for node in self.nodes:
            node.stop()
