"""A small MQTT broker for the first run: ``python -m gateway.outputs.embedded_broker --port 1883``.

MQTT 3.1.1, loopback only, no passwords, nothing kept on disk. It prints ``listening <port>`` when
ready, or one line that says why not, and ends when its standard input closes.
"""

from __future__ import annotations

import argparse
import asyncio
import errno
import logging
import sys

from amqtt.adapters import StreamReaderAdapter, StreamWriterAdapter
from amqtt.broker import Broker
from amqtt.contexts import BrokerConfig, ListenerConfig, ListenerType
from amqtt.errors import BrokerError
from amqtt.session import Session

HOST = "127.0.0.1"

_FAREWELL_S = 0.1
"""Time for the last messages to reach their subscribers."""


def broker_config(websocket_port: int | None = None) -> BrokerConfig:
    """Anonymous clients, no ``$SYS`` messages, no packet log (amqtt's defaults have both)."""
    # "external": the sockets are ours, so that a free port can be found and a busy one reported.
    listeners = {"default": ListenerConfig(type=ListenerType.EXTERNAL, bind=HOST)}
    if websocket_port is not None:
        listeners["websocket"] = ListenerConfig(type=ListenerType.WS, bind=f"{HOST}:{websocket_port}")
    return BrokerConfig(
        listeners=listeners,
        plugins={"amqtt.plugins.authentication.AnonymousAuthPlugin": {"allow_anonymous": True}},
    )


class _Broker(Broker):  # type: ignore[misc]  # it has no types
    """amqtt's, which sends whoever connects what is retained on topics that others have subscribed to."""

    async def _publish_retained_messages_for_subscription(
        self, subscription: tuple[str, int], session: Session
    ) -> None:
        holders = self._subscriptions.get(subscription[0], [])
        if any(holder is session for holder, _ in holders):
            await super()._publish_retained_messages_for_subscription(subscription, session)


async def serve(port: int, websocket_port: int | None) -> None:
    """Run the broker until standard input closes. Raises ``OSError`` when the port is taken."""
    broker = _Broker(broker_config(websocket_port))

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
    """One line: why the broker did not start, and what would do."""
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
    arguments = parser.parse_args()
    logging.disable(logging.ERROR)  # amqtt logs an error for every client that just hangs up
    try:
        asyncio.run(serve(arguments.port, arguments.websocket_port))
    except (OSError, BrokerError) as error:
        print(explain(error, arguments.port, arguments.websocket_port), flush=True)  # noqa: T201
        return 1
    except KeyboardInterrupt:
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
