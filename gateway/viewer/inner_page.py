"""The page's own server, which answers the gate before it and nobody else.

It listens on loopback, where every program of this machine reaches it, and so does every page that is open in
one of its browsers: a page may open WebSockets to any port of this machine. That the port is not published
does not keep them out, since all ports can be tried.
"""

from __future__ import annotations

import contextlib
import io
import logging
from collections.abc import Callable, Iterator
from http import HTTPStatus
from typing import Any

import viser
import websockets.asyncio.server

from gateway.support.credentials import AccessToken
from gateway.viewer.gate import PASS_HEADER

_LOOPBACK = "127.0.0.1"


@contextlib.contextmanager
def served_behind_gate(gate_pass: AccessToken) -> Iterator[viser.ViserServer]:
    """Serve a page on a free port of loopback; every request without ``gate_pass`` is refused.

    Raises ``RuntimeError`` where the library starts its server in a way that would let everybody in.
    """
    started: list[bool] = []
    serve = websockets.asyncio.server.serve

    def guarded(*args: Any, process_request: Callable[..., Any] | None = None, **options: Any) -> Any:
        def admit(connection: Any, request: Any) -> Any:
            if not gate_pass.matches(", ".join(request.headers.get_all(PASS_HEADER))):
                return connection.respond(HTTPStatus.FORBIDDEN, "the page is served through its gate only\n")
            return process_request(connection, request) if process_request else None

        started.append(True)
        return serve(*args, process_request=admit, logger=_connections_log(), **options)

    # The library has no setting for who is let in, and looks its server up under this name when it starts.
    websockets.asyncio.server.serve = guarded  # type: ignore[misc,assignment]
    try:
        with _silence():
            server = viser.ViserServer(_LOOPBACK, 0, label="mocap-gateway", verbose=False)
    finally:
        websockets.asyncio.server.serve = serve  # type: ignore[misc]
    try:
        if not started:
            raise RuntimeError("this version of viser starts its server in a way that cannot be guarded")
        yield server
    finally:
        with _silence():
            server.stop()


def _connections_log() -> logging.Logger:
    """Return a log in which a message that nobody understands is a line, and not all that led to it: whoever
    is let in could fill a disk with these."""
    log = logging.getLogger(f"{__name__}.connections")
    log.addFilter(_in_a_line)
    return log


def _in_a_line(record: logging.LogRecord) -> bool:
    if record.exc_info and record.exc_info[1] is not None:
        error = record.exc_info[1]
        record.msg = f"a browser was hung up on, for what it sent ({type(error).__name__})"
        record.args, record.exc_info = (), None
        record.levelno, record.levelname = logging.WARNING, "WARNING"
    return True


def _silence() -> contextlib.redirect_stdout[io.StringIO]:
    """Hold back what the library prints, such as the port behind the gate."""
    return contextlib.redirect_stdout(io.StringIO())
