"""The examples, run as their readers run them: against a broker or a datagram of the gateway's own."""

from __future__ import annotations

import asyncio
import functools
import http.server
import importlib.util
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
from pathlib import Path

import jsonschema
import numpy as np
import pytest

from devices.free_ports import free_port
from gateway.body.rig import load_rig
from gateway.contract.messages import BridgeInfo
from gateway.frames import SkeletonFrame
from gateway.outputs.mqtt import MqttOutput
from gateway.outputs.settings import MqttSettings, OutputsSettings
from gateway.outputs.side_outputs import SideOutputs
from gateway.outputs.unity import AvatarPoses, t_pose
from tests.patience import PATIENCE_S

pytestmark = pytest.mark.system
EXAMPLES = Path(__file__).parents[2] / "examples"
SKELETON = load_rig("suit_17").skeleton
INFO = BridgeInfo(version="0", gateway="lab", reconstructor="independent", frame_rate=100.0)


def frame(sequence, q_wb=None):
    n = SKELETON.n_segments
    return SkeletonFrame(
        sequence=sequence, time_ns=20_000_000 * sequence, q_wb=np.tile(SKELETON.neutral, (n, 1))
        if q_wb is None else q_wb, angular_rate=np.zeros((n, 3)), joint_acceleration=np.zeros((n, 3)),
        p_w=np.zeros((n, 3)), sigma=np.zeros(n), status=np.zeros(n, np.uint8), root=0,
    )  # fmt: skip


async def lines_while_publishing(output, *command, cwd=None, timeout_s=2 * PATIENCE_S):
    """What a program prints until it ends, while poses are offered."""
    pipe = asyncio.subprocess.PIPE
    process = await asyncio.create_subprocess_exec(*command, cwd=cwd, stdout=pipe, stderr=pipe)
    reading = asyncio.create_task(process.communicate())
    sequence = 0
    try:
        async with asyncio.timeout(timeout_s):
            while not reading.done():
                output.offer(frame(sequence))
                sequence += 1
                await asyncio.sleep(0.02)
    finally:
        if process.returncode is None:
            process.kill()
    out, error = await reading
    assert process.returncode == 0, error.decode()
    return out.decode().splitlines()


@pytest.fixture(scope="session")
def mqtt_js(tmp_path_factory):
    """A folder into which mqtt.js was installed as the examples say."""
    if shutil.which("npm") is None or shutil.which("node") is None:
        pytest.skip("node and npm are not installed")
    folder = tmp_path_factory.mktemp("node")
    command = [
        "npm",
        "install",
        "--prefix",
        str(folder),
        "--no-audit",
        "--no-fund",
        "--ignore-scripts",
        "mqtt@5",
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=110, check=False)
    if done.returncode:
        pytest.skip(f"mqtt.js cannot be installed here: {done.stderr.strip().splitlines()[-1:]}")
    return folder


async def test_python_subscriber(mosquitto, until):
    async with MqttOutput(MqttSettings(port=mosquitto.port), SKELETON, INFO) as output:
        await until(lambda: output.is_connected)
        script = str(EXAMPLES / "python" / "subscribe.py")
        command = [sys.executable, script, "--port", str(mosquitto.port), "--count", "3"]
        lines = await lines_while_publishing(output, *command)
    assert lines[0] == "lab is online"
    assert len(lines) == 4
    assert "pelvis +0°" in lines[1]


def test_python_subscriber_without_a_broker(unused_port):
    command = [sys.executable, str(EXAMPLES / "python" / "subscribe.py"), "--port", str(unused_port)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=2 * PATIENCE_S, check=False)
    assert done.returncode == 1
    assert done.stderr.startswith(f"no broker at 127.0.0.1:{unused_port}")


async def test_node_subscriber(mosquitto, mqtt_js, until):
    settings = MqttSettings(port=mosquitto.port, protocol="5")
    shutil.copy(EXAMPLES / "node" / "subscribe.mjs", mqtt_js)
    async with MqttOutput(settings, SKELETON, INFO) as output:
        await until(lambda: output.is_connected)
        command = ["node", "subscribe.mjs", f"mqtt://127.0.0.1:{mosquitto.port}", "3", "5"]
        lines = await lines_while_publishing(output, *command, cwd=mqtt_js)
    assert len(lines) == 3  # however many come at once
    topic, content_type, _, root, q = lines[0].split(" ", 4)
    assert (topic, content_type, root) == ("mocap/lab/pose", "application/json", "pelvis")
    np.testing.assert_allclose(json.loads(q), SKELETON.neutral, atol=1e-6)


def test_every_example_receives_the_demo(mqtt_js, command):
    """As the page of the examples says: against ``demo --keep``, over MQTT and over a WebSocket."""
    port, websocket_port = free_port(), free_port()
    options = ("--rig", "robot_arm_4", "--reconstructor", "independent", "--no-page")
    ports = ("--port", port, "--websocket-port", websocket_port)
    demo = command("demo", "--keep", *options, *ports)
    demo.until_said("pose ")
    shutil.copy(EXAMPLES / "node" / "subscribe.mjs", mqtt_js)
    node = ["node", str(mqtt_js / "subscribe.mjs")]
    python = [sys.executable, str(EXAMPLES / "python" / "subscribe.py"), "--port", str(port), "--count", "2"]
    for typed in (
        [*node, f"mqtt://127.0.0.1:{port}", "2"],
        [*node, f"ws://127.0.0.1:{websocket_port}", "2"],
        python,
    ):
        done = subprocess.run(typed, capture_output=True, text=True, timeout=2 * PATIENCE_S, check=False)
        assert done.returncode == 0, done.stderr
        assert "demo" in done.stdout
    demo.send_signal(signal.SIGINT)  # it ends the emulated suit, too
    demo.wait()


RAW_NODE = """import mqtt from "mqtt";
const client = mqtt.connect(process.argv[2], { protocolVersion: 5 });
client.subscribe("mocap/+/pose");
client.on("message", (topic, payload) => {
  console.log(payload.toString());
  client.end(true);
  process.exit(0);
});
"""


def assert_poses(lines, count):
    """Each line is a pose as the published schema says."""
    schema = json.loads((EXAMPLES.parent / "docs" / "mqtt" / "schemas" / "PoseMessage.json").read_text())
    assert len(lines) == count
    for line in lines:
        pose = json.loads(line)
        jsonschema.validate(pose, schema)
        np.testing.assert_allclose(pose["segments"]["pelvis"], SKELETON.neutral, atol=1e-6)


async def test_mosquitto_sub_receives_what_the_schema_says(mosquitto, until):
    program = shutil.which("mosquitto_sub")
    if program is None:
        pytest.skip("mosquitto_sub is not installed (apt install mosquitto-clients)")
    async with MqttOutput(MqttSettings(port=mosquitto.port), SKELETON, INFO) as output:
        await until(lambda: output.is_connected)
        command = [program, "-h", "127.0.0.1", "-p", str(mosquitto.port), "-t", "mocap/+/pose", "-C", "2"]
        assert_poses(await lines_while_publishing(output, *command), 2)


async def test_mqtt_js_receives_what_the_schema_says(mosquitto, mqtt_js, until):
    (mqtt_js / "raw.mjs").write_text(RAW_NODE)
    settings = MqttSettings(port=mosquitto.port, protocol="5")
    async with MqttOutput(settings, SKELETON, INFO) as output:
        await until(lambda: output.is_connected)
        command = ["node", "raw.mjs", f"mqtt://127.0.0.1:{mosquitto.port}"]
        assert_poses(await lines_while_publishing(output, *command, cwd=mqtt_js), 1)


async def test_browser_page(mosquitto, mqtt_js, unused_port, until, chromium):
    playwright = pytest.importorskip("playwright.async_api", reason="playwright is not installed")
    mosquitto.configure(f"listener {unused_port} 127.0.0.1\nprotocol websockets")
    mosquitto.restart()
    for name in ("index.html", "poses.js"):
        shutil.copy(EXAMPLES / "browser" / name, mqtt_js)
    handler = functools.partial(_Quiet, directory=str(mqtt_js))
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    page_url = f"http://127.0.0.1:{server.server_address[1]}/?broker=ws://127.0.0.1:{unused_port}"
    async with (
        MqttOutput(MqttSettings(port=mosquitto.port), SKELETON, INFO) as output,
        playwright.async_playwright() as play,
    ):
        await until(lambda: output.is_connected)
        browser = await play.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        page = await browser.new_page()
        outside = []
        page.on("request", lambda request: outside.append(request.url))
        await page.goto(page_url)
        offering = asyncio.create_task(_offer_for_ever(output))
        await page.get_by_text("lab: online").wait_for(timeout=1000 * PATIENCE_S)
        await page.get_by_role("row", name="left_hand").get_by_text("0.707, 0.707, 0.000, 0.000").wait_for()
        assert await page.get_by_text("measured").count() == SKELETON.n_segments
        offering.cancel()
        await page.locator("body.stale").wait_for(timeout=1000 * PATIENCE_S)
        await browser.close()
    server.shutdown()
    assert all("127.0.0.1" in url for url in outside)


async def _offer_for_ever(output):
    sequence = 0
    while True:
        output.offer(frame(sequence))
        sequence += 1
        await asyncio.sleep(0.02)


class _Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *_):
        """Nothing."""


def test_node_red_flow_is_wired_bends_and_asks_the_gateway_that_it_hears():
    flow = json.loads((EXAMPLES / "node_red" / "flow.json").read_text())
    nodes = {node["id"]: node for node in flow}
    assert len(nodes) == len(flow)
    for node in flow:
        assert all(target in nodes for wires in node.get("wires", []) for target in wires)
        assert node.get("broker", "mocap_broker") in nodes or node["type"] == "mqtt-broker"
        assert node.get("z", "mocap_tab") in nodes
    node = shutil.which("node")
    if node is None:
        pytest.skip("node is not installed")
    assert nodes["mocap_broker"]["protocolVersion"] == "4"  # which all brokers speak
    assert nodes["mocap_ask"]["topic"] == ""  # that of the message
    poses = {"upright": SKELETON.neutral, "lying": [1.0, 0, 0, 0], "missing": None}
    payloads = {
        k: {"segments": {"thorax": None if q is None else list(map(float, q))}} for k, q in poses.items()
    }
    program = f"""
    const kept = {{}}, warned = [], out = {{}};
    const flow = {{ get: (name) => kept[name], set: (name, value) => {{ kept[name] = value; }} }};
    const node = {{ warn: (text) => warned.push(text) }};
    const bow = new Function("msg", "flow", "node", {json.dumps(nodes["mocap_bow"]["func"])});
    const address = new Function("msg", "flow", "node", {json.dumps(nodes["mocap_address"]["func"])});
    out.early = [address({{}}, flow, node), warned.length];
    for (const [name, payload] of Object.entries({json.dumps(payloads)}))
      out[name] = bow({{topic: "mocap/demo/pose", payload}}, flow, node)?.payload ?? null;
    out.asked = address({{}}, flow, node).topic;
    console.log(JSON.stringify(out));"""
    done = subprocess.run(
        [node, "-e", program], capture_output=True, text=True, timeout=PATIENCE_S, check=True
    )
    asked = "mocap/demo/bridge/request/recording/start"
    assert json.loads(done.stdout) == {
        "early": [None, 1], "upright": 0, "lying": 90, "missing": None, "asked": asked
    }  # fmt: skip


async def test_vmc_receiver(unused_port):
    side = SideOutputs(OutputsSettings(vmc={"port": unused_port}), SKELETON, "lab", 100.0)
    script = str(EXAMPLES / "vmc" / "receive_vmc.py")
    command = [sys.executable, script, "--port", str(unused_port), "--count", "3"]
    async with side.running():
        lines = await lines_while_publishing(side, *command)
    assert lines[0] == f"listening on {unused_port}"
    assert lines[1].startswith("17 bones, hips at +0.00 +0.9")


def blender_example():
    spec = importlib.util.spec_from_file_location("blender_vmc", EXAMPLES / "vmc" / "blender_vmc.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


async def test_blender_reads_what_the_gateway_sends(unused_port, until):
    blender = blender_example()
    receiver = blender.listen(unused_port)
    side = SideOutputs(OutputsSettings(vmc={"port": unused_port}), SKELETON, "lab", 100.0)
    q_wb = t_pose(SKELETON)
    async with side.running():
        side.offer(frame(0, q_wb))
        await until(lambda: side.counters["vmc"].published == 1)
    seen = {}
    blender.apply = lambda armature, name, values: seen.update({name: values})
    assert blender.step(receiver, None) == blender.INTERVAL_S
    receiver.close()
    positions, rotations = AvatarPoses(SKELETON).update(frame(0, q_wb))
    assert len(seen) == 17
    np.testing.assert_allclose(seen["Hips"], [*positions[0], *rotations[0]], atol=1e-6)


def test_blender_axes_are_a_turn_away_from_ours():
    """An avatar that faces north here faces -y there: ENU turned by half a turn about the vertical."""
    from gateway.outputs.unity import unity_rotation, unity_vector  # noqa: PLC0415

    blender = blender_example()
    v, q = np.array([1.0, 2.0, 3.0]), np.array([0.5, 0.1, -0.7, 0.4])
    np.testing.assert_allclose(blender.blender_vector(*unity_vector(v)), [-1, -2, 3])
    np.testing.assert_allclose(blender.blender_rotation(*unity_rotation(q)), [0.5, -0.1, 0.7, 0.4])


def test_every_example_is_in_the_guide():
    guide = (EXAMPLES / "README.md").read_text()
    for folder in filter(os.path.isdir, EXAMPLES.iterdir()):
        for file in filter(Path.is_file, folder.rglob("*")):
            assert file.name in guide or file.suffix == ".pyc", file
