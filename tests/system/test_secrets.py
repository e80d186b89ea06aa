"""Credentials in every place that takes some; then everything that was written is searched for them."""

from __future__ import annotations

import ast
import asyncio
import os
import shutil
import subprocess
import urllib.error
import urllib.request

import aiomqtt
import orjson
import pytest

from devices.free_ports import free_port
from gateway.errors import GatewayError
from gateway.settings import load_gateway_settings
from tests.fixtures.processes import REPOSITORY
from tests.patience import PATIENCE_S

pytestmark = pytest.mark.system

PASSWORD, METRICS, URL_SECRET = "broker-pw-5fa1", "metrics-token-c0ffee-1", "link-pw-77aa"
LINK_KEY = "5eed" * 16
CONFIG = """
gateway: lab
links: [{{name: suit, url: {url}}}]
rig: single
mqtt: {{port: {port}, username: gateway, password_file: {password}, health_interval: 0.2}}
metrics: {{port: {metrics}, host: 0.0.0.0, token_file: {token}}}
recording: {{folder: {folder}, at_start: true}}
log: {{level: debug, format: json}}
"""


@pytest.fixture
def set_up(mosquitto, tmp_path, request):
    """(configuration file, the folder with all that is written) of a broker that asks for a password."""
    program = shutil.which("mosquitto_passwd", path=f"{os.environ['PATH']}:/usr/bin:/usr/sbin")
    if program is None:
        pytest.skip("mosquitto_passwd is not installed (apt install mosquitto)")
    passwords = tmp_path / "passwords"
    passwords.touch(0o600)
    subprocess.run([program, "-b", passwords, "gateway", PASSWORD], check=True, capture_output=True)
    mosquitto.configure(f"allow_anonymous false\npassword_file {passwords}")
    mosquitto.is_for_gateways_only = False
    mosquitto.restart()
    written = tmp_path / "written"
    written.mkdir()
    for name, text in (("password", PASSWORD), ("token", METRICS)):
        (tmp_path / name).write_text(text + "\n")
    places = {
        "port": mosquitto.port,
        "password": tmp_path / "password",
        "token": tmp_path / "token",
        "metrics": free_port(),
        "folder": written,
    }
    (tmp_path / "key").touch(0o600)
    (tmp_path / "key").write_text(LINK_KEY + "\n")
    url = f'"tcp://127.0.0.1:1?key_file={tmp_path / "key"}"'

    def configured(**changes):
        config = tmp_path / "gateway.yaml"
        config.write_text(CONFIG.format(**({**places, "url": url} | changes)))
        return config

    return configured, written, places


def assert_kept(*texts):
    for text in texts:
        for secret in (PASSWORD, METRICS, URL_SECRET, LINK_KEY):
            assert secret.encode() not in text, f"'{secret}' stands in {text[:2000]!r}"
        assert bytes.fromhex(LINK_KEY) not in text


WIDE = {"COLUMNS": "300"}


def fetched(port, path):
    """What the metrics' server answers to whoever has the token."""
    headers = {"Authorization": f"Bearer {METRICS}"}
    request = urllib.request.Request(f"http://127.0.0.1:{port}{path}", headers=headers)
    try:
        with urllib.request.urlopen(request, timeout=PATIENCE_S) as answer:
            return answer.read()
    except urllib.error.HTTPError as error:
        return error.read()


VERBS = ("gateway/info", "gateway/health", "recording/status", "gateway/reload")


async def heard(port, topic, seconds):
    """All that a subscriber receives until its requests are answered, and for a time after."""
    messages, unanswered = [], {f"mocap/lab/bridge/response/{verb}" for verb in VERBS}
    async with aiomqtt.Client("127.0.0.1", port, username="gateway", password=PASSWORD) as client:
        await client.subscribe(topic)
        for verb in VERBS:
            await client.publish(f"mocap/lab/bridge/request/{verb}", b"{}", qos=1)
        try:
            async with asyncio.timeout(PATIENCE_S) as limit:
                async for message in client.messages:
                    messages.append(message.payload)
                    if message.topic.value in unanswered:
                        unanswered.discard(message.topic.value)
                        if not unanswered:
                            limit.reschedule(asyncio.get_running_loop().time() + seconds)
        except TimeoutError:
            assert not unanswered
            return messages


async def test_nothing_that_a_gateway_writes_holds_a_secret(set_up, command):
    configured, written, places = set_up
    process = command("run", "-c", configured(), environment=WIDE)
    await process.until_it_says("connected to the MQTT broker")
    messages = await heard(places["port"], "#", 2.0)
    paths = ("/metrics", "/healthz", "/elsewhere")
    served = [await asyncio.to_thread(fetched, places["metrics"], path) for path in paths]
    process.terminate()
    await process.ended()
    assert any(orjson.loads(text).get("status") == "ok" for text in messages if text.startswith(b"{"))
    assert b"mocap_skeleton_frames" in served[0]
    recordings = list(written.glob("*.mcap"))
    assert recordings
    assert_kept(process.output.encode(), process.errors.encode())
    assert_kept(*messages, *served, *(path.read_bytes() for path in written.iterdir()))


async def test_what_is_said_of_wrong_credentials_does_not_repeat_them(set_up, command, tmp_path):
    configured, *_ = set_up
    wrong = tmp_path / "wrong"
    wrong.write_text(f"{URL_SECRET}\n")
    config = configured(password=wrong)
    for verb in ("run", "doctor"):
        process = command(verb, "-c", config, environment=WIDE)
        await process.until_so(lambda: "refuses user" in " ".join(all_of(process).split()), "a refusal")  # noqa: B023 - awaited here
        process.terminate()
        await process.ended()
        assert_kept(all_of(process).encode())


def all_of(process):
    return process.output + process.errors


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"url": f"tcp://user:{URL_SECRET}@127.0.0.1:1"}, "leave out what stands before the @"),
        ({"url": '"udp://:7000?key_file=/k", carries: markers'}, "key_file is for links of modules"),
        ({"port": f"1883, password: {PASSWORD}"}, "a password does not belong in the settings"),
        ({"token": f"[{METRICS}]"}, "token_file"),
        ({"token": "/nowhere/at/all"}, "cannot read metrics.token_file /nowhere/at/all"),
    ],
)
def test_a_configuration_that_is_refused_is_not_repeated(set_up, changes, said):
    configured, *_ = set_up
    with pytest.raises(GatewayError) as caught:
        load_gateway_settings(configured(**changes)).metrics.token()
    assert said in str(caught.value)
    assert_kept(str(caught.value).encode())


def test_no_secret_on_a_command_line():
    """What stands there, every user of the machine reads with ``ps``."""
    sources = sorted((REPOSITORY / "gateway" / "cli").glob("*.py"))
    assert sources
    taken = {
        argument.arg
        for path in sources
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.FunctionDef)
        for argument in (*node.args.args, *node.args.kwonlyargs)
        if argument.annotation is not None and "typer." in ast.unparse(argument.annotation)
    }
    assert "token_file" in taken
    assert not {name for name in taken if name.endswith(("password", "token", "secret"))}
