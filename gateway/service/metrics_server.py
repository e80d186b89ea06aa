"""``/metrics`` and ``/healthz`` over HTTP, in a thread.

What is served is gathered in the event loop that owns it. A loop that does not answer any more is what the
health check is there to find out.

With a token, whoever does not show it (``Authorization: Bearer TOKEN``) gets no metrics, and of the health
the one word that a container's health check needs. Without one the same holds for whoever asks under a name
that is not this machine's: a page of another site, whose name is made to point here, reads nothing.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import socket
import threading
from collections.abc import Callable, Mapping
from concurrent.futures import TimeoutError as NoAnswer
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from io import BufferedIOBase
from types import TracebackType
from typing import Any, Self, TypeVar

from prometheus_client.exposition import choose_encoder

from gateway.errors import OutputError
from gateway.service.metrics import GatewayFigures, registry_of
from gateway.support.credentials import AccessToken, leads_here
from gateway.support.crowd import Crowd, CrowdedError

log = logging.getLogger(__name__)

PATIENCE_S = 2.0
"""An event loop that takes longer to answer is stuck."""
LONGEST_REQUEST_S = 5.0
"""From a client's connection to the end of the answer; it is hung up on then, wherever it is."""
LARGEST_HEAD = 16 * 1024
"""Bytes of a request."""
FIRST_REQUEST_S = 2.0
"""Longest silence of a client."""
MOST_CLIENTS = 16
"""At one time; for any more, the oldest that has not sent its request is disconnected."""
MOST_OF_ONE_ADDRESS = 12
"""Of those, with a request that is being answered."""

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
        token: AccessToken | None = None,
    ) -> None:
        self.token = token
        self.port = port
        """Of the server; with 0 asked for, the one that was found free."""
        self._host = host
        self._figures = figures
        self._health = health
        self._server: ThreadingHTTPServer | None = None
        self._loop: asyncio.AbstractEventLoop | None = None

    def bind(self) -> None:
        """Take the address, without answering yet; a second call does nothing. Raises ``OutputError``."""
        if self._server is not None:
            return
        # The standard library makes a handler from a class for each request: a subclass gives it the owner.
        handler = type("Handler", (_Handler,), {"owner": self})
        try:
            self._server = _Server((self._host, self.port), handler)
        except OSError as error:
            raise OutputError(
                f"metrics: cannot listen at {self._host}:{self.port} ({error.strerror}): give metrics.port "
                "a free port, or leave it out"
            ) from error
        self.port = self._server.server_address[1]

    def release(self) -> None:
        """Give back an address that was taken and never answered at."""
        if self._server is not None:
            self._server.server_close()
            self._server = None

    async def __aenter__(self) -> Self:
        self._loop = asyncio.get_running_loop()
        self.bind()
        assert self._server is not None
        threading.Thread(target=self._server.serve_forever, args=(0.1,), name="metrics", daemon=True).start()
        log.info("metrics at http://%s:%d/metrics", self._host, self.port)
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._server is not None:
            await asyncio.to_thread(self._server.shutdown)
            self.release()

    def metrics(self, accept: str) -> tuple[str, bytes]:
        """Return content type and text, in the format the client likes best. Raises ``NoAnswer``."""
        encode, content_type = choose_encoder(accept)
        return content_type, encode(registry_of(self._ask(self._figures)))

    def health(self) -> dict[str, Any]:
        """Return the health message, computed on the event loop. Raises ``NoAnswer`` if the loop does not
        answer.
        """
        return self._ask(self._health)

    def _ask(self, question: Callable[[], _Value]) -> _Value:
        assert self._loop is not None

        async def answer() -> _Value:
            return question()

        return asyncio.run_coroutine_threadsafe(answer(), self._loop).result(PATIENCE_S)


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    block_on_close = False

    def __init__(self, address: tuple[str, int], handler: type[BaseHTTPRequestHandler]) -> None:
        self.crowd: Crowd[socket.socket] = Crowd(MOST_CLIENTS, MOST_OF_ONE_ADDRESS)
        super().__init__(address, handler)

    def verify_request(self, request: Any, client_address: Any) -> bool:
        """Return whether there is a thread left for one more client; a method name of the standard
        library's."""
        try:
            silent = self.crowd.enter(request, str(client_address[0]))
        except CrowdedError:
            return False
        if silent is not None:
            _hang_up(silent)
        return True

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Answer one client, in a thread of its own; a method name of the standard library's."""
        deadline = threading.Timer(LONGEST_REQUEST_S, _hang_up, (request,))
        # A timer that is left must not keep the process from ending.
        deadline.daemon = True
        deadline.start()
        try:
            super().process_request_thread(request, client_address)
        finally:
            deadline.cancel()
            self.crowd.leave(request)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Log at debug level that a client has gone, in place of the traceback which the standard library
        prints.
        """
        log.debug("a client of the metrics went", exc_info=True)


def _hang_up(connection: socket.socket) -> None:
    with contextlib.suppress(OSError):  # it has ended meanwhile
        connection.shutdown(socket.SHUT_RDWR)


class _Head:
    """A request, line by line, up to ``LARGEST_HEAD``."""

    def __init__(self, connection: BufferedIOBase) -> None:
        self._connection = connection
        self._left = LARGEST_HEAD

    @property
    def is_too_long(self) -> bool:
        return self._left == 0

    def readline(self, limit: int) -> bytes:
        """Return the next line; nothing of what goes beyond."""
        line = self._connection.readline(min(limit, self._left))
        self._left -= len(line)
        return line

    def close(self) -> None:
        """Close the connection to the event loop's side."""
        self._connection.close()


class _Handler(BaseHTTPRequestHandler):
    owner: MetricsServer
    timeout = FIRST_REQUEST_S
    server: _Server
    server_version = "mocap-gateway"
    sys_version = ""

    def setup(self) -> None:
        """Bound what is read; a method name of the standard library's."""
        super().setup()
        self._head = _Head(self.rfile)
        self.rfile = self._head  # type: ignore[assignment]  # lines are all that is read of it

    def do_GET(self) -> None:
        """Answer; a method name of the standard library's."""
        path = self.path.partition("?")[0]
        try:
            self.server.crowd.note_request(self.connection)
            if self._head.is_too_long:
                error = f"a request has {LARGEST_HEAD} bytes at most"
                self._answer_json(HTTPStatus.REQUEST_HEADER_FIELDS_TOO_LARGE, {"error": error})
            elif path == "/metrics" and not self._may_read:
                self._refuse()
            elif path == "/metrics":
                self._answer(HTTPStatus.OK, *self.owner.metrics(self.headers.get("Accept", "")))
            elif path == "/healthz":
                # Whoever has no token learns whether the gateway is well, as a watchdog must, and nothing
                # else.
                health = self.owner.health()
                self._answer_json(HTTPStatus.OK, health if self._may_read else {"status": health["status"]})
            else:
                self._answer_json(HTTPStatus.NOT_FOUND, {"error": "there are /metrics and /healthz"})
        except CrowdedError:
            self._answer_json(
                HTTPStatus.SERVICE_UNAVAILABLE, {"error": "too many connections of this address"}
            )
        # An event loop that is blocked cannot say so itself: its silence is the answer.
        except (NoAnswer, RuntimeError):
            stuck = {"status": "stuck", "error": f"the gateway has not answered for {PATIENCE_S:g} s"}
            self._answer_json(HTTPStatus.SERVICE_UNAVAILABLE, stuck)

    def log_message(self, format: str, *args: object) -> None:  # noqa: A002 - the library's name
        """Log a request at debug level only: a scraper asks every few seconds."""
        log.debug(format, *args)

    @property
    def _may_read(self) -> bool:
        token = self.owner.token
        if token is None:
            hosts = self.headers.get_all("Host", [])
            return len(hosts) == 1 and leads_here(f"//{hosts[0]}")
        kind, _, shown = self.headers.get("Authorization", "").partition(" ")
        return kind.lower() == "bearer" and token.matches(shown.strip())

    def _refuse(self) -> None:
        if self.owner.token is None:
            why = "without a token (metrics.token_file) these are served as localhost and 127.0.0.1 only"
            self._answer_json(HTTPStatus.FORBIDDEN, {"error": why})
            return
        error = {"error": "a token is wanted: Authorization: Bearer TOKEN (metrics.token_file has it)"}
        self._answer(
            HTTPStatus.UNAUTHORIZED,
            "application/json",
            json.dumps(error).encode(),
            {"WWW-Authenticate": 'Bearer realm="mocap-gateway"'},
        )

    def _answer_json(self, status: HTTPStatus, content: dict[str, Any]) -> None:
        self._answer(status, "application/json", json.dumps(content).encode())

    def _answer(
        self, status: HTTPStatus, content_type: str, body: bytes, more: Mapping[str, str] | None = None
    ) -> None:
        self.send_response(status)
        self.send_header("Content-Type", content_type)
        for name, value in (more or {}).items():
            self.send_header(name, value)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)
