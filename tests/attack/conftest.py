"""What attackers have: sockets of strangers, and somebody to listen to."""

from __future__ import annotations

import socket
from collections.abc import Iterator

import pytest


@pytest.fixture
def stranger() -> Iterator[socket.socket]:
    """A datagram socket of nobody who is known."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as opened:
        opened.setblocking(False)
        yield opened
