"""A line on which something else than the suit speaks, or at another baud rate."""

from __future__ import annotations

import asyncio
import contextlib
import os
import pty
import random
import tty

import pytest
import yaml

pytestmark = pytest.mark.system


@contextlib.asynccontextmanager
async def babbling(port):
    """Random bytes come from ``port`` until the end."""
    ours, theirs = pty.openpty()
    tty.setraw(theirs)
    os.set_blocking(ours, False)
    port.symlink_to(os.ttyname(theirs))
    numbers = random.Random(1)

    async def babble():
        while True:
            with contextlib.suppress(BlockingIOError):
                os.write(ours, numbers.randbytes(100))
            with contextlib.suppress(BlockingIOError):
                os.read(ours, 1 << 16)
            await asyncio.sleep(0.02)

    speaking = asyncio.create_task(babble())
    yield
    speaking.cancel()
    await asyncio.gather(speaking, return_exceptions=True)
    os.close(ours)
    os.close(theirs)


async def test_a_link_of_which_nothing_can_be_read_is_named_once(tmp_path, command, unused_port):
    config = tmp_path / "gateway.yaml"
    config.write_text(
        yaml.safe_dump(
            {
                "links": [{"name": "suit", "url": str(tmp_path / "suit")}],
                "rig": "single",
                "reconstructor": "independent",
                "mqtt": {"broker": "embedded", "port": unused_port},
            }
        )
    )
    async with babbling(tmp_path / "suit"):
        gateway = command("run", "-c", config)
        await gateway.until_it_says("suit: bytes come, and no valid packet is among them")
        await gateway.until_it_says("packets received 0")
    assert gateway.errors.count("no valid packet is among them") == 1
