"""A CAN bus of python-can: the ``virtual`` one within a process, or any other interface."""

from __future__ import annotations

from collections import deque
from typing import Any

import can

from devices.link import Framing
from firmware_protocol import CanFrame, unpack_can_records


class CanBusTransport:
    """Sends CAN frames on a bus."""

    framing = Framing.CAN

    def __init__(self, channel: str, interface: str = "virtual", **bus_options: Any) -> None:
        """bus_options: handed to ``can.Bus``, for instance ``fd=True`` on SocketCAN."""
        self._options = {"channel": channel, "interface": interface, **bus_options}
        self._bus: can.BusABC | None = None
        self._rest: deque[CanFrame] = deque()

    @property
    def url(self) -> str:
        flags = "?fd=1" if self._options.get("fd") else ""
        channel, interface = self._options["channel"], self._options["interface"]
        return f"can://{interface}/{channel}{flags}" if self._bus is not None else ""

    async def open(self) -> None:
        """Join the bus. Raises ``can.CanError`` when that is not possible."""
        self._bus = can.Bus(**self._options)

    def offer(self, data: bytes) -> bool:
        """Send CAN records; refused while frames of the records before still wait."""
        if self._bus is None or not self._flush():
            return False
        self._rest.extend(unpack_can_records(data))
        self._flush()
        return True

    async def close(self) -> None:
        """Leave the bus."""
        if self._bus is not None:
            self._bus.shutdown()
            self._bus = None
        self._rest.clear()

    def _flush(self) -> bool:
        assert self._bus is not None
        while self._rest:
            try:
                self._bus.send(_message(self._rest[0]), timeout=0)
            except can.CanError:  # the interface's buffer is full
                return False
            self._rest.popleft()
        return True


def _message(frame: CanFrame) -> can.Message:
    return can.Message(
        arbitration_id=frame.identifier,
        is_extended_id=frame.is_extended,
        is_fd=frame.is_fd,
        bitrate_switch=frame.bitrate_switch,
        is_remote_frame=frame.is_remote,
        is_error_frame=frame.is_error,
        data=frame.data,
    )
