"""SlimeVR trackers as their owner meets them, in and out; what all makers have is in test_makers_modules."""

from __future__ import annotations

import asyncio
import json

import pytest
import yaml

from gateway.doctor.examination import examine_file
from gateway.doctor.findings import Surroundings, Verdict
from gateway.recording import open_recording
from tests.gateway.outputs.test_slimevr import StandInServer
from tests.patience import PATIENCE_S
from tests.system.test_makers_modules import configured, emulated, ended  # noqa: F401 - fixtures among them

pytestmark = pytest.mark.system


@pytest.fixture(autouse=True)
def _state_of_its_own(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))


def test_the_doctor_says_who_has_no_number_and_who_is_silent(emulated, configured):  # noqa: F811
    (link,) = emulated("slimevr", "udp")
    (key, module), *others = link["trackers"].items()
    link["trackers"] = dict(others) | {"192.168.77.7": module}
    found = list(examine_file(configured([link]), None, 2.0, Surroundings(usual_broker_ports=())))
    warned = [f for f in found if f.subject == "slimevr: settings"]
    assert {f.verdict for f in warned} == {Verdict.WARNING}
    assert any(key in f.found and f"'{key}': NUMBER" in f.remedy for f in warned)
    assert any(f"192.168.77.7 (module {module}) sends no orientations" in f.found for f in warned)


def test_the_magnetometer_is_switched_and_a_light_is_not(emulated, configured, command):  # noqa: F811
    config = configured(emulated("slimevr", "udp"))
    said = ended(command("modules", "set", 8, "magnetometer=true", "-c", config, "--allow-writes"))
    assert "magnetometer False → True" in said
    dark = command("modules", "identify", 8, "-c", config)
    assert dark.wait() == 1
    assert "shake it" in dark.errors
    wrong = command("modules", "set", 8, "magnetometr=true", "-c", config, "--allow-writes")
    assert wrong.wait() == 1
    assert "magnetometer" in wrong.errors


def test_trackers_that_look_for_a_server_are_found_with_one_line_for_all(command):
    emulate = command(
        "emulate", "--speaks", "slimevr", "--rig", "arm_3", "--on", "udp", "--port", 6969, "--json"
    )
    (link,) = json.loads(emulate.until_said('"links"'))["links"]
    (found,) = [
        each
        for each in yaml.safe_load(ended(command("modules", "discover", "--listen", 3)))
        if each["carries"] == "slimevr"
    ]
    assert found["trackers"].keys() == link["trackers"].keys()
    assert found["url"] == "udp://0.0.0.0:6969"


def test_they_speak_over_udp_alone(command):
    wrong = command("emulate", "--speaks", "slimevr", "--rig", "arm_3", "--on", "tcp")
    assert wrong.wait() == 1
    assert "--on udp" in wrong.errors


async def test_trackers_in_and_segments_out_to_a_server(emulated, configured, command, tmp_path):  # noqa: F811
    links = await asyncio.to_thread(emulated, "slimevr", "udp")
    _, server = await asyncio.get_running_loop().create_datagram_endpoint(
        StandInServer, local_addr=("127.0.0.1", 0)
    )
    config = configured(links, outputs={"slimevr": {"port": server.port}})
    gateway = command("record", "-c", config, "--folder", tmp_path, "--name", "out", "--quiet")
    async with asyncio.timeout(2 * PATIENCE_S):
        while len(server.rotations) < 3 or not server.batteries:
            await asyncio.sleep(0.1)
        seen = dict(server.rotations)
        while server.rotations == seen:
            await asyncio.sleep(0.1)
        server.ping(5)
        while server.pongs != [5]:
            await asyncio.sleep(0.05)
    server.transport.close()
    gateway.terminate()
    await asyncio.to_thread(gateway.wait)
    (recorded,) = tmp_path.glob("*out.mcap")
    sent = [item.data for item in open_recording(recorded).sent()]
    assert any(data.startswith(b"\x03Hey OVR") for data in sent)
    assert any(data[3] == 10 for data in sent)
    verified = await asyncio.to_thread(lambda: ended(command("replay", recorded, "--verify")))
    assert "identical" in verified
