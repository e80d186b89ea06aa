"""Connections that say nothing keep nobody from the page and the metrics."""

from __future__ import annotations

import asyncio
import contextlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.service import metrics_server
from gateway.service.metrics_server import MetricsServer
from gateway.support.crowd import Crowd, CrowdedError
from gateway.viewer import gate
from gateway.viewer.gate import Door, Gate
from tests.patience import PATIENCE_S


@contextlib.asynccontextmanager
async def page():
    async def serve(reader, writer):
        await reader.readuntil(b"\r\n\r\n")
        writer.write(b"HTTP/1.1 200 OK\r\nServer: page\r\n\r\nthe page")
        writer.close()

    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    async with server, Gate("127.0.0.1", 0, server.sockets[0].getsockname()[1], Door(None)) as opened:
        yield opened.port


@contextlib.asynccontextmanager
async def metrics():
    async with MetricsServer("127.0.0.1", 0, lambda: None, lambda: {"status": "ok"}) as server:
        yield server.port


async def asked(port, path):
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    writer.write(f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nConnection: close\r\n\r\n".encode())
    async with asyncio.timeout(PATIENCE_S):
        answer = await reader.read()
    writer.close()
    return answer


SERVERS = [(page, "/", gate), (metrics, "/healthz", metrics_server)]


@pytest.mark.parametrize(("serving", "path", "module"), SERVERS, ids=["page", "metrics"])
async def test_silent_connections_make_room(serving, path, module, monkeypatch):
    monkeypatch.setattr(module, "FIRST_REQUEST_S", 10 * PATIENCE_S)
    async with serving() as port:
        silent = [await asyncio.open_connection("127.0.0.1", port) for _ in range(2 * module.MOST_CLIENTS)]
        for _ in range(3):
            assert (await asked(port, path)).startswith((b"HTTP/1.1 200", b"HTTP/1.0 200"))
        oldest = silent[0][0]
        async with asyncio.timeout(PATIENCE_S):
            with contextlib.suppress(ConnectionError):
                assert await oldest.read() == b""  # its place was taken
        for _, writer in silent:
            writer.close()


@pytest.mark.parametrize(("serving", "_path", "module"), SERVERS, ids=["page", "metrics"])
async def test_who_says_nothing_is_soon_hung_up_on(serving, _path, module, monkeypatch):
    if module is metrics_server:
        monkeypatch.setattr(metrics_server._Handler, "timeout", 0.2)
    monkeypatch.setattr(module, "FIRST_REQUEST_S", 0.2)
    async with serving() as port:
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        async with asyncio.timeout(PATIENCE_S):
            assert await reader.read() == b""
        writer.close()


async def test_the_page_is_in_no_frame_of_another_site():
    async with page() as port:
        for path, status in (("/", b"200"), ("/ws", b"200")):
            head, _, body = (await asked(port, path)).partition(b"\r\n\r\n")
            assert head.split(b" ")[1] == status
            assert b"\r\nContent-Security-Policy: frame-ancestors 'none'\r\n" in head
            assert b"\r\nX-Frame-Options: DENY\r\n" in head
            assert head.endswith(b"Server: page")
            assert body == b"the page"


def test_a_flood_of_one_address_pushes_out_its_own():
    crowd = Crowd(8, 6)
    crowd.enter("early and slow", "10.0.0.1")
    for number in range(100):
        crowd.enter(number, "10.0.0.66")
    crowd.note_request("early and slow")
    assert len(crowd) == 8
    crowd.enter("late", "10.0.0.2")
    crowd.note_request("late")
    assert {"early and slow", "late"} <= set(crowd._active)


def test_one_address_does_not_take_all_places():
    crowd = Crowd(8, 6)
    for number in range(6):
        crowd.enter(number, "10.0.0.66")
        crowd.note_request(number)
    crowd.enter("seventh", "10.0.0.66")
    with pytest.raises(CrowdedError):
        crowd.note_request("seventh")
    crowd.leave("seventh")
    crowd.enter("another", "10.0.0.1")
    crowd.note_request("another")


def test_no_room_where_all_are_being_answered():
    crowd = Crowd(2, 2)
    for number in range(2):
        crowd.enter(number, f"10.0.0.{number}")
        crowd.note_request(number)
    with pytest.raises(CrowdedError):
        crowd.enter("third", "10.0.0.9")
    crowd.leave(0)
    assert crowd.enter("third", "10.0.0.9") is None


@given(st.lists(st.tuples(st.sampled_from("esl"), st.integers(0, 20))))
def test_never_more_than_there_is_room_for(steps):
    crowd = Crowd(4, 3)
    for step, visitor in steps:
        with contextlib.suppress(CrowdedError):
            if step == "e" and visitor not in crowd._active:
                crowd.enter(visitor, str(visitor % 3))
            elif step == "s":
                crowd.note_request(visitor)
            elif step == "l":
                crowd.leave(visitor)
        assert len(crowd) <= 4
        assert not crowd._silent.keys() & crowd._active.keys()
