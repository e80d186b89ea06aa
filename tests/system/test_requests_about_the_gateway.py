"""``bridge/request/gateway/…``: info, health, reload; and what is wrong is answered."""

from __future__ import annotations

import asyncio

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
outputs: {{udp_json: {{port: {output_port}}}}}
"""


async def ask(settings, verb, **data):
    """The data of the answer, once the gateway is there."""
    async with asyncio.timeout(PATIENCE_S):
        while True:
            try:
                async with remote_suit(settings, family="gateway") as gateway:
                    return await gateway.perform(verb, data)
            except RequestError as error:
                if "online" not in str(error):
                    raise
            await asyncio.sleep(0.05)


async def test_info_health_and_reload(command, mosquitto, tmp_path, unused_port):
    config = tmp_path / "gateway.yaml"
    config.write_text(
        CONFIG.format(folder=tmp_path, port=mosquitto.port, rig="single", output_port=unused_port)
    )
    settings = MqttSettings(port=mosquitto.port)
    process = command("run", "-c", config)
    info = await ask(settings, "info")
    assert info["gateway"] == "lab"
    assert len(info["modules"]) == 1
    health = await ask(settings, "health")
    assert set(health["outputs"]) == {"udp_json"}
    with pytest.raises(RequestError, match=r"no request 'gateway/relaod' \(did you mean 'reload'\?\)"):
        await ask(settings, "relaod")
    with pytest.raises(RequestError, match="gateway/info: unknown setting 'x'"):
        await ask(settings, "info", x=1)

    good = config.read_text()
    config.write_text(good.replace("rig: single", "rig: singel"))
    with pytest.raises(RequestError, match="singel"):
        await ask(settings, "reload")
    assert len((await ask(settings, "info"))["modules"]) == 1

    config.write_text(good.replace("rig: single", "rig: robot_arm_4"))
    assert await ask(settings, "reload") == {"reloaded": True}
    async with asyncio.timeout(PATIENCE_S):
        while len((await ask(settings, "info"))["modules"]) == 1:
            await asyncio.sleep(0.05)
    assert process.returncode is None
    log = [orjson.loads(line)["message"] for line in process.errors.splitlines()]
    assert any("is not taken, the old one stays" in line for line in log)
    assert "configuration read anew" in log
