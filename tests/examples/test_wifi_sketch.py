"""The wireless firmware example, compiled with a stand-in for the ESP32: several on one port."""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
from pathlib import Path

import pytest

from devices.udp_link import UdpLink
from gateway.body.rig import load_rig
from gateway.modules.journal import Journal
from gateway.modules.session import suit_session

REPOSITORY = Path(__file__).parents[2]
SKETCH = REPOSITORY / "examples" / "arduino" / "wifi_module"
STUBS = (Path(__file__).parent / "wifi_stub", Path(__file__).parent / "arduino_stub")
MODULES = (1, 5, 9)


@pytest.fixture(scope="module")
def program(tmp_path_factory):
    compiler = shutil.which("g++")
    if compiler is None:
        pytest.skip("g++ is not installed, so the sketch cannot be compiled")
    path = tmp_path_factory.mktemp("sketch") / "module"
    folders = [f"-I{folder}" for folder in (*STUBS, SKETCH, REPOSITORY / "firmware_protocol" / "c")]
    flags = ["-std=c++11", "-Wall", "-Wextra", "-Werror", "-fsanitize=address,undefined"]
    command = [compiler, *flags, *folders, str(STUBS[0] / "main.cpp"), "-o", str(path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=100, check=False)
    assert done.returncode == 0, done.stderr
    return path


async def free_port():
    probe = UdpLink()
    await probe.open()
    port = probe.address[1]
    await probe.close()
    return port


async def test_several_are_listed_and_one_of_them_is_found(program, tmp_path):
    port = await free_port()
    with contextlib.ExitStack() as stack:
        running = {}
        for module in MODULES:
            told = os.environ | {"MODULE": str(module), "PORT": str(port)}
            running[module] = subprocess.Popen(  # noqa: ASYNC220 - at once
                [program], env=told, stdout=subprocess.PIPE
            )
            stack.enter_context(running[module])
            stack.callback(running[module].kill)
        urls = {"wifi": f"udp://127.0.0.1:{port}?peers=127.0.0.0/8"}
        journal = Journal(tmp_path / "journal.json")
        async with suit_session(urls, load_rig("wifi_10"), allow_writes=False, journal=journal) as operations:
            listed = {
                module["module"]: module for module in (await operations.perform("list", {}))["modules"]
            }
            assert sorted(listed) == list(MODULES)
            assert all(module["unique_id"] for module in listed.values())
            assert all(module["rate_hz"] > 10 for module in listed.values())
            await operations.perform("identify", {"device": "5", "seconds": 60})
            health = operations.stream.modules[5].health
            assert health is not None
            assert health.rssi_dbm == -50
        assert running[5].stdout.readline() == b"shines\n"
        for process in running.values():
            process.kill()
        assert [running[module].stdout.read() for module in MODULES] == [b""] * len(MODULES)
