"""RFC 2217 links against pyserial's own server side."""

from __future__ import annotations

import socket
import threading

import pytest
import serial
from serial.rfc2217 import PortManager

from devices.free_ports import free_port
from devices.link import LinkError
from devices.links.rfc2217_link import Rfc2217Link


class SerialServer:
    """Serves one connection; the port behind it returns all that is written."""

    def __init__(self) -> None:
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        self.serial = serial.serial_for_url("loop://", timeout=0)
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        connection, _ = self._listener.accept()
        self._send_lock = threading.Lock()
        self._connection = connection
        manager = PortManager(self.serial, self)
        with connection:
            while data := connection.recv(4096):
                self.serial.write(b"".join(manager.filter(data)))
                if waiting := self.serial.read(self.serial.in_waiting):
                    self.write(b"".join(manager.escape(waiting)))

    def write(self, data: bytes) -> None:
        with self._send_lock:
            self._connection.sendall(data)

    def stop(self) -> None:
        self._connection.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self._thread.join(1)


@pytest.mark.filterwarnings("ignore::DeprecationWarning:serial.rfc2217")
async def test_bytes_pass_both_ways_and_the_loss_is_told(read_bytes):
    server = SerialServer()
    link = Rfc2217Link("127.0.0.1", server.port, baud=230_400, name="remote")
    await link.open()
    every_byte = bytes(range(256))
    await link.write(every_byte)
    assert await read_bytes(link, 256) == every_byte
    assert server.serial.baudrate == 230_400
    server.stop()
    with pytest.raises(LinkError, match="remote was lost"):
        await read_bytes(link, 1)
    with pytest.raises(LinkError, match="was lost"):
        await link.write(b"x")
    await link.close()


async def test_absent_server_is_told():
    port = free_port()
    with pytest.raises(LinkError, match="check that a serial server listens there"):
        await Rfc2217Link("127.0.0.1", port).open()
