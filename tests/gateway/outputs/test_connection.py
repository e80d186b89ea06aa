"""Connections to a broker that are given up while they are being made."""

import asyncio
import logging
import socket
import time

import pytest

from gateway.outputs import MqttSettings
from gateway.outputs.connection import broker_connection


async def test_an_attempt_given_up_while_it_connects_leaves_no_word_and_no_socket(
    caplog: pytest.LogCaptureFixture,
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:
        silent.settimeout(10)
        port = silent.getsockname()[1]

        async def attempt() -> None:
            async with broker_connection(MqttSettings(port=port), port, "given-up"):
                pass

        connecting = asyncio.create_task(attempt())
        await asyncio.sleep(0)  # the thread that connects has been sent off
        connecting.cancel()
        time.sleep(0.3)  # noqa: ASYNC251 - it connects while the loop is busy, which hears of a closed socket
        with pytest.raises(asyncio.CancelledError):
            await connecting
        await asyncio.sleep(0.05)
        suit_side, _ = silent.accept()
        with suit_side:
            suit_side.settimeout(10)
            while suit_side.recv(4096):
                pass  # the greeting, then the end: the socket is closed
    assert [record for record in caplog.records if record.levelno >= logging.WARNING] == []
