"""A CAN controller of the kernel that is none: a SocketCAN link opens one end of a pair of sockets.

Frames and error frames go through it as the kernel packs them. What the kernel itself does with a bus
(bursts, full buffers, an interface set down) is tested on a real one: ``make test-socketcan``.
"""

from __future__ import annotations

import contextlib
import random
import socket
from collections.abc import Iterator
from unittest import mock

from devices.emulators.transports.transport import OnReceive
from devices.link import Framing
from devices.links import socketcan_link
from devices.links.socketcan_link import BusError
from firmware_protocol import CanFrame, unpack_can_records

CHANNEL = "can0"
_BUFFER_BYTES = 4 << 20
_ERROR_FRAMES = {
    BusError.OVERFLOW: CanFrame(0x004, bytes((0, 0x01, 0, 0, 0, 0, 0, 0)), is_extended=False, is_error=True),
    BusError.PASSIVE: CanFrame(0x004, bytes((0, 0x10, 0, 0, 0, 0, 0, 0)), is_extended=False, is_error=True),
    BusError.BUS_OFF: CanFrame(0x040, bytes(8), is_extended=False, is_error=True),
}
"""linux/can/error.h"""


class EmulatedBus:
    """A ``Transport`` of an emulated suit: its modules are on the bus that ``can0`` seems to be at."""

    framing = Framing.CAN
    url = f"can://socketcan/{CHANNEL}?fd=1"

    def __init__(self) -> None:
        self.loss = 0.0
        """Share of the frames that the controller does not take from the bus."""
        self.is_off = False
        self._socket: socket.socket | None = None
        self._rng = random.Random(1)

    @contextlib.contextmanager
    def in_place(self) -> Iterator[None]:
        """SocketCAN links that are opened meanwhile are at this bus."""
        with mock.patch.multiple(
            socketcan_link,
            open_can_socket=lambda _channel, _fd: self._connected(),
            has_carrier=lambda _channel: not self.is_off,
        ):
            yield

    def _connected(self) -> socket.socket:
        if self._socket is not None:
            self._socket.close()
        self._socket, gateways = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER_BYTES)
        for end in (self._socket, gateways):
            end.setblocking(False)
        return gateways

    async def open(self) -> None:
        """The modules are on the bus already."""

    def offer(self, data: bytes) -> bool:
        """Always taken: modules send whether the gateway's controller receives them or not."""
        for frame in unpack_can_records(data):
            if not self.is_off and self._rng.random() >= self.loss:
                self._pass_on(frame)
        return True

    def listen(self, on_receive: OnReceive) -> None:
        """Nothing comes: modules with the same clock rate as the gateway need not be asked for the time."""

    async def close(self) -> None:
        """The bus ends."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def report(self, error: BusError) -> None:
        """An error frame, as a controller's driver makes it; after bus-off it receives nothing."""
        self._pass_on(_ERROR_FRAMES[error])
        self.is_off = self.is_off or error is BusError.BUS_OFF

    def _pass_on(self, frame: CanFrame) -> None:
        """Lost where the gateway has no room for it, or has left."""
        if self._socket is not None:
            with contextlib.suppress(BlockingIOError, BrokenPipeError, ConnectionResetError):
                self._socket.send(socketcan_link.kernel_bytes(frame))
