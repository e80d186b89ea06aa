"""How much a broker may send us: whoever may publish there decides how large and how many messages are."""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import Callable
from typing import Any

import aiomqtt

LARGEST_MESSAGE = 1 << 20
"""Bytes; as in the shipped configuration of mosquitto. Poses of 60 segments with everything have 30 kB."""
LARGEST_INBOX = 16 << 20
"""Bytes of messages that wait to be read."""
MOST_MESSAGES = 1000

_log = logging.getLogger(__name__)


class Inbox(asyncio.Queue[aiomqtt.Message]):
    """Messages that wait; full by their number, or by their bytes. aiomqtt drops what does not fit."""

    def __init__(self, maxsize: int = MOST_MESSAGES, on_full: Callable[[], None] | None = None) -> None:
        """on_full: told of every message that does not fit."""
        super().__init__(maxsize)
        self._bytes = 0
        self._on_full = on_full

    def put_nowait(self, item: aiomqtt.Message) -> None:
        """Raises ``QueueFull``."""
        size = _size(item)
        if self.full() or size > LARGEST_MESSAGE or self._bytes + size > LARGEST_INBOX:
            if self._on_full is not None:
                self._on_full()
            raise asyncio.QueueFull
        super().put_nowait(item)
        self._bytes += size

    def _get(self) -> aiomqtt.Message:
        item = super()._get()
        self._bytes -= _size(item)
        return item


def _size(message: aiomqtt.Message) -> int:
    payload = message.payload
    return len(payload) if isinstance(payload, bytes | bytearray | str) else 0


def refuse_huge_packets(client: Any) -> None:
    """Have a paho client hang up as soon as a packet says that it is huge, not when all of it has come.

    MQTT 3.1.1 has no way to tell the broker; a packet may have 256 MB.
    """
    read: Callable[..., Any] = client.loop_read

    def guarded(max_packets: int = 1) -> Any:
        result = read(max_packets)
        announced = client._in_packet["remaining_length"]
        if announced > LARGEST_MESSAGE + _LONGEST_HEAD:
            _log.warning(
                "the broker sends a message of %.1f MB, more than the %.1f MB that are read: hung up; "
                "let it refuse them (mosquitto: max_packet_size)",
                announced * 1e-6,
                LARGEST_MESSAGE * 1e-6,
            )
            client._sock_close()
            raise ConnectionError(f"a message of {announced} bytes")
        return result

    client.loop_read = guarded


_LONGEST_HEAD = 1 << 17
"""Bytes of topic and properties before a payload: two texts of 64 kB."""


class Allowance:
    """So many a second on average, and so many at once. Time is an argument, s."""

    def __init__(self, rate: float, burst: int) -> None:
        self._rate = rate
        self._burst = burst
        self._left = float(burst)
        self._at_s = -math.inf

    def takes(self, now_s: float) -> bool:
        """Whether one more is within it; it then counts."""
        gained = (now_s - self._at_s) * self._rate if math.isfinite(self._at_s) else 0.0
        self._left = min(float(self._burst), self._left + max(gained, 0.0))
        self._at_s = now_s
        if self._left < 1.0:
            return False
        self._left -= 1.0
        return True
