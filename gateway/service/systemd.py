"""Reports to systemd how the service is: ready, alive, stopping (sd_notify(3), the datagram protocol).

Without systemd (no ``NOTIFY_SOCKET``) all of it does nothing.
"""

from __future__ import annotations

import asyncio
import os
import socket
from collections.abc import Callable

_PINGS_PER_TIMEOUT = 3.0


def notify(*assignments: str) -> bool:
    """Send ``READY=1`` and the like; True if systemd listens. Never raises."""
    address = os.environ.get("NOTIFY_SOCKET")
    if not address:
        return False
    if address.startswith("@"):
        address = "\0" + address[1:]  # a socket in the abstract name space
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as sender:
            sender.sendto("\n".join(assignments).encode(), address)
    except OSError:
        return False
    return True


def watchdog_interval_s() -> float | None:
    """Return how often to report that the service is alive; None where no watchdog is set."""
    microseconds, pid = os.environ.get("WATCHDOG_USEC", ""), os.environ.get("WATCHDOG_PID", "")
    if not microseconds.isdigit() or (pid and pid != str(os.getpid())):
        return None
    return int(microseconds) * 1e-6 / _PINGS_PER_TIMEOUT


async def feed_watchdog(can_flow: Callable[[], bool]) -> None:
    """Report that the service is alive for as long as data can flow; a hung loop or a dead task is silent.

    Ends at once where no watchdog is set.
    """
    interval_s = watchdog_interval_s()
    while interval_s is not None:
        if can_flow():
            notify("WATCHDOG=1")
        await asyncio.sleep(interval_s)
