"""The shipped broker configuration on a real mosquitto: who may do what, and TLS."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import shutil
import socket
import ssl
import subprocess
import sys
import time
from pathlib import Path

import aiomqtt
import pytest

from gateway.contract.messages import PoseMessage
from gateway.outputs.connection import broker_connection
from gateway.outputs.settings import MqttSettings, TlsSettings
from tests.patience import PATIENCE_S

SHIPPED = Path(__file__).resolve().parents[2] / "docker" / "mosquitto"
USERS = ("gateway", "operator", "app")
REQUEST = "mocap/gateway1/bridge/request/recording/start"
POSE = "mocap/gateway1/pose"
TOPICS = [
    *(
        f"mocap/gateway1/{below}"
        for below in ("pose", "pose/late", "body", "module/1/state", "bridge/echo/1")
    ),
    *(f"mocap/gateway1/bridge/{below}" for below in ("state", "info", "health", "response/gateway/health")),
    *(
        f"mocap/gateway1/bridge/request/{verb}"
        for verb in ("recording/start", "gateway/configure", "reset/full")
    ),
    "other/gateway1/pose",
    "homeassistant/device/x/config",
]
SBIN = "/usr/sbin:/usr/local/sbin:/usr/bin:/bin"

pytestmark = [
    pytest.mark.system,
    pytest.mark.skipif(
        shutil.which("mosquitto", path=SBIN) is None or shutil.which("mosquitto_passwd", path=SBIN) is None,
        reason="mosquitto is not installed (apt install mosquitto)",
    ),
]


def make_certificates(folder: Path) -> None:
    """A test authority and the broker's certificate, as docker/mosquitto/README.md says."""
    (folder / "san").write_text("subjectAltName=DNS:localhost,IP:127.0.0.1")
    for command in (
        "req -x509 -newkey rsa:2048 -nodes -days 2 -subj /CN=test-ca -keyout ca.key -out ca.crt",
        "req -newkey rsa:2048 -nodes -subj /CN=broker -keyout server.key -out server.csr",
        "x509 -req -in server.csr -CA ca.crt -CAkey ca.key -CAcreateserial -out server.crt -extfile san",
    ):
        subprocess.run(["openssl", *command.split()], cwd=folder, check=True, capture_output=True)


@contextlib.contextmanager
def shipped_broker(folder: Path, port: int, with_tls: bool = False, more_rights: str = ""):
    """mosquitto with the shipped file, its paths and port put into the test's folder."""
    config = (SHIPPED / "mosquitto.conf").read_text()
    if with_tls:
        make_certificates(folder)
        config = config.replace("listener 1883", "").replace("# listener 8883", f"listener {port} 127.0.0.1")
        for name in ("cafile", "certfile", "keyfile"):
            config = config.replace(f"# {name} /mosquitto/config/certs/", f"{name} {folder}/")
    config = config.replace("listener 1883", f"listener {port} 127.0.0.1")
    config = config.replace("/mosquitto/config/", f"{folder}/").replace("/mosquitto/data/", f"{folder}/")
    (folder / "mosquitto.conf").write_text(config + "\nuser root\n")
    (folder / "acl").write_text((SHIPPED / "acl").read_text() + f"\n{more_rights}\n")
    (folder / "acl").chmod(0o600)
    (folder / "passwords").touch(0o600)
    for user in USERS:
        command = [
            shutil.which("mosquitto_passwd", path=SBIN),
            "-b",
            folder / "passwords",
            user,
            f"{user}-pw",
        ]
        subprocess.run([str(part) for part in command], check=True, capture_output=True)
    program = str(shutil.which("mosquitto", path=SBIN))
    process = subprocess.Popen([program, "-c", folder / "mosquitto.conf"], stdout=subprocess.DEVNULL)
    try:
        deadline = time.monotonic() + PATIENCE_S
        while process.poll() is None and time.monotonic() < deadline:
            with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), 1.0):
                break
            time.sleep(0.02)
        yield
    finally:
        process.terminate()
        process.wait(PATIENCE_S)


def client_of(user: str, port: int) -> aiomqtt.Client:
    return aiomqtt.Client("127.0.0.1", port, username=user, password=f"{user}-pw")


async def heard(port: int, sender: str, topic: str) -> bool:
    """Whether a message of ``sender`` reaches whom it is for: requests the gateway, poses an app.

    Another follows it, of one who may send there: that comes in any case.
    """
    whom, who_may = ("gateway", "operator") if topic == REQUEST else ("app", "gateway")
    async with (
        client_of(whom, port) as listener,
        client_of(sender, port) as client,
        client_of(who_may, port) as other,
    ):
        await listener.subscribe(topic)
        await client.publish(topic, b"{}", qos=1)
        await other.publish(topic, b"last", qos=1)
        came = []
        async with asyncio.timeout(PATIENCE_S):
            while b"last" not in came:
                came.append((await anext(aiter(listener.messages))).payload)
    assert came in ([b"last"], [b"{}", b"last"])
    return len(came) == 2


async def test_only_the_named_user_may_send_requests(tmp_path, unused_port):
    with shipped_broker(tmp_path, unused_port):
        assert await heard(unused_port, "operator", REQUEST)
        assert not await heard(unused_port, "app", REQUEST)
        assert not await heard(unused_port, "app", POSE)
        assert not await heard(unused_port, "operator", POSE)
        assert await heard(unused_port, "gateway", POSE)


@pytest.mark.parametrize(
    ("user", "refused"),
    [
        ("gateway", {"other/gateway1/pose", "homeassistant/device/x/config"}),
        ("operator", {*TOPICS} - {topic for topic in TOPICS if "/bridge/request/" in topic}),
        ("app", {*TOPICS}),
    ],
)
async def test_each_user_publishes_what_is_theirs_and_nothing_else(tmp_path, unused_port, user, refused):
    """Written with MQTT 5 and QoS 1, where the broker says what it refuses."""
    answers: dict[str, bool] = {}

    def note(topic, code):
        answers[topic] = code.is_failure

    with shipped_broker(tmp_path, unused_port):
        (tmp_path / "password").write_text(f"{user}-pw")
        settings = MqttSettings(
            port=unused_port, username=user, password_file=tmp_path / "password", protocol="5"
        )
        async with broker_connection(settings, unused_port, "rights", on_answer=note) as client:
            for topic in TOPICS:
                await client.publish(topic, b"{}", qos=1)
    assert answers == {topic: topic in refused for topic in TOPICS}


@pytest.mark.parametrize("user", ["operator", "app"])
async def test_who_reads_hears_all_gateways_and_nothing_else(tmp_path, unused_port, user):
    """A gateway receives its own state, health and echoes too: ``test_the_gateway_hears_…`` has the rest."""
    elsewhere = "other/gateway1/pose"
    with shipped_broker(tmp_path, unused_port, more_rights=f"user gateway\ntopic write {elsewhere}"):
        async with client_of(user, unused_port) as reader, client_of("gateway", unused_port) as gateway:
            await reader.subscribe("#")
            read = [topic for topic in TOPICS if topic.startswith("mocap/")]
            for topic in (elsewhere, *read):
                await gateway.publish(topic, b"{}", qos=1)
            heard = []
            async with asyncio.timeout(PATIENCE_S):
                while read[-1] not in heard:
                    heard.append((await anext(aiter(reader.messages))).topic.value)
    assert heard == read


async def test_the_gateway_hears_requests_and_nothing_else(tmp_path, unused_port):
    with shipped_broker(tmp_path, unused_port):
        async with (
            client_of("gateway", unused_port) as gateway,
            client_of("operator", unused_port) as operator,
        ):
            await gateway.subscribe("#")
            await gateway.publish(POSE, b"pose", qos=1)
            await operator.publish(REQUEST, b"{}", qos=1)
            async with asyncio.timeout(PATIENCE_S):
                assert (await anext(aiter(gateway.messages))).topic.value == REQUEST


async def test_an_app_reads_poses_and_a_stranger_is_refused(tmp_path, unused_port):
    with shipped_broker(tmp_path, unused_port):
        async with client_of("app", unused_port) as app, client_of("gateway", unused_port) as gateway:
            await app.subscribe(POSE)
            await gateway.publish(POSE, b"pose")
            async with asyncio.timeout(PATIENCE_S):
                assert (await anext(aiter(app.messages))).payload == b"pose"
        with pytest.raises(aiomqtt.MqttError):
            async with aiomqtt.Client("127.0.0.1", unused_port):
                pass
        with pytest.raises(aiomqtt.MqttError):
            async with aiomqtt.Client("127.0.0.1", unused_port, username="app", password="guessed"):
                pass


@pytest.mark.skipif(shutil.which("openssl") is None, reason="openssl is not installed")
async def test_tls_with_the_right_authority_only(tmp_path, unused_port, monkeypatch):
    monkeypatch.setenv("MOCAP_MQTT_PASSWORD", "gateway-pw")
    with shipped_broker(tmp_path, unused_port, with_tls=True):
        trusted = MqttSettings(
            port=unused_port, username="gateway", tls=TlsSettings(ca_file=tmp_path / "ca.crt")
        )
        async with broker_connection(trusted, unused_port, "tls-test") as client:
            await client.subscribe(REQUEST)
            await client.publish(REQUEST, b"secret")
            async with asyncio.timeout(PATIENCE_S):
                assert (await anext(aiter(client.messages))).payload == b"secret"
        stranger = trusted.model_copy(update={"tls": TlsSettings()})
        with pytest.raises((ssl.SSLError, aiomqtt.MqttError)):
            async with broker_connection(stranger, unused_port, "tls-test"):
                pass


@pytest.mark.skipif(shutil.which("openssl") is None, reason="openssl is not installed")
async def test_the_command_line_speaks_tls(tmp_path, unused_port):
    pose = PoseMessage(
        t_ns=1, seq=7, frame="ENU", order="wxyz", root="head",
        segments={"head": (1.0, 0.0, 0.0, 0.0)}, status={"head": "measured"},
    )  # fmt: skip
    words = ["watch", "--port", str(unused_port), "--ca-file", str(tmp_path / "ca.crt"), "--username", "app"]
    with shipped_broker(tmp_path, unused_port, with_tls=True):
        process = await asyncio.create_subprocess_exec(
            sys.executable, "-m", "gateway", *words, "--count", "1", "--json", "--timeout", "60",
            stdout=asyncio.subprocess.PIPE, env=os.environ | {"MOCAP_MQTT_PASSWORD": "app-pw"},
        )  # fmt: skip
        reading = asyncio.create_task(process.communicate())
        authority = aiomqtt.TLSParameters(ca_certs=str(tmp_path / "ca.crt"))
        async with aiomqtt.Client(
            "127.0.0.1", unused_port, username="gateway", password="gateway-pw", tls_params=authority
        ) as gateway:
            while not reading.done():
                await gateway.publish(POSE, pose.payload())
                await asyncio.sleep(0.1)
        out, _ = await reading
    assert process.returncode == 0
    assert json.loads(out)["seq"] == 7
