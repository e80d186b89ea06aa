"""Ports of the loopback interface for servers that are about to start."""

from __future__ import annotations

import contextlib
import random
import socket

_PORTS = range(10_000, 32_000)
"""Below those that systems give to connections: until a server listens, no connection takes it."""


def free_port() -> int:
    """Return a port that is free, for TCP and UDP."""
    return free_ports(1)[0]


def free_ports(number: int) -> list[int]:
    """Return as many ports, no two of them the same, that are free for TCP and UDP."""
    found: list[int] = []
    while len(found) < number:
        # At random, so that two who ask at the same time hardly ever get the same one.
        port = random.SystemRandom().choice(_PORTS)
        if port not in found and _is_free(port):
            found.append(port)
    return found


def _is_free(port: int) -> bool:
    with (
        contextlib.suppress(OSError),
        socket.socket() as stream,
        socket.socket(type=socket.SOCK_DGRAM) as datagram,
    ):
        stream.bind(("127.0.0.1", port))
        datagram.bind(("127.0.0.1", port))
        return True
    return False
