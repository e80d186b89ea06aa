"""A tracker's end of the conversation with a SlimeVR server. Sans-I/O: time is an argument.

The tracker sends its handshake once a second until the server greets it; then features and what its sensors
are, these until they are acknowledged, and its data. It answers pings and heartbeats. A server that is silent
for three seconds is gone: the handshake begins again.
"""

from __future__ import annotations

from collections.abc import Sequence

from devices.vendor_protocols.slimevr import (
    BUNDLES,
    FromServer,
    Greeting,
    Handshake,
    Kind,
    SensorInfo,
    encode,
    encode_bundle,
    handshake,
    read_from_server,
    sensor_info,
)

RETRY_S, PATIENCE_S = 1.0, 3.0
LARGEST = 1472
"""Bytes of a datagram that a network takes whole."""
_FEATURES = b"\x04"
"""Of its own, bit 2: settings of sensors can be changed."""

Part = tuple[int, bytes]
"""Kind and payload of a message."""


class TrackerSession:
    """One tracker with its sensors."""

    def __init__(self, identity: Handshake, sensors: Sequence[SensorInfo]) -> None:
        self.is_connected = False
        """The server has greeted it, and its messages come."""
        self.connections = 0
        """Greetings so far."""
        self._identity = identity
        self.sensors = {sensor.sensor: sensor for sensor in sensors}
        """By number; one that is changed presents itself again."""
        self._acknowledged: dict[int, int] = {}
        self._features = 0
        self._number = 0
        self._received_s = self._requested_s = self._presented_s = float("-inf")

    def receive(self, datagram: bytes, now_s: float) -> list[bytes]:
        """Take what came from the server; return what to answer."""
        message = read_from_server(datagram)
        if message is None or not (self.is_connected or isinstance(message, Greeting)):
            return []
        self._received_s = now_s
        if isinstance(message, Greeting):
            self.connections += not self.is_connected
            self.is_connected = True
            return [self._datagram(Kind.FEATURES, _FEATURES)]
        return self._answer(message, datagram)

    @property
    def takes_bundles(self) -> bool:
        """Whether the server has said that it reads several messages from a datagram."""
        return bool(self._features & BUNDLES)

    def due(self, now_s: float) -> bytes | None:
        """Return a handshake, if one is to be sent by now."""
        if self.is_connected and now_s - self._received_s > PATIENCE_S:
            self.is_connected = False
        if self.is_connected or now_s - self._requested_s < RETRY_S:
            return None
        self._requested_s, self._presented_s = now_s, float("-inf")
        self._number = self._features = 0
        self._acknowledged.clear()
        return encode(Kind.HANDSHAKE, 0, handshake(self._identity))

    def presentations(self, now_s: float) -> list[Part]:
        """Return what is to be said of sensors by now: of each until it is acknowledged."""
        if not self.is_connected or now_s - self._presented_s < RETRY_S:
            return []
        self._presented_s = now_s
        return [
            (Kind.SENSOR_INFO, sensor_info(each))
            for each in self.sensors.values()
            if self._acknowledged.get(each.sensor) != each.state
        ]

    def data(self, parts: Sequence[Part]) -> list[bytes]:
        """Return messages as datagrams: in one, if the server takes bundles; none while it is away."""
        if not self.is_connected or not parts:
            return []
        if len(parts) == 1 or not self.takes_bundles:
            return [self._datagram(kind, payload) for kind, payload in parts]
        found, rest = [], list(parts)
        while rest:
            size, count = 12, 0
            # As many as one datagram holds: 6 bytes are the length and kind before each.
            while count < len(rest) and size + 6 + len(rest[count][1]) <= LARGEST:
                size += 6 + len(rest[count][1])
                count += 1
            self._number += 1
            found.append(encode_bundle(self._number, rest[:count]))
            rest = rest[count:]
        return found

    def _answer(self, message: FromServer, datagram: bytes) -> list[bytes]:
        if message.kind == Kind.PING:
            return [datagram]
        if message.kind == Kind.ROTATION:  # the server's heartbeat
            return [self._datagram(Kind.HEARTBEAT)]
        if message.kind == Kind.FEATURES:
            self._features = int.from_bytes(message.payload[:4], "little")
        elif message.kind == Kind.SENSOR_INFO and len(message.payload) == 2:
            self._acknowledged[message.payload[0]] = message.payload[1]
        return []

    def _datagram(self, kind: int, payload: bytes = b"") -> bytes:
        self._number += 1
        return encode(kind, self._number, payload)
