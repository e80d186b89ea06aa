"""A mosquitto for one measurement, on a free port."""

from __future__ import annotations

import contextlib
import shutil
import socket
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from devices.free_ports import free_port

_START_S = 5.0


def mosquitto_program() -> str:
    """Return where mosquitto is installed. Raises ``SystemExit`` where it is not."""
    program = shutil.which("mosquitto") or shutil.which("mosquitto", path="/usr/sbin:/usr/local/sbin")
    if program is None:
        raise SystemExit("this suite needs mosquitto: apt install mosquitto")
    return program


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
