"""A small MQTT broker for the first run: ``python -m gateway.outputs.embedded_broker --port 1883``.

MQTT 3.1.1, loopback only, no passwords, nothing kept on disk. It prints ``listening <port>`` when
ready, or one line that says why not, and ends when its standard input closes.

Every page that is open in a browser of this machine reaches loopback, wherever it came from. WebSocket
clients are therefore asked for more than programs that connect by TCP, which run on this machine:

* The page must be served by this machine, or from an origin that was named; the broker must be addressed as
  this machine, not by a name that was made to point here.
* They listen; to publish, they show the token as their password, for wills and retained messages too.
"""

from __future__ import annotations

import argparse
import asyncio
import errno
import logging
import sys
from collections.abc import Collection
from typing import Any

from amqtt.adapters import (
    ReaderAdapter,
    StreamReaderAdapter,
    StreamWriterAdapter,
    WebSocketsReader,
    WriterAdapter,
)
from amqtt.broker import Broker
from amqtt.contexts import BrokerConfig, ListenerConfig, ListenerType
from amqtt.errors import BrokerError
from amqtt.session import Session

from gateway.outputs.settings import WEBSOCKET_TOKEN_VARIABLE
from gateway.support.credentials import AccessToken, CredentialError, leads_here, read_secret

HOST = "127.0.0.1"

_POLICY_VIOLATION = 1008
"""Why a WebSocket is closed: the number that RFC 6455 has for it."""

_FAREWELL_S = 0.1
"""Time for the last messages to reach their subscribers."""


def broker_config(websocket_port: int | None = None) -> BrokerConfig:
    """Return a configuration for anonymous clients, no ``$SYS`` messages, no packet log (amqtt's defaults
    have both)."""
    # "external": the sockets are ours, so that a free port can be found and a busy one reported.
    listeners = {"default": ListenerConfig(type=ListenerType.EXTERNAL, bind=HOST)}
    if websocket_port is not None:
        listeners["websocket"] = ListenerConfig(type=ListenerType.WS, bind=f"{HOST}:{websocket_port}")
    return BrokerConfig(
        listeners=listeners,
        plugins={"amqtt.plugins.authentication.AnonymousAuthPlugin": {"allow_anonymous": True}},
    )


def admits(hosts: Collection[str], origins: Collection[str], allowed: Collection[str]) -> bool:
    """Return whether a WebSocket with these ``Host`` and ``Origin`` headers may open; programs send no
    origin."""
    if len(hosts) != 1 or len(origins) > 1:
        return False
    origin = next(iter(origins), None)
    is_admitted = origin is None or leads_here(origin) or origin in allowed
    return is_admitted and leads_here(f"//{next(iter(hosts))}")


class _Broker(Broker):  # type: ignore[misc]  # it has no types
    """amqtt's, which sends whoever connects what is retained on topics that others have subscribed to, and
    has one rule for all that connect."""

    def __init__(self, config: BrokerConfig, token: AccessToken | None, origins: Collection[str]) -> None:
        """token: what WebSocket clients show to publish; None: none can. origins: see ``admits``."""
        super().__init__(config)
        self._token = token
        self._origins = origins

    async def ws_connected(self, websocket: Any, listener_name: str) -> None:
        """Take a connection from a page that may have one; close any other."""
        headers = websocket.request.headers
        if admits(headers.get_all("Host"), headers.get_all("Origin"), self._origins):
            await super().ws_connected(websocket, listener_name)
        else:
            await websocket.close(_POLICY_VIOLATION, "this page may not connect: see mqtt.websocket_origins")

    async def _initialize_client_session(
        self, reader: ReaderAdapter, writer: WriterAdapter, remote_address: str, remote_port: int
    ) -> tuple[Any, Session]:
        handler, session = await super()._initialize_client_session(
            reader, writer, remote_address, remote_port
        )
        has_token = self._token is not None and self._token.matches(session.password)
        session.may_publish = has_token or not isinstance(reader, WebSocketsReader)
        return handler, session

    # All that a client publishes, its will too, goes through these two.

    async def _broadcast_message(self, session: Session | None, *message: Any, **options: Any) -> None:
        if session is None or session.may_publish:
            await super()._broadcast_message(session, *message, **options)

    async def retain_message(self, source_session: Session | None, *message: Any, **options: Any) -> None:
        """Keep a retained message, unless its sender may only listen."""
        if source_session is None or source_session.may_publish:
            await super().retain_message(source_session, *message, **options)

    async def _publish_retained_messages_for_subscription(
        self, subscription: tuple[str, int], session: Session
    ) -> None:
        holders = self._subscriptions.get(subscription[0], [])
        if any(holder is session for holder, _ in holders):
            await super()._publish_retained_messages_for_subscription(subscription, session)


async def serve(
    port: int, websocket_port: int | None, token: AccessToken | None, origins: Collection[str]
) -> None:
    """Run the broker until standard input closes. Raises ``OSError`` when the port is taken."""
    broker = _Broker(broker_config(websocket_port), token, origins)

    async def take_client(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await broker.external_connected(StreamReaderAdapter(reader), StreamWriterAdapter(writer), "default")

    server = await asyncio.start_server(take_client, HOST, port)
    await broker.start()
    print(f"listening {server.sockets[0].getsockname()[1]}", flush=True)  # noqa: T201 - read by the parent
    await _end_of_input()
    await asyncio.sleep(_FAREWELL_S)
    server.close()
    await broker.shutdown()


async def _end_of_input() -> None:
    reader = asyncio.StreamReader()
    await asyncio.get_running_loop().connect_read_pipe(
        lambda: asyncio.StreamReaderProtocol(reader), sys.stdin
    )
    await reader.read()


def explain(error: Exception, port: int, websocket_port: int | None) -> str:
    """Return one line: why the broker did not start, and what would do."""
    cause = error.__cause__ or error
    if isinstance(cause, OSError) and cause.errno == errno.EADDRINUSE:
        taken = f"port {port}" if cause is error else f"WebSocket port {websocket_port}"
        return f"{taken} is taken: another broker may be running (broker: external), or choose another port"
    if isinstance(cause, PermissionError):
        return f"port {port} is not allowed to this user: choose one above 1023"
    return str(cause) or repr(cause)


def main() -> int:
    """Serve until the parent process closes our standard input; the exit code."""
    parser = argparse.ArgumentParser(description="MQTT broker on this machine, for a first run")
    parser.add_argument("--port", type=int, default=1883, help="0: any free port")
    parser.add_argument("--websocket-port", type=int, default=None)
    parser.add_argument("--websocket-origin", action="append", default=[])
    arguments = parser.parse_args()
    logging.disable(logging.ERROR)  # amqtt logs an error for every client that just hangs up
    try:
        text = read_secret(None, WEBSOCKET_TOKEN_VARIABLE, "")
        token = None if text is None else AccessToken(text)
        asyncio.run(serve(arguments.port, arguments.websocket_port, token, arguments.websocket_origin))
    except CredentialError as error:
        print(error, flush=True)  # noqa: T201
        return 1
    except (OSError, BrokerError) as error:
        print(explain(error, arguments.port, arguments.websocket_port), flush=True)  # noqa: T201
        return 1
    except KeyboardInterrupt:
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
