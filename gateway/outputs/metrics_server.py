"""``/metrics`` and ``/healthz`` over HTTP, in a thread.

What is served is gathered in the event loop that owns it. A loop that does not answer any more is what the
health check is there to find out.
"""

from __future__ import annotations

import asyncio
import json
import logging
import threading
from collections.abc import Callable
from concurrent.futures import TimeoutError as NoAnswer
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from types import TracebackType
from typing import Any, Self, TypeVar

from prometheus_client.exposition import choose_encoder

from gateway.errors import OutputError
from gateway.outputs.metrics import GatewayFigures, registry_of

log = logging.getLogger(__name__)

PATIENCE_S = 2.0
"""An event loop that takes longer to answer is stuck."""
_SLOWEST_CLIENT_S = 5.0

_Value = TypeVar("_Value")


class MetricsServer:
    """Serves what ``figures`` and ``health`` give. Belongs to one event loop.

    health: a JSON object with what stands in the way of poses, for people; the check itself is that the
    gateway answers. Raises ``OutputError`` on starting when the address cannot be listened at.
    """

    def __init__(
        self,
        host: str,
        port: int,
        figures: Callable[[], GatewayFigures],
        health: Callable[[], dict[str, Any]],
    ) -> None:
        self.port = port
        """Of the server; with 0 asked for, the one that was found free."""
        self._host = host
        self._figures = figures
        self._health = health
        self._server: ThreadingHTTPServer | None = None
        self._loop: asyncio.AbstractEventLoop | None = None

    async def __aenter__(self) -> Self:
        self._loop = asyncio.get_running_loop()
        handler = type("Handler", (_Handler,), {"owner": self})
        try:
            self._server = _Server((self._host, self.port), handler)
        except OSError as error:
            raise OutputError(
                f"metrics: cannot listen at {self._host}:{self.port} ({error.strerror}): give metrics.port "
                "a free port, or leave it out"
            ) from error
        self.port = self._server.server_address[1]
        threading.Thread(target=self._server.serve_forever, args=(0.1,), name="metrics", daemon=True).start()
        log.info("metrics at http://%s:%d/metrics", self._host, self.port)
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._server is not None:
            await asyncio.to_thread(self._server.shutdown)
            self._server.server_close()
            self._server = None

    def metrics(self, accept: str) -> tuple[str, bytes]:
        """Content type and text, in the format the client likes best. Raises ``NoAnswer``."""
        encode, content_type = choose_encoder(accept)
        return content_type, encode(registry_of(self._ask(self._figures)))

    def health(self) -> dict[str, Any]:
        """As the event loop has it. Raises ``NoAnswer``."""
        return self._ask(self._health)

    def _ask(self, question: Callable[[], _Value]) -> _Value:
        assert self._loop is not None

        async def answer() -> _Value:
            return question()

        return asyncio.run_coroutine_threadsafe(answer(), self._loop).result(PATIENCE_S)


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    block_on_close = False


class _Handler(BaseHTTPRequestHandler):
    owner: MetricsServer
    timeout = _SLOWEST_CLIENT_S

    def do_GET(self) -> None:
        """Answer; a method name of the standard library's."""
        path = self.path.partition("?")[0]
        try:
            if path == "/metrics":
                self._answer(HTTPStatus.OK, *self.owner.metrics(self.headers.get("Accept", "")))
            elif path == "/healthz":
                self._answer_json(HTTPStatus.OK, self.owner.health())
            else:
                self._answer_json(HTTPStatus.NOT_FOUND, {"error": "there are /metrics and /healthz"})
        except (NoAnswer, RuntimeError):
            stuck = {"status": "stuck", "error": f"the gateway has not answered for {PATIENCE_S:g} s"}
            self._answer_json(HTTPStatus.SERVICE_UNAVAILABLE, stuck)

    def log_message(self, format: str, *args: object) -> None:  # noqa: A002 - the library's name
        """A line of the log for every request, but for those who debug."""
        log.debug(format, *args)

    def _answer_json(self, status: HTTPStatus, content: dict[str, Any]) -> None:
        self._answer(status, "application/json", json.dumps(content).encode())

    def _answer(self, status: HTTPStatus, content_type: str, body: bytes) -> None:
        self.send_response(status)
        self.send_header("Content-Type", content_type)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)
