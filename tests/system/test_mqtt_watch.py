"""``watch`` as a script and a person see it."""

from __future__ import annotations

import asyncio
import io
import signal
import subprocess
import sys
from collections.abc import AsyncIterator
from typing import TYPE_CHECKING

import orjson
import pytest
from rich.console import Console

from gateway.cli.watch import Watch, watch_poses
from gateway.outputs import MqttSettings
from gateway.outputs.messages import PoseMessage
from gateway.outputs.mqtt import MqttOutput

if TYPE_CHECKING:
    from tests.conftest import Mosquitto, PoseSource

pytestmark = pytest.mark.system

WATCH = [sys.executable, "-c", "import typer; from gateway.cli.watch import watch; typer.run(watch)"]


@pytest.fixture
async def publishing(mosquitto: Mosquitto, pose_source: PoseSource) -> AsyncIterator[MqttSettings]:
    """A gateway that publishes at 100 Hz."""
    settings = MqttSettings(port=mosquitto.port)

    async def publish(output: MqttOutput) -> None:
        for sequence in range(10_000):
            output.offer(pose_source.frame(sequence))
            await asyncio.sleep(0.01)

    async with MqttOutput(settings, pose_source.skeleton, pose_source.info()) as output:
        publisher = asyncio.create_task(publish(output))
        yield settings
        publisher.cancel()


async def run(*options: str, port: int) -> tuple[int, str, str]:
    process = await asyncio.create_subprocess_exec(
        *WATCH, "--port", str(port), *options, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    output, errors = await asyncio.wait_for(process.communicate(), 10)
    assert process.returncode is not None
    return process.returncode, output.decode(), errors.decode()


async def test_once_prints_one_table(publishing: MqttSettings) -> None:
    text = io.StringIO()
    code = await watch_poses(publishing, Watch(count=1, timeout=5), Console(file=text, width=100))
    assert code == 0
    assert "lab" in text.getvalue()
    assert "segment_0 (root)" in text.getvalue()
    assert text.getvalue().count("measured") == 17


async def test_json_lines_are_the_messages(publishing: MqttSettings) -> None:
    code, output, errors = await run("--json", "--count", "3", port=publishing.port)
    assert (code, errors) == (0, "")
    poses = [PoseMessage.model_validate_json(line) for line in output.splitlines()]
    assert [pose.seq - poses[0].seq for pose in poses] == [0, 1, 2]
    assert list(orjson.loads(output.splitlines()[0]))[:2] == ["t_ns", "seq"]


async def test_silence_is_explained(mosquitto: Mosquitto, capsys: pytest.CaptureFixture[str]) -> None:
    settings = MqttSettings(port=mosquitto.port)
    code = await watch_poses(settings, Watch("lab", count=1, timeout=0.2), Console(file=io.StringIO()))
    assert code == 1
    assert "no pose on mocap/lab/pose within 0.2 s (no gateway known)" in capsys.readouterr().err


async def test_absent_broker_is_one_line(unused_port: int) -> None:
    code, output, errors = await run("--once", port=unused_port)
    assert (code, output) == (1, "")
    assert errors.count("\n") == 1
    assert "is mosquitto running?" in errors


async def test_live_table_ends_quietly_on_ctrl_c(publishing: MqttSettings) -> None:
    process = await asyncio.create_subprocess_exec(
        *WATCH, "--port", str(publishing.port), stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    await asyncio.sleep(1.2)
    process.send_signal(signal.SIGINT)
    output, errors = await asyncio.wait_for(process.communicate(), 5)
    assert (process.returncode, errors) == (0, b"")
    assert b"Hz" in output
