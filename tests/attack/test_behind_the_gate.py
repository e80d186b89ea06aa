"""The servers behind the page's gate, reached by who knows their ports."""

from __future__ import annotations

import asyncio
import contextlib
import importlib.metadata

import pytest
import websockets

from gateway.fleet.page import OverviewServer
from gateway.support.credentials import AccessToken
from gateway.viewer.gate import PASS_HEADER, Door, Gate
from tests.patience import PATIENCE_S

GATE_PASS = AccessToken("the-pass-of-this-very-test")


async def status_of(port: int, path: str = "/", *headers: str) -> str:
    """Return the first line of the answer to a GET."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    lines = (f"GET {path} HTTP/1.1", f"Host: 127.0.0.1:{port}", "Connection: close", *headers)
    writer.write("\r\n".join((*lines, "", "")).encode())
    async with asyncio.timeout(PATIENCE_S):
        line = await reader.readline()
    writer.close()
    return line.decode().partition(" ")[2].strip()


@pytest.fixture
def page():
    pytest.importorskip("viser", reason="the extra 'viewer' is not installed")
    from gateway.viewer.inner_page import served_behind_gate  # noqa: PLC0415 - needs the extra

    with served_behind_gate(GATE_PASS) as server:
        yield server.get_port()


FORGED = ((), (f"{PASS_HEADER}: ",), (f"{PASS_HEADER}: guessed",), (f"{PASS_HEADER}: a", f"{PASS_HEADER}: b"))


@pytest.mark.parametrize("headers", FORGED)
async def test_the_page_answers_its_gate_alone(page: int, headers: tuple[str, ...]):
    assert (await status_of(page, "/", *headers)).startswith("403")
    assert (await status_of(page, "/", f"{PASS_HEADER}: {GATE_PASS.reveal()}")).startswith("200")


async def test_a_web_page_that_tries_all_ports_cannot_press_the_buttons(page: int):
    with pytest.raises(websockets.InvalidStatus, match="403"):
        await websockets.connect(f"ws://127.0.0.1:{page}", origin="http://elsewhere.example")
    async with Gate("127.0.0.1", 0, page, Door(None), gate_pass=GATE_PASS) as gate:
        here = f"127.0.0.1:{gate.port}"
        async with websockets.connect(f"ws://{here}", origin=f"http://{here}"):
            pass
        with pytest.raises(websockets.InvalidStatus, match="403"):  # whoever shows a pass to the gate
            await websockets.connect(f"ws://{here}", additional_headers={PASS_HEADER: "guessed"})


@pytest.mark.parametrize(
    "message", [b"\x91" * 200_000, "x" * (1 << 20), b"", b"\xc1", b"\x81\xa4type\xa6NoSuch"]
)
async def test_a_message_that_nobody_understands_costs_a_line_and_that_connection(page: int, message, caplog):
    version = importlib.metadata.version("viser")
    wanted = {
        "additional_headers": {PASS_HEADER: GATE_PASS.reveal()},
        "subprotocols": [f"viser-v{version}"],
        "max_size": None,
    }
    async with websockets.connect(f"ws://127.0.0.1:{page}", **wanted) as connection:
        await connection.send(message)
        with contextlib.suppress(websockets.ConnectionClosed):
            async with asyncio.timeout(PATIENCE_S):
                while True:
                    await connection.recv()
    lines = [record for record in caplog.records if "connections" in record.name]
    assert "a browser was hung up on" in lines[0].getMessage()
    assert all(record.exc_info is None for record in lines)
    async with websockets.connect(f"ws://127.0.0.1:{page}", **wanted) as connection:
        await connection.recv()


@pytest.mark.parametrize("headers", FORGED)
async def test_the_overview_of_a_fleet_answers_its_gate_alone(headers: tuple[str, ...]):
    class NoBodies:
        def close(self) -> None: ...

    server = OverviewServer(list, NoBodies(), GATE_PASS)
    async with server, Gate("127.0.0.1", 0, server.port, Door(None), gate_pass=GATE_PASS) as gate:
        for path in ("/", "/fleet.json", "/body?gateway=lab"):
            assert (await status_of(server.port, path, *headers)).startswith("403")
        assert (await status_of(gate.port, "/fleet.json")).startswith("200")
