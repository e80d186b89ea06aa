"""A mosquitto for one measurement, on a free port."""

from __future__ import annotations

import contextlib
import random
import shutil
import socket
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

_START_S = 5.0
_PORTS = range(10_000, 32_000)
"""Below those that systems give to connections: until a server listens, no connection takes it."""


def mosquitto_program() -> str:
    """Return where mosquitto is installed. Raises ``SystemExit`` where it is not."""
    program = shutil.which("mosquitto") or shutil.which("mosquitto", path="/usr/sbin:/usr/local/sbin")
    if program is None:
        raise SystemExit("this suite needs mosquitto: apt install mosquitto")
    return program


def free_port() -> int:
    """Return a port of the loopback interface that is free, for TCP and UDP."""
    while True:
        # At random, so that tests which run at the same time hardly ever choose the same one.
        port = random.SystemRandom().choice(_PORTS)
        with (
            contextlib.suppress(OSError),
            socket.socket() as stream,
            socket.socket(type=socket.SOCK_DGRAM) as datagram,
        ):
            stream.bind(("127.0.0.1", port))
            datagram.bind(("127.0.0.1", port))
            return port


@contextlib.contextmanager
def mosquitto() -> Iterator[tuple[int, subprocess.Popen[bytes]]]:
    """Run a broker meanwhile; yield (port, process) once it listens."""
    program = mosquitto_program()
    port = free_port()
    with tempfile.TemporaryDirectory() as folder:
        config = Path(folder) / "mosquitto.conf"
        # Small messages at once: without it the system gathers them, and latency shows that instead.
        config.write_text(
            f"listener {port} 127.0.0.1\nallow_anonymous true\nset_tcp_nodelay true\nuser root\n"
        )
        broker = subprocess.Popen(
            [program, "-c", str(config)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        try:
            _await_listener(port)
            yield port, broker
        finally:
            broker.kill()
            broker.wait()


def _await_listener(port: int) -> None:
    deadline = time.monotonic() + _START_S
    while True:
        try:
            socket.create_connection(("127.0.0.1", port), timeout=1).close()
        except OSError:
            if time.monotonic() > deadline:
                raise SystemExit("mosquitto did not start") from None
            time.sleep(0.02)
        else:
            return
