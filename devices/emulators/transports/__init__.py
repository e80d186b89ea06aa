"""Where an emulated suit's bytes go: pseudo-terminals, CAN buses, sockets, memory.

A ``Transport`` (``transport``) opens, writes, reads and closes; it knows no packet fields. ``offer`` never
waits; ``listen`` receives what the host sends. A new one is a class in the file of its kind (``pty``,
``network``, ``can_bus``, ``memory``), and a choice of ``mocap-gateway emulate``.
"""

from devices.emulators.transports.can_bus import CanBusTransport
from devices.emulators.transports.memory import LoopbackTransport, MemoryTransport
from devices.emulators.transports.network import (
    SignedTcpTransport,
    SignedUdpTransport,
    TcpTransport,
    UdpTransport,
)
from devices.emulators.transports.pty import PtyTransport, SlcanTransport
from devices.emulators.transports.transport import DatagramTransport, LinkPerDevice, Transport

__all__ = [
    "CanBusTransport",
    "DatagramTransport",
    "LinkPerDevice",
    "LoopbackTransport",
    "MemoryTransport",
    "PtyTransport",
    "SignedTcpTransport",
    "SignedUdpTransport",
    "SlcanTransport",
    "TcpTransport",
    "Transport",
    "UdpTransport",
]
