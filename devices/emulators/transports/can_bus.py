"""A CAN bus of python-can: the ``virtual`` one within a process, or any other interface."""

from __future__ import annotations

import asyncio
from collections import deque
from typing import Any

import can

from devices.emulators.transports.transport import OnReceive, ignore
from devices.link import Framing
from devices.links.can_link import frame_of, message_of
from firmware_protocol import CanFrame, pack_can_records, unpack_can_records

_POLL_INTERVAL_S = 0.002


class CanBusTransport:
    """Sends CAN frames on a bus, and receives those of others."""

    framing = Framing.CAN

    def __init__(self, channel: str, interface: str = "virtual", **bus_options: Any) -> None:
        """Prepare a bus; ``bus_options`` go to ``can.Bus``, for instance ``fd=True`` on SocketCAN."""
        self._options = {"channel": channel, "interface": interface, **bus_options}
        self._bus: can.BusABC | None = None
        self._rest: deque[CanFrame] = deque()
        self._on_receive: OnReceive = ignore
        self._poller: asyncio.Task[None] | None = None

    @property
    def url(self) -> str:
        """Where a host finds it, as a ``url`` of its configuration; empty while closed."""
        flags = "?fd=1" if self._options.get("fd") else ""
        channel, interface = self._options["channel"], self._options["interface"]
        return f"can://{interface}/{channel}{flags}" if self._bus is not None else ""

    async def open(self) -> None:
        """Join the bus. Raises ``can.CanError`` when that is not possible."""
        self._bus = can.Bus(**self._options)
        self._poller = asyncio.create_task(self._keep_polling(self._bus))

    def offer(self, data: bytes) -> bool:
        """Send CAN records; refused while frames of the records before still wait."""
        if self._bus is None or not self._flush():
            return False
        self._rest.extend(unpack_can_records(data))
        self._flush()
        return True

    def listen(self, on_receive: OnReceive) -> None:
        """Hand the frames of others to a callback, as CAN records."""
        self._on_receive = on_receive

    async def close(self) -> None:
        """Leave the bus."""
        if self._poller is not None:
            self._poller.cancel()
            self._poller = None
        if self._bus is not None:
            self._bus.shutdown()
            self._bus = None
        self._rest.clear()

    async def _keep_polling(self, bus: can.BusABC) -> None:
        while True:
            frames: list[CanFrame] = []
            while (message := bus.recv(timeout=0)) is not None:
                frames.append(frame_of(message))
            if frames:
                self._on_receive(pack_can_records(frames))
            await asyncio.sleep(_POLL_INTERVAL_S)

    def _flush(self) -> bool:
        assert self._bus is not None
        while self._rest:
            try:
                self._bus.send(message_of(self._rest[0]), timeout=0)
            except can.CanError:  # the interface's buffer is full
                return False
            self._rest.popleft()
        return True
