"""Who may read the metrics."""

from __future__ import annotations

import asyncio
import contextlib
import json
import urllib.error
import urllib.request

import pytest

from gateway.contract.messages import BridgeInfo
from gateway.service import metrics_server
from gateway.service.metrics import GatewayFigures
from gateway.service.metrics_server import MetricsServer
from gateway.support.credentials import AccessToken
from tests.patience import PATIENCE_S

TOKEN = "0123456789abcdef"
HEALTH = {"status": "degraded", "links_down": ["suit"]}


def figures():
    info = BridgeInfo(version="1", gateway="g", reconstructor="joint", frame_rate=100.0, modules=())
    return GatewayFigures(info, (), (), 7, {}, {}, {}, None)


async def get(port, path, authorization=None, host=None):
    def ask():
        headers = {} if authorization is None else {"Authorization": authorization}
        headers |= {} if host is None else {"Host": host}
        try:
            asked = urllib.request.Request(f"http://127.0.0.1:{port}{path}", headers=headers)
            with urllib.request.urlopen(asked, timeout=PATIENCE_S) as answer:
                return answer.status, answer.read().decode(), answer.headers
        except urllib.error.HTTPError as error:
            return error.code, error.read().decode(), error.headers

    return await asyncio.to_thread(ask)


@pytest.mark.parametrize(
    "shown", [None, "Bearer wrong-wrong-wrong", "Basic " + TOKEN, TOKEN, "Bearer " + TOKEN[:-1]]
)
async def test_without_the_token_one_word_of_health_and_no_metrics(shown):
    async with MetricsServer("127.0.0.1", 0, figures, lambda: HEALTH, AccessToken(TOKEN)) as server:
        status, text, headers = await get(server.port, "/metrics", shown)
        assert status == 401
        assert headers["WWW-Authenticate"].startswith("Bearer")
        assert "mocap_skeleton" not in text
        assert TOKEN not in text
        status, text, headers = await get(server.port, "/healthz", shown)
        assert (status, json.loads(text)) == (200, {"status": "degraded"})
        assert headers["Server"].strip() == "mocap-gateway"


@pytest.mark.parametrize("token", [None, AccessToken(TOKEN)])
async def test_with_the_token_all_of_it(token):
    async with MetricsServer("127.0.0.1", 0, figures, lambda: HEALTH, token) as server:
        status, text, _ = await get(server.port, "/metrics", f"Bearer {TOKEN}")
        assert status == 200
        assert "mocap_skeleton_frames_total 7.0" in text
        status, text, _ = await get(server.port, "/healthz", f"bearer {TOKEN}")
        assert (status, json.loads(text)) == (200, HEALTH)


@pytest.mark.parametrize("host", ["attacker.example", "attacker.example:9464", "192.168.0.7", "[", ""])
async def test_without_a_token_names_of_other_machines_get_one_word_of_health_and_no_metrics(host):
    async with MetricsServer("127.0.0.1", 0, figures, lambda: HEALTH) as server:
        status, text, _ = await get(server.port, "/metrics", host=host)
        assert status == 403
        assert "token_file" in text
        status, text, _ = await get(server.port, "/healthz", host=host)
        assert (status, json.loads(text)) == (200, {"status": "degraded"})


@pytest.mark.parametrize("host", ["localhost:9464", "127.0.0.1", "[::1]:9464", "LOCALHOST"])
async def test_without_a_token_names_of_this_machine_get_the_metrics(host):
    async with MetricsServer("127.0.0.1", 0, figures, lambda: HEALTH) as server:
        assert (await get(server.port, "/metrics", host=host))[0] == 200


async def test_with_a_token_any_name_does():
    async with MetricsServer("127.0.0.1", 0, figures, lambda: HEALTH, AccessToken(TOKEN)) as server:
        assert (await get(server.port, "/metrics", f"Bearer {TOKEN}", "suit.example"))[0] == 200


async def test_a_client_that_tells_its_request_byte_by_byte_is_hung_up_on(monkeypatch):
    monkeypatch.setattr(metrics_server, "LONGEST_REQUEST_S", 0.3)
    async with MetricsServer("127.0.0.1", 0, figures, lambda: HEALTH) as server:
        reader, writer = await asyncio.open_connection("127.0.0.1", server.port)

        async def drip():
            while True:
                writer.write(b"x")
                await asyncio.sleep(0.05)

        dripping = asyncio.create_task(drip())
        async with asyncio.timeout(PATIENCE_S):
            with contextlib.suppress(ConnectionError):
                assert await reader.read() == b""
        dripping.cancel()
        writer.close()
        monkeypatch.setattr(metrics_server, "LONGEST_REQUEST_S", PATIENCE_S)
        assert (await get(server.port, "/healthz"))[0] == 200


@pytest.mark.parametrize("head", [b"GET /%b HTTP/1.1\r\n\r\n", b"GET /metrics HTTP/1.1\r\nA: %b\r\n\r\n"])
async def test_a_request_that_is_too_long_is_not_read_to_its_end(head):
    async with MetricsServer("127.0.0.1", 0, figures, lambda: HEALTH) as server:
        reader, writer = await asyncio.open_connection("127.0.0.1", server.port)
        writer.write(head % (b"x" * metrics_server.LARGEST_HEAD))
        async with asyncio.timeout(PATIENCE_S):
            answer = b""
            with contextlib.suppress(ConnectionError):  # what was not read has it reset the connection
                while block := await reader.read(1000):
                    answer += block
        assert not answer or b"bytes at most" in answer
        writer.close()
