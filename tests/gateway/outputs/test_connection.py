"""Connections to a broker that are given up while they are being made."""

import asyncio
import logging
import socket
import time

import pytest

from gateway.outputs.connection import broker_connection, end_tasks
from gateway.outputs.settings import MqttSettings


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
        time.sleep(0.3)  # noqa: ASYNC251 - it connects while the loop is busy, which learns of a closed socket
        with pytest.raises(asyncio.CancelledError):
            await connecting
        await asyncio.sleep(0.05)
        suit_side, _ = silent.accept()
        with suit_side:
            suit_side.settimeout(10)
            while suit_side.recv(4096):
                pass  # the greeting, then the end: the socket is closed
    assert [record for record in caplog.records if record.levelno >= logging.WARNING] == []


@pytest.mark.parametrize("first", ["answered", "given up"])
@pytest.mark.parametrize("answer", [b"", b"\x20\x02\x00\x05", b"\x20\x02\x00\x00"], ids=["none", "no", "yes"])
async def test_an_attempt_that_is_answered_while_it_is_given_up_leaves_no_word(
    caplog: pytest.LogCaptureFixture, answer: bytes, first: str
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as broker:
        broker.settimeout(10)
        port = broker.getsockname()[1]

        async def attempt() -> None:
            async with broker_connection(MqttSettings(port=port, protocol="3.1.1"), port, "given-up"):
                await asyncio.Event().wait()

        connecting = asyncio.create_task(attempt())
        broker_side, _ = await asyncio.to_thread(broker.accept)
        assert (await asyncio.to_thread(broker_side.recv, 4096))[:1] == b"\x10"
        if first == "given up":
            connecting.cancel()  # Python 3.11 passes it on a turn of the loop later, 3.12 at once
        broker_side.sendall(answer)
        broker_side.close()
        if first == "answered":
            await asyncio.sleep(0)  # the loop reads the answer right after this test's next words
        await end_tasks(connecting)
    assert [record for record in caplog.records if record.levelno >= logging.WARNING] == []
