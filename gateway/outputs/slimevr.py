"""Segments as trackers of a SlimeVR server, from where they go to SteamVR and VR apps.

To the server the gateway is one tracker with a sensor a segment: it greets, presents its sensors, answers
pings and heartbeats, and sends rotations and accelerations in bundles. A sensor's axes are its segment's, its
reference is the world; how a tracker sits, and where it faces, the server finds by its own resets.
"""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import socket
from collections.abc import Callable

import numpy as np

from devices.vendor_protocols import slimevr as wire
from devices.vendor_protocols.slimevr import Battery, Handshake, Kind, SensorInfo
from devices.vendor_protocols.slimevr_tracker import Part, TrackerSession
from gateway.body.skeleton import Skeleton
from gateway.errors import OutputError, nearest
from gateway.frames import SkeletonFrame
from gateway.geometry import quaternion
from gateway.outputs.settings import SlimevrSettings

FIRMWARE = "mocap-gateway"
_CUSTOM_BOARD, _UNKNOWN_IMU = 4, 0
_SIDED = ("shoulder_girdle", "upper_arm", "forearm", "hand", "thigh", "shank", "foot")
KNOWN = (
    *("head", "neck", "thorax", "pelvis"),
    *(f"{side}_{segment}" for segment in _SIDED for side in ("left", "right")),
)
"""Segments that a server has a place for; others only where the configuration names them."""
_BATTERY_S = 5.0
_TICK_S = 0.25
_LARGEST = 2048


def sensors_of(skeleton: Skeleton, wanted: tuple[str, ...] | None) -> dict[int, str]:
    """Return the segments that are sent, by number of the sensor: their order in the body.

    Raises ``OutputError`` for a segment that the body has not, or a body of which none can be sent.
    """
    names = skeleton.segment_names
    for name in wanted or ():
        if name not in names:
            raise OutputError(
                f"outputs.slimevr.segments: body '{skeleton.name}' has no '{name}'{nearest(name, names)}"
            )
    chosen = [name for name in names if name in (KNOWN if wanted is None else wanted)]
    if not chosen or len(chosen) >= wire.ALL_SENSORS:
        raise OutputError(
            f"outputs.slimevr: body '{skeleton.name}' has {len(chosen)} segments to send: name them in "
            "outputs.slimevr.segments, 1 to 254"
        )
    return dict(enumerate(chosen))


class SlimevrSink:
    """One socket to one server. Belongs to one event loop; what a server is not there for is dropped."""

    def __init__(
        self, settings: SlimevrSettings, skeleton: Skeleton, gateway: str, battery: Callable[[], float | None]
    ) -> None:
        """battery: asked for the least charge of all modules, 0 to 1; None: not known. Raises
        ``OutputError`` as ``sensors_of``."""
        self._settings = settings
        self._battery = battery
        sensors = sensors_of(skeleton, settings.segments)
        self._rows = [skeleton.index(name) for name in sensors.values()]
        self._sensors = [SensorInfo(number, 1, _UNKNOWN_IMU, 0) for number in sensors]
        # of a range that nobody is given: two gateways are two trackers
        mac = "02" + hashlib.sha256(gateway.encode()).hexdigest()[:10]
        self._identity = Handshake(wire.VERSION, FIRMWARE, mac, _UNKNOWN_IMU, _CUSTOM_BOARD)
        self._socket: socket.socket | None = None
        self._ticking: asyncio.TimerHandle | None = None
        self._charge_due_s = 0.0
        self.session = TrackerSession(self._identity, self._sensors)

    async def open(self) -> None:
        """Find the server's address, and begin to look for it. Raises ``OutputError`` for an unknown host."""
        loop, host = asyncio.get_running_loop(), self._settings.host
        try:
            found = await loop.getaddrinfo(host, self._settings.port, type=socket.SOCK_DGRAM)
        except OSError as error:
            raise OutputError(
                f"outputs.slimevr: no such host '{host}' ({error.strerror}): correct host"
            ) from error
        family, kind, protocol, _, address = found[0]
        self._socket = socket.socket(family, kind, protocol)
        self._socket.setblocking(False)
        self._socket.connect(address)  # nobody else is heard
        self.session = TrackerSession(self._identity, self._sensors)
        self._charge_due_s = 0.0
        loop.add_reader(self._socket, self._receive)
        self._tick()

    def send(self, frame: SkeletonFrame) -> bool:
        """Send a frame; return whether the server is there and the system took it.

        Raises ``OSError``, such as for no network.
        """
        if not self.session.is_connected:
            return False
        parts: list[Part] = []
        for number, row in enumerate(self._rows):
            q_wb = frame.q_wb[row]
            if not np.isfinite(q_wb).all():
                continue
            w, x, y, z = q_wb.tolist()
            parts.append((Kind.ROTATION_DATA, wire.rotation_data(number, (w, x, y, z))))
            linear = frame.joint_acceleration[row]
            if np.isfinite(linear).all():
                a, b, c = quaternion.rotate_inverse(q_wb, linear).tolist()
                parts.append((Kind.ACCELERATION, wire.acceleration(number, (a, b, c))))
        return self._write(self.session.data(parts))

    def close(self) -> None:
        """Give the socket back."""
        if self._ticking is not None:
            self._ticking.cancel()
            self._ticking = None
        if self._socket is not None:
            asyncio.get_running_loop().remove_reader(self._socket)
            self._socket.close()
            self._socket = None

    def _tick(self) -> None:
        """Say what is due beside poses, again and again."""
        loop = asyncio.get_running_loop()
        now_s = loop.time()
        handshake = self.session.due(now_s)
        with contextlib.suppress(OSError):  # nobody listens there yet
            if handshake is not None:
                self._write([handshake])
            self._write(self.session.data([*self.session.presentations(now_s), *self._charge(now_s)]))
        self._ticking = loop.call_later(_TICK_S, self._tick)

    def _charge(self, now_s: float) -> list[Part]:
        share = self._battery()
        if share is None or not self.session.is_connected or now_s < self._charge_due_s:
            return []
        self._charge_due_s = now_s + _BATTERY_S
        return [(Kind.BATTERY, wire.battery(Battery(0.0, share)))]

    def _receive(self) -> None:
        assert self._socket is not None
        with contextlib.suppress(OSError):  # nobody listens there
            data = self._socket.recv(_LARGEST)
            self._write(self.session.receive(data, asyncio.get_running_loop().time()))

    def _write(self, datagrams: list[bytes]) -> bool:
        assert self._socket is not None
        try:
            for data in datagrams:
                self._socket.send(data)
        except BlockingIOError:
            return False
        return True
