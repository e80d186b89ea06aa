"""``watch`` as a script and a person see it."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import io
import os
import pty
import select
import signal
import subprocess
import sys
import termios
import time
from collections.abc import AsyncIterator
from typing import TYPE_CHECKING

import orjson
import pytest
from rich.console import Console

from gateway.cli.watch import Watch, watch_poses
from gateway.contract.messages import PoseMessage
from gateway.outputs.mqtt import MqttOutput
from gateway.outputs.settings import MqttSettings
from tests.patience import PATIENCE_S

if TYPE_CHECKING:
    from tests.fixtures.brokers import Mosquitto
    from tests.fixtures.poses import PoseSource

pytestmark = pytest.mark.system

WATCH = [sys.executable, "-c", "import typer; from gateway.cli.watch import watch; typer.run(watch)"]
HIDE_CURSOR, SHOW_CURSOR = b"\x1b[?25l", b"\x1b[?25h"


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
    output, errors = await asyncio.wait_for(process.communicate(), PATIENCE_S)
    assert process.returncode is not None
    return process.returncode, output.decode(), errors.decode()


def read_terminal(terminal: int, until: bytes | None = None) -> bytes:
    """What is shown, up to the wanted words, or to the end of the program that shows it."""
    shown, deadline = b"", time.monotonic() + PATIENCE_S
    while until is None or until not in shown:
        ready, _, _ = select.select([terminal], [], [], max(0.0, deadline - time.monotonic()))
        if not ready:
            pytest.fail(f"{until or 'the end'!r} has not come: {shown!r}")
        try:
            shown += os.read(terminal, 65536)
        except OSError as closed:  # Linux's end of file on a terminal
            if closed.errno != errno.EIO:
                raise
            assert until is None, shown
            return shown
    return shown


async def test_once_prints_one_table(publishing: MqttSettings) -> None:
    text = io.StringIO()
    code = await watch_poses(publishing, Watch(count=1, timeout=PATIENCE_S), Console(file=text, width=100))
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
    """On a terminal, as a person sees it: Ctrl-C ends the table, however late it came, with nothing said."""
    terminal, other_end = pty.openpty()
    termios.tcsetwinsize(other_end, (50, 120))
    process = await asyncio.create_subprocess_exec(
        *WATCH,
        *("--port", str(publishing.port)),
        stdin=other_end,
        stdout=other_end,
        stderr=subprocess.PIPE,
        env=os.environ | {"TERM": "xterm-256color"},
    )
    os.close(other_end)
    try:
        shown = await asyncio.to_thread(read_terminal, terminal, b" Hz")
        process.send_signal(signal.SIGINT)
        rest = asyncio.create_task(asyncio.to_thread(read_terminal, terminal))
        _, errors = await asyncio.wait_for(process.communicate(), PATIENCE_S)
        shown += await rest
    finally:
        with contextlib.suppress(ProcessLookupError):
            process.kill()
        os.close(terminal)
    assert (process.returncode, errors) == (0, b"")
    assert b"segment_0 (root)" in shown
    assert b"Traceback" not in shown
    assert shown.rindex(SHOW_CURSOR) > shown.rindex(HIDE_CURSOR)
