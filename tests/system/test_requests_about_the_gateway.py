"""``bridge/request/gateway/…``: info, health, reload; and what is wrong is answered."""

from __future__ import annotations

import asyncio
import signal
import subprocess
import sys
import time

import orjson
import pytest

from gateway.modules.operations import RequestError
from gateway.modules.remote import remote_suit
from gateway.outputs.settings import MqttSettings
from tests.patience import PATIENCE_S

pytestmark = pytest.mark.system

CONFIG = """
gateway: lab
links: [{{name: suit, url: {folder}/absent}}]
rig: {rig}
reconstructor: independent
mqtt: {{port: {port}, protocol: "5"}}
outputs: {{udp_json: {{port: 39612}}}}
"""


@pytest.fixture
def gateway_process(mosquitto, tmp_path):
    """A gateway run from a configuration file: (process, file, settings of its broker)."""
    config = tmp_path / "gateway.yaml"
    config.write_text(CONFIG.format(folder=tmp_path, port=mosquitto.port, rig="single"))
    with (tmp_path / "log").open("w") as log:
        process = subprocess.Popen([sys.executable, "-m", "gateway", "run", "-c", str(config)], stderr=log)
    try:
        yield process, config, MqttSettings(port=mosquitto.port)
    finally:
        process.send_signal(signal.SIGTERM)
        process.wait(PATIENCE_S)


async def ask(settings, verb, **data):
    """The data of the answer, once the gateway is there."""
    deadline = time.monotonic() + 2 * PATIENCE_S
    while True:
        try:
            async with remote_suit(settings, family="gateway") as gateway, asyncio.timeout(10):
                return await gateway.perform(verb, data)
        except (RequestError, TimeoutError) as error:
            if time.monotonic() > deadline or ("online" not in str(error) and str(error)):
                raise
            await asyncio.sleep(0.2)


async def test_info_health_and_reload(gateway_process, tmp_path):
    process, config, settings = gateway_process
    info = await ask(settings, "info")
    assert info["gateway"] == "lab"
    assert len(info["modules"]) == 1
    health = await ask(settings, "health")
    assert set(health["outputs"]) == {"udp_json"}
    with pytest.raises(RequestError, match=r"no request 'gateway/relaod' \(did you mean 'reload'\?\)"):
        await ask(settings, "relaod")
    with pytest.raises(RequestError, match="gateway/info takes no data, not 'x'"):
        await ask(settings, "info", x=1)

    good = config.read_text()
    config.write_text(good.replace("rig: single", "rig: singel"))
    with pytest.raises(RequestError, match="singel"):
        await ask(settings, "reload")
    assert len((await ask(settings, "info"))["modules"]) == 1

    config.write_text(good.replace("rig: single", "rig: robot_arm_4"))
    assert await ask(settings, "reload") == {"reloaded": True}
    deadline = time.monotonic() + PATIENCE_S
    while len((await ask(settings, "info"))["modules"]) == 1:
        assert time.monotonic() < deadline
        await asyncio.sleep(0.2)
    assert process.poll() is None
    log = [orjson.loads(line)["message"] for line in (tmp_path / "log").read_text().splitlines()]
    assert any("is not taken, the old one stays" in line for line in log)
    assert "configuration read anew" in log
