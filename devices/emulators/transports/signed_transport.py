"""Emulated modules that have a key: they sign what they send, and obey nothing that is not signed."""

from __future__ import annotations

from pathlib import Path
from urllib.parse import quote

from devices.emulators.transports.tcp_transport import TcpTransport
from devices.emulators.transports.transport import OnReceive
from devices.emulators.transports.udp_transport import UdpTransport
from devices.links.signed_link import read_key
from firmware_protocol import DELIMITER, RELAY
from firmware_protocol.signing import SignedFrames


class _Ends:
    """The signing end of each device: all begin at 0, as modules do that have no clock and store nothing."""

    def __init__(self, key_file: Path) -> None:
        """Read the key. Raises ``ValueError`` as ``read_key`` does."""
        self.parameter = f"?key_file={quote(str(key_file.absolute()))}"
        self._key = read_key(key_file)
        self._of_devices: dict[int | None, SignedFrames] = {}

    def of(self, device: int | None) -> SignedFrames:
        """Return the frames of a device by its number; None: of the one that sends for all."""
        number = RELAY if device is None else device
        return self._of_devices.setdefault(device, SignedFrames(self._key, signer=number + 1))


class SignedTcpTransport(TcpTransport):
    """The whole suit behind one connection, signed."""

    def __init__(self, key_file: Path, port: int = 0) -> None:
        """Prepare to listen, with a key. Raises ``ValueError`` as ``read_key`` does."""
        super().__init__(port)
        self._ends = _Ends(key_file)
        self._partial = b""

    @property
    def url(self) -> str:
        """As of a TCP transport, with the key's file."""
        return super().url and super().url + self._ends.parameter

    def offer(self, data: bytes) -> bool:
        """Sign and send the wire frames that this completes."""
        frames, delimiter, partial = (self._partial + data).rpartition(DELIMITER)
        if not super().offer(self._ends.of(None).sign(frames + delimiter)):
            return False
        self._partial = partial
        return True

    def listen(self, on_receive: OnReceive) -> None:
        """Hand on what the host signed."""
        super().listen(lambda data, device=None: on_receive(self._ends.of(None).feed(data), device))


class SignedUdpTransport(UdpTransport):
    """Each device from an address of its own, and as a signer of its own."""

    def __init__(self, key_file: Path, port: int, host: str = "127.0.0.1") -> None:
        """Prepare to send, with a key. Raises ``ValueError`` as ``read_key`` does."""
        super().__init__(port, host)
        self._ends = _Ends(key_file)

    @property
    def url(self) -> str:
        """As of a UDP transport, with the key's file."""
        return super().url and super().url + self._ends.parameter

    def offer_from(self, device: int | None, data: bytes) -> bool:
        """Sign the wire frames of a datagram and send it."""
        return super().offer_from(device, self._ends.of(device).sign(data))

    def listen(self, on_receive: OnReceive) -> None:
        """Hand on what the host signed."""
        super().listen(lambda data, device=None: on_receive(self._ends.of(device).open(data), device))
